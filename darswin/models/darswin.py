"""DarSwin: an image encoder in the polar coordinates of a calibrated lens."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from darswin.layers.embed import PolarPatchEmbed
from darswin.layers.polar import PolarGrid, PolarGridSpec, check_count
from darswin.layers.position_bias import PositionBias, ring_angles
from darswin.layers.transformer import PolarWindowAttention
from darswin.lens import Lens
from darswin.models.encoder import Encoder, Prepared
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair, StagePlan, plan_stages
from darswin.ops import polar_sample
from darswin.ops.checks import check_tensor

# Models of the same size have the same number of tokens.
PRESETS: Presets = dict(micro=dict(samples=(6, 6)), nano=dict(rings=8, sectors=32, samples=(4, 4)))


@register_model("darswin_a", variant="A", presets=PRESETS)
@register_model("darswin_ra", variant="RA", presets=PRESETS)
class DarSwin(Encoder):
    """The Distortion Aware Radial Swin Transformer.

    The image is cut into R × A polar patches along the lens's projection curve. Each patch is
    sampled at S_r × S_φ points and becomes a token. Blocks of window attention on the polar map
    follow, and neighbouring tokens are merged between the stages. The images may have any size,
    because R and A belong to the model.

    Args:
        arguments: num_classes, in_chans, embed_dim, depths and num_heads, as in `Encoder`.
        jitter: how far the sample points move at random in training, in [0, 1]; 0 turns it off.
        variant: "A" has windows and merging along azimuth, "RA" along radius and azimuth.
        window: (M_r, M_φ) on maps that are large enough; None means (1, 16) for A, (4, 4) for RA.
        merges: (m_r, m_φ) before each stage but the first; None means (1, 4) for A, (2, 2) for RA.
        position_bias: "angular_relative", or one of the ablations "angular" and "polar".
        harmonics: the number of harmonics of these two ablations.
        periodic_bias: see `AngularRelativeBias`.
        options: the settings of `PolarGridSpec`, such as `rings`, `sectors`, `samples`, `spacing`
            and `theta_max`, and the other arguments of `Encoder`. With "radius" for both spacings
            the model does not use the projection curve. The biases "angular_relative" and
            "angular" count θ_max/R from ring to ring for every spacing; with a spacing other than
            "theta" these angles are nominal.

    Rotation:
        Turning a square image by 90° about the principal point turns the maps by a quarter of their
        sectors and keeps the logits, up to rounding, in eval mode. The condition is that in every
        stage a quarter of the sectors is a whole number of windows. A whole number of tokens is
        enough if the window spans the ring and its position bias is periodic: `periodic_bias` makes
        it so, and "angular" and "polar" always are. RA meets the condition in every size, and
        "darswin_a_nano" meets it for 180°. A with four stages does not meet it, because a ring of
        its last map is a single token. It does with `merges=((1, 4), (1, 4), (4, 1))`, which ends
        on a 4×4 map, and so does "darswin_a_nano" with `merges=((1, 4), (4, 1)), window=(1, 8)`.

    Raises:
        ValueError: an unknown option, or a window or merging that does not divide its map.

    Source: DarSwin, ICCV 2023.
    """

    patch_embed: PolarPatchEmbed

    def __init__(
        self,
        *arguments: Any,
        jitter: float = 1.0,
        variant: Literal["A", "RA"] = "A",
        window: Pair | None = None,
        merges: Sequence[Pair] | None = None,
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
        **options: Any,
    ):
        names = [field.name for field in dataclasses.fields(PolarGridSpec)]
        self.spec = PolarGridSpec(**{name: options.pop(name) for name in names if name in options})
        super().__init__(*arguments, **options)
        if variant not in ("A", "RA"):
            raise ValueError(f"variant must be 'A' or 'RA', got {variant!r}")
        window = window or ((1, 16) if variant == "A" else (4, 4))
        rings, sectors = self.spec.rings, self.spec.sectors
        plans = plan_stages(rings, sectors, len(self.depths), variant, window, merges)
        self.position_bias, self.harmonics = position_bias, harmonics
        self.periodic_bias = periodic_bias
        self.patch_embed = PolarPatchEmbed(
            self.spec,
            in_chans=self.in_chans,
            embed_dim=self.embed_dim,
            jitter=jitter,
            mean=self.mean,
            std=self.std,
        )
        self._finish(plans, self.spec.samples)

    def attention(self, dim: int, heads: int, plan: StagePlan, block: int) -> nn.Module:
        return PolarWindowAttention(
            dim,
            heads,
            **plan.windows(block),
            position_bias=self.position_bias,
            harmonics=self.harmonics,
            periodic_bias=self.periodic_bias,
        )

    def _prepare(self, lens: Lens, size: Pair) -> Prepared:
        grid, last = self.spec.grid(lens, size), self.spec.last_angle(lens)
        rings = [plan.map_size[0] for plan in self.plans]
        return Prepared(grid, [(ring_angles(last, grid, r, self.position_bias),) for r in rings])

    def embed(self, images: Tensor, points: PolarGrid | None) -> Tensor:
        if points is None:
            return self.patch_embed(images, None)
        check_count(points.radii.shape[0], images)
        if images.dtype == torch.uint8 and next(self.parameters()).dtype == torch.float64:
            images = self._floating(images)  # the operator would normalize in float32
        return self.patch_embed(images, points)

    def _sample(self, images: Tensor, prepared: Prepared) -> Tensor:
        check_count(prepared.points.radii.shape[0], images)
        return polar_sample(**self.patch_embed.sample.arguments(images, prepared.points))

    def _checked_sampled(self, sampled: Tensor, prepared: Prepared) -> Tensor:
        values = self.spec.samples[0] * self.spec.samples[1] * self.in_chans
        shape = (None, self.spec.rings, self.spec.sectors, values)
        check_tensor(
            "sampled", sampled, (torch.float32, torch.float64, torch.bfloat16),
            "(B, R, A, S_r·S_φ·C) = (any, {}, {}, {})", shape,
        )  # fmt: skip
        check_count(prepared.points.radii.shape[0], sampled)
        return sampled
