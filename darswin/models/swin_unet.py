"""Swin-Unet, the baseline of the dense models: on images as they are, undistorted, or squared."""

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.layers.sampling import check_count, check_lens
from darswin.lens import Lens
from darswin.lens.concentric import read_square
from darswin.lens.pixels import reprojection, sample_at
from darswin.lens.spacing import SPACINGS, Spacing
from darswin.models.adapter import SquareView, prepare_square
from darswin.models.dense import DenseModel, DenseTask
from darswin.models.registry import Presets, register_model
from darswin.models.stages import Pair
from darswin.models.swin import Swin, check_max_fov, undistortion

_PRESETS: Presets = dict(nano=dict(decoder_depths=1, skip_width=8))


@register_model("swin_unet", presets=_PRESETS)
class SwinUnet(DenseModel):
    """Swin as the encoder and its mirror as the decoder. It is called as `DarSwinUnet` is, and
    ignores the lens.

    The decoder ends on a map 4 times as fine along both axes as the encoder's first, which is
    resized to the image where it is not as large, and refined as `DarSwinUnet` does.

    Args:
        num_classes: of "segmentation"; "distance" ignores it. in_chans: C of the images.
        embed_dim, depths, num_heads: of the encoder's stages.
        image_size: (H, W), or the side of a square. patch_size: its side, in pixels.
        window: (rows, columns) where the map is large enough.
        task, decoder_depths, skip_width, typical_distance: as `DarSwinUnet`.
        places: adds to each of the encoder's maps, before the decoder, a learned linear function of
            where its tokens are in what the network looks at, x and y in [-1, 1].
        mlp_ratio, drop_path_rate: as `Swin`, of encoder and decoder.
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.

    Raises:
        ValueError: sizes that do not divide, or an option out of its range; in forward, images of
            another size.

    Source: Swin-Unet, ECCV 2022 workshops. It has two blocks a stage; here patches, windows and
        depths are those of `DarSwinUnet`, so that the numbers of tokens and parameters are.
    """

    encoder: Swin
    image_size: Pair = (128, 128)

    def __init__(
        self,
        num_classes: int = 10,
        in_chans: int = 3,
        embed_dim: int = 96,
        depths: Sequence[int] = (2, 2, 18, 2),
        num_heads: Sequence[int] = (3, 6, 12, 24),
        *,
        image_size: int | Pair = 128,
        patch_size: int = 4,
        window: Pair = (4, 4),
        task: DenseTask = "segmentation",
        decoder_depths: int | Sequence[int] = 2,
        skip_width: int = 16,
        typical_distance: float = 10.0,
        places: bool = True,
        mlp_ratio: float = 4.0,
        drop_path_rate: float = 0.2,
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
    ):
        super().__init__()
        encoder = Swin(
            0,
            in_chans,
            embed_dim,
            depths,
            num_heads,
            image_size=image_size,
            patch_size=patch_size,
            window=window,
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
            mean=mean,
            std=std,
        )
        self.image_size, self.square_images = encoder.image_size, encoder.square_images
        self._finish(
            encoder,
            num_classes,
            task=task,
            decoder_depths=decoder_depths,
            num_heads=num_heads,
            coordinates=2 if places else 0,
            mlp_ratio=mlp_ratio,
            drop_path_rate=drop_path_rate,
            skip_width=skip_width,
            typical_distance=typical_distance,
            mean=mean,
            std=std,
        )

    def token_places(self, way: Any) -> Sequence[Tensor]:
        """Where the tokens of each of the encoder's maps are, (1, H', W', 2)."""
        device = self.head.proj.weight.device
        sides = (
            [_centers(side, device) for side in size] for size in self.feature_info.get("map_size")
        )
        return [torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None] for y, x in sides]

    def to_pixels(self, x: Tensor, way: Any, size: Pair) -> Tensor:
        """The projected map (B, H', W', K) → (B, K, H, W)."""
        x = x.permute(0, 3, 1, 2)
        if x.shape[2:] == size:
            return x
        return F.interpolate(x, size, mode="bilinear", align_corners=False)


def _centers(count: int, device: torch.device) -> Tensor:
    """The middles of equal parts of [-1, 1]."""
    return (2 * torch.arange(count, device=device) + 1) / count - 1


@register_model("swin_unet_undis", presets=_PRESETS)
class SwinUnetUndis(SwinUnet):
    """Swin-Unet on the perspective view of each image, which its lens gives, and back.

    Pixels beyond the view are 0: unknown. The view is that of `SwinUndis`.

    Args:
        max_fov: the widest field of view of a view, rad, in (0, π).
        options: as `SwinUnet`.

    Raises:
        ValueError: as `SwinUnet`, or a max_fov out of its range.
        TypeError: in forward, no lens.
    """

    def __init__(self, *arguments: Any, max_fov: float = math.radians(175), **options: Any):
        super().__init__(*arguments, **options)
        self.max_fov = check_max_fov(max_fov)

    def way(self, lens: Lens | None, size: Pair) -> tuple[Tensor, Tensor]:
        """Where the images show each pixel of their views, and the views each of the images'."""
        lens = check_lens(lens, size)
        view, there = undistortion(lens, size, self.image_size, self.max_fov)
        return there, reprojection(view, self.image_size, lens, size)

    def look(self, images: Tensor, way: tuple[Tensor, Tensor]) -> Tensor:
        """The images (B, C, H, W) → their views."""
        check_count(len(way[0]), images)
        return sample_at(images, way[0])

    def back(self, logits: Tensor, way: tuple[Tensor, Tensor]) -> Tensor:
        """The logits of the views → those of the images."""
        return sample_at(logits, way[1])


@register_model("swin_unet_adapted", presets=_PRESETS)
class SwinUnetAdapted(SwinUnet):
    """Swin-Unet on the image disc as a square, and back: what `LensAdapter` makes of `SwinUnet`,
    with distances that are brought back before they are positive, as logarithms.

    Args:
        spacing: of θ from the middle of the square to its edge; see `darswin.lens.spacing`.
        options: as `SwinUnet`; the image must be square.

    Raises:
        ValueError: as `SwinUnet` and `LensAdapter`, or an image that is not square.
        TypeError: in forward, no lens.
    """

    def __init__(self, *arguments: Any, spacing: Spacing = "theta", **options: Any):
        super().__init__(*arguments, **options)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing must be one of {SPACINGS}, got {spacing!r}")
        if not self.square_images:
            raise ValueError(f"image_size must be square, got {self.image_size}")
        self.spacing = spacing

    def way(self, lens: Lens | None, size: Pair) -> SquareView:
        """The square that shows what the lens sees, as `LensAdapter.prepare`."""
        return prepare_square(lens, size, self.image_size[0], self.spacing)

    def look(self, images: Tensor, way: SquareView) -> Tensor:
        """The images (B, C, H, W) → their squares."""
        check_count(len(way.there), images)
        return sample_at(images, way.there)

    def back(self, logits: Tensor, way: SquareView) -> Tensor:
        """The logits of the squares → those of the images."""
        return read_square(logits, way.places)
