"""DarSwin: an image encoder in the polar coordinates of a calibrated lens."""

from collections.abc import Sequence
from typing import Literal

from torch import nn

from darswin.layers.attention import PolarWindowAttention
from darswin.layers.embed import PolarPatchEmbed
from darswin.layers.position_bias import PositionBias
from darswin.lens.spacing import Spacing
from darswin.models.encoder import Encoder
from darswin.models.registry import Presets, register_model
from darswin.models.stages import StageSizes, stage_sizes
from darswin.ops.checks import per_channel
from darswin.views import PolarView
from darswin.views.base import Pair, PerChannel
from darswin.views.polar import Placement

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
        num_classes, in_chans, embed_dim, depths, num_heads, mlp_ratio, drop_path_rate: the
            arguments of `Encoder`.
        rings, sectors, samples, spacing, sample_spacing, placement, theta_max, jitter, mean, std:
            the arguments of `PolarView`. With "radius" for both spacings the model does not use the
            projection curve. The biases "angular_relative" and "angular" count θ_max/R from ring to
            ring for every spacing; with a spacing other than "theta" these angles are nominal.
        variant: "A" has windows and merging along azimuth, "RA" along radius and azimuth.
        window: (M_r, M_φ) on maps that are large enough; None means (1, 16) for A, (4, 4) for RA.
        merges: (m_r, m_φ) before each stage but the first; None means (1, 4) for A, (2, 2) for RA.
        position_bias: "angular_relative", or one of the ablations "angular" and "polar".
        harmonics: the number of harmonics of these two ablations.
        periodic_bias: see `AngularRelativeBias`.

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

    view: PolarView
    view_class: type[PolarView] = PolarView

    def __init__(
        self,
        num_classes: int = 1000,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        rings: int = 16,
        sectors: int = 64,
        samples: Pair = (10, 10),
        spacing: Spacing = "theta",
        sample_spacing: Spacing | None = None,
        placement: Placement = "centers",
        theta_max: float | None = None,
        jitter: float = 1.0,
        variant: Literal["A", "RA"] = "A",
        window: Pair | None = None,
        merges: Sequence[Pair] | None = None,
        position_bias: PositionBias = "angular_relative",
        harmonics: int = 16,
        periodic_bias: bool = False,
        mean: PerChannel = 0.0,
        std: PerChannel = 1.0,
    ):
        super().__init__(
            num_classes, in_chans, embed_dim, depths, num_heads, mlp_ratio, drop_path_rate
        )
        if variant not in ("A", "RA"):
            raise ValueError(f"variant must be 'A' or 'RA', got {variant!r}")
        self.position_bias, self.harmonics = position_bias, harmonics
        self.periodic_bias = periodic_bias
        self.view = self.view_class(
            rings, sectors, samples, spacing=spacing, sample_spacing=sample_spacing,
            placement=placement, theta_max=theta_max, jitter=jitter,
            mean=per_channel("mean", mean, in_chans), std=per_channel("std", std, in_chans),
        )  # fmt: skip
        values = self.view.samples[0] * self.view.samples[1] * in_chans
        self.patch_embed = PolarPatchEmbed(values, embed_dim)
        window = window or ((1, 16) if variant == "A" else (4, 4))
        sizes = stage_sizes(*self.view.map_size, len(depths), variant, window, merges)
        self._finish(sizes, self.view.samples)

    def attention(self, dim: int, heads: int, sizes: StageSizes, block: int) -> nn.Module:
        return PolarWindowAttention(
            dim,
            heads,
            **sizes.windows(block),
            position_bias=self.position_bias,
            harmonics=self.harmonics,
            periodic_bias=self.periodic_bias,
        )
