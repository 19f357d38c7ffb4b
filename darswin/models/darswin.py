"""DarSwin: an image encoder in the polar coordinates of a calibrated lens."""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from darswin.layers.embed import PolarPatchEmbed
from darswin.layers.polar import Placement, PolarGrid, PolarGridSpec, check_count, check_lens
from darswin.layers.position_bias import PositionBias, ring_angles
from darswin.layers.transformer import PolarWindowAttention
from darswin.lens import Lens
from darswin.lens.spacing import Spacing
from darswin.models.encoder import Encoder, Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair, StagePlan, plan_stages

# All models of a size have as many tokens.
PRESETS: Presets = dict(micro=dict(samples=(6, 6)), nano=dict(rings=8, sectors=32, samples=(4, 4)))


@register_model("darswin_a", variant="A", presets=PRESETS)
@register_model("darswin_ra", variant="RA", presets=PRESETS)
class DarSwin(Encoder):
    """The Distortion Aware Radial Swin Transformer.

    The image is cut into R × A polar patches along the lens's projection curve, each sampled at
    S_r × S_φ points and embedded; blocks of windowed attention on the polar map follow, with
    merging in between. Any image size works; R and A are those of the model.

    Args:
        arguments, options: num_classes, in_chans, embed_dim, depths, num_heads and others of
            `Encoder`.
        rings, sectors: R and A. samples: (S_r, S_φ).
        spacing, sample_spacing, placement: as `PolarGridSpec`. "radius" for both spacings is a
            model without lens knowledge, for the samples alone it samples uniformly.
        jitter: in [0, 1], of the sample points in training; 0 is off.
        variant: "A" has windows and merging along azimuth, "RA" along radius and azimuth.
        window: (M_r, M_φ) where the map is large enough; None means (1, 16) for A, (4, 4) for RA.
        merges: (m_r, m_φ) before each stage but the first; None means (1, 4) for A, (2, 2) for RA.
        position_bias: "angular_relative", or the ablations "angular" and "polar" with `harmonics`.
        periodic_bias: see `AngularRelativeBias`.

    Rotation:
        In eval mode a turn of a square image about the principal point by 90° turns the maps by a
        quarter of their sectors, exactly up to rounding, and leaves the logits as they are, where
        in each stage that quarter is a whole number of windows; of tokens, if the window spans the
        ring and its bias is periodic, as `periodic_bias` makes it (those of "angular" and "polar"
        are). So it is for RA of every size; with half turns for "darswin_a_nano"; but not for the A
        of four stages, whose last one has a single token in a ring. It is for
        `merges=((1, 4), (1, 4), (4, 1))`, whose last map is 4×4, and for "darswin_a_nano" with
        `merges=((1, 4), (4, 1)), window=(1, 8)`.

    Raises:
        ValueError: sizes that windows or merging do not divide, or an unknown option.

    Source: DarSwin, ICCV 2023.
    """

    patch_embed: PolarPatchEmbed

    def __init__(
        self,
        *arguments: Any,
        rings: int = 16,
        sectors: int = 64,
        samples: Pair = (10, 10),
        spacing: Spacing = "theta",
        sample_spacing: Spacing | None = None,
        placement: Placement = "centers",
        jitter: float = 1.0,
        variant: Literal["A", "RA"] = "A",
        window: Pair | None = None,
        merges: Sequence[Pair] | None = None,
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
        **options: Any,
    ):
        super().__init__(*arguments, **options)
        if variant not in ("A", "RA"):
            raise ValueError(f"variant must be 'A' or 'RA', got {variant!r}")
        window = window or ((1, 16) if variant == "A" else (4, 4))
        plans = plan_stages(rings, sectors, len(self.depths), variant, window, merges)
        self.position_bias, self.harmonics = position_bias, harmonics
        self.periodic_bias = periodic_bias
        self.spec = PolarGridSpec(rings, sectors, samples, spacing, sample_spacing, placement)
        self.patch_embed = PolarPatchEmbed(
            self.spec,
            in_chans=self.in_chans,
            embed_dim=self.embed_dim,
            jitter=jitter,
            mean=self.mean,
            std=self.std,
        )
        self._finish([self._plan(plan, window) for plan in plans], samples)

    def _plan(self, plan: StagePlan, window: Pair) -> StagePlan:
        """A stage's sizes, which a subclass may change."""
        return plan

    def attention(self, dim: int, heads: int, plan: StagePlan, block: int) -> nn.Module:
        """As `Encoder`."""
        return PolarWindowAttention(
            dim,
            heads,
            **plan.windows(block),
            position_bias=self.position_bias,
            harmonics=self.harmonics,
            periodic_bias=self.periodic_bias,
        )

    def prepare(self, lens: Lens | None, size: Pair) -> Prepared:
        """The grid of the samples, and for each stage its `ring_angles`; else as `Encoder`."""
        lens = check_lens(lens, size)
        grid = self.spec.grid(lens, size)
        rings = [plan.map_size[0] for plan in self.plans]
        return Prepared(grid, [(ring_angles(lens, grid, r, self.position_bias),) for r in rings])

    def embed(self, images: Tensor, points: PolarGrid) -> Tensor:
        """Images (B, C, H, W) on a grid of `prepare` → the first map, (B, R, A, D)."""
        check_count(len(points.radii), images)
        if images.dtype == torch.uint8 and next(self.parameters()).dtype == torch.float64:
            images = self._floating(images)  # the operator would normalize in float32
        return self.patch_embed(images, points)
