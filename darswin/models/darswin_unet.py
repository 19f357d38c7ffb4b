"""DarSwin-Unet: a label or a distance for each pixel, from the polar map of a calibrated lens."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from darswin.layers.grid import PixelGrid, pixel_grid, token_rays
from darswin.layers.sampling import check_lens
from darswin.lens import Lens
from darswin.models.darswin import PRESETS, DarSwin
from darswin.models.decoder import EXPANSION
from darswin.models.dense import DenseModel, DenseTask
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair
from darswin.ops import polar_to_image

_PRESETS: Presets = dict(
    micro=PRESETS["micro"], nano=dict(samples=(4, 4), decoder_depths=1, skip_width=8)
)


class PolarWay(NamedTuple):
    """Where the rings of the decoder's map are in the image, and where the tokens of each of the
    encoder's maps look, (N, R, A, 3); empty where the model does not ask."""

    grid: PixelGrid
    rays: Sequence[Tensor]


@register_model("darswin_unet_a", variant="A", presets=_PRESETS)
@register_model("darswin_unet_ra", variant="RA", presets=_PRESETS)
class DarSwinUnet(DenseModel):
    """DarSwin as the encoder, its mirror as the decoder, and from the polar map to the pixels.

    The decoder ends on a map of 4·R × 4·A tokens. Its projection to the classes is brought to the
    pixels by `polar_to_image`, through any lens, and refined by a few convolutions that see the
    image too, since a polar map is coarser than the image at its rim. Any image size works.

    Args:
        num_classes: of "segmentation"; "distance" ignores it. in_chans: C of the images.
        embed_dim, depths, num_heads: of the encoder's stages.
        task: "segmentation" or "distance".
        decoder_depths: blocks of each stage of the decoder, one for each of the encoder but the
            last; an int is for all.
        skip_width: channels of the skip from the image; 0 leaves it out.
        typical_distance: m, what "distance" starts from.
        places: adds to each of the encoder's maps, before the decoder, a learned linear function of
            where its tokens look, (x, y, z). Without it the network does not know which way is up,
            as its tokens know where others are, but not their own azimuth.
        mlp_ratio, drop_path_rate: as `DarSwin`, of encoder and decoder.
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.
        options: others of `DarSwin`, but for compat.

    The variants have as many parameters as `SwinUnet` of the same size, to 1 %: both merge four
    tokens at a stage. "darswin_unet_*_nano" has R×A = 16×64, unlike the classifier of that size.

    Rotation:
        In eval mode, without `places` and without the skip from the image (skip_width=0), whose
        convolutions are not symmetric, a turn of a square image about the principal point by 90°
        turns the result by 90°, up to rounding, where it turns the maps of `DarSwin`: for
        "darswin_unet_ra_nano", and with `periodic_bias` for RA of every size and
        "darswin_unet_a_nano". A pixel at the very middle has no azimuth and is left out.

    Raises:
        ValueError: as `DarSwin`, or an option out of its range. TypeError: in forward, no lens.

    Source: DarSwin-Unet, WACV 2025, with a differentiable interpolation in place of its nearest
        neighbours, and skips from the end of each stage rather than its beginning.
    """

    encoder: DarSwin

    def __init__(
        self,
        num_classes: int = 10,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        task: DenseTask = "segmentation",
        decoder_depths: int | Sequence[int] = 2,
        skip_width: int = 16,
        typical_distance: float = 10.0,
        places: bool = True,
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
        **options: Any,
    ):
        super().__init__()
        if options.get("compat") is not None:
            raise ValueError(f"{type(self).__name__} has no compat, got {options['compat']!r}")
        encoder = DarSwin(
            0,
            in_chans,
            embed_dim,
            depths,
            num_heads,
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
            mean=mean,
            std=std,
            **options,
        )
        self._finish(
            encoder,
            num_classes,
            task=task,
            decoder_depths=decoder_depths,
            num_heads=num_heads,
            coordinates=3 if places else 0,
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
            skip_width=skip_width,
            typical_distance=typical_distance,
            mean=mean,
            std=std,
        )

    def way(self, lens: Lens | None, size: Pair) -> PolarWay:
        """The rings of the decoder's map and where they are in images of (H, W), and the rays."""
        sample = self.encoder.patch_embed.sample
        lens = check_lens(lens, size)
        grid = pixel_grid(
            lens,
            size,
            rings=sample.rings,
            split=EXPANSION,
            spacing=sample.spacing,
            sample_spacing=sample.sample_spacing,
        )
        sizes = self.feature_info.get("map_size")[: len(self.places)]
        return PolarWay(
            grid,
            [token_rays(lens, rings=r, sectors=a, spacing=sample.spacing) for r, a in sizes],
        )

    def token_places(self, way: PolarWay) -> Sequence[Tensor]:
        """Where the tokens of each of the encoder's maps look."""
        return way.rays

    def to_pixels(self, x: Tensor, way: PolarWay, size: Pair) -> Tensor:
        """The projected map (B, 4·R, 4·A, K) → (B, K, H, W); 0 beyond θ_max."""
        dtype = torch.float64 if x.dtype == torch.float64 else torch.float32
        radii, r_max, center, affine, points = (
            None if tensor is None else tensor.to(x.device, dtype) for tensor in way.grid
        )
        assert radii is not None
        pixels = polar_to_image(
            x, radii, center, size, affine=affine, points=points, r_max=r_max, layout="tokens"
        )
        return pixels.permute(0, 3, 1, 2)
