"""Samples of images on the polar grid of their lenses."""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from darswin.layers.grid import Placement, PolarGrid, check_grid, polar_grid
from darswin.lens import Lens
from darswin.lens.spacing import Spacing
from darswin.ops import polar_sample
from darswin.ops.checks import channels_first, check_jitter, check_layout, readable

GridFunction = Callable[..., PolarGrid]


class PolarSample(nn.Module):
    """Samples images on the polar grid of their lenses: `polar_sample` and the grid it needs.

    Args:
        rings, sectors, samples, spacing, sample_spacing, placement: as `darswin.polar_grid`.
        jitter: in [0, 1], how far a sample may move, in cells; only in training. The seed of each
            call comes from torch's generator.
        layout: "tokens" gives (B, R, A, S_r·S_φ·C), "image" (B, C, R·S_r, A·S_φ).
        mean, std: of uint8 images, which count as `(pixel/255 - mean) / std`; others ignore them.
        grid: the function that makes the grid.

    Raises:
        ValueError: settings that make no grid, here; images and lenses that do not fit, in forward.

    Source: DarSwin, ICCV 2023, sec. 4.2 and 4.3.
    """

    def __init__(
        self,
        rings: int,
        sectors: int,
        samples: tuple[int, int],
        *,
        spacing: Spacing = "theta",
        sample_spacing: Spacing | None = None,
        placement: Placement = "centers",
        jitter: float = 0.0,
        layout: Literal["tokens", "image"] = "tokens",
        mean: float | Sequence[float] = 0.0,
        std: float | Sequence[float] = 1.0,
        grid: GridFunction = polar_grid,
    ):
        super().__init__()
        check_grid(rings, sectors, samples, spacing, sample_spacing or spacing, placement)
        check_layout(layout)
        self.rings, self.sectors, self.samples = int(rings), int(sectors), (*map(int, samples),)
        self.spacing, self.sample_spacing = spacing, sample_spacing or spacing
        self.placement, self.jitter, self.layout = placement, check_jitter(jitter), layout
        self.mean, self.std = mean, std
        self._grid = grid

    def grid(self, lens: Lens, image_size: tuple[int, int]) -> PolarGrid:
        """The grid of a lens in images of (H, W)."""
        return self._grid(
            lens,
            image_size,
            rings=self.rings,
            sectors=self.sectors,
            samples=self.samples,
            spacing=self.spacing,
            sample_spacing=self.sample_spacing,
            placement=self.placement,
        )

    def arguments(self, images: Tensor, grid: PolarGrid) -> dict:
        """What the operators sample images (B, C, H, W) with, on a grid that `grid` gave."""
        dtype = torch.float64 if images.dtype == torch.float64 else torch.float32
        radii, azimuths, center, _, affine, offsets = (
            None if t is None else t.to(images.device, dtype) for t in grid
        )
        jitter = self.jitter if self.training else 0.0
        # 62 bits, so that the seed is a tensor that compiled training does not specialise on.
        seed = torch.randint(2**62, ()) if jitter else 0
        return dict(
            image=images, radii=radii, azimuths=azimuths, center=center, affine=affine,
            offsets=offsets, samples=self.samples, jitter=jitter, seed=seed, mean=self.mean,
            std=self.std, channels_last=False,
        )  # fmt: skip

    def forward(self, images: Tensor, lens: Lens, channels_last: bool | None = None) -> Tensor:
        """Images and their lenses (B or 1) → the samples, in `layout`.

        The images are (B, C, H, W) or (B, H, W, C), as `polar_sample` takes them with
        `channels_last`.
        """
        images = check_images(images, channels_last)
        height, width = images.shape[2:]
        check_lens(lens, (height, width))
        check_count(len(lens), images)
        grid = self.grid(lens, (height, width))
        return polar_sample(**self.arguments(images, grid), layout=self.layout)

    def extra_repr(self) -> str:
        return (
            f"rings={self.rings}, sectors={self.sectors}, samples={self.samples}, "
            f"spacing={self.spacing!r}, sample_spacing={self.sample_spacing!r}, "
            f"placement={self.placement!r}, jitter={self.jitter}, layout={self.layout!r}"
        )


def check_images(
    images: Tensor, channels_last: bool | None = None, channels: int | None = None
) -> Tensor:
    """The images as (B, C, H, W), else TypeError or ValueError: see `channels_first`."""
    if not isinstance(images, Tensor):
        raise TypeError(f"images must be a tensor, got {type(images).__name__}")
    if images.dim() != 4:
        raise ValueError(f"images must have shape (B, C, H, W), got {tuple(images.shape)}")
    return channels_first("images", images, channels_last, channels)


def check_lens(lens: Lens | None, size: tuple[int, int]) -> Lens:
    """The lens, which must be one, for images of (H, W); else TypeError or ValueError.

    Sizes are checked where they are `readable`."""
    if not isinstance(lens, Lens):
        raise TypeError(f"lens must be a darswin.lens.Lens, got {type(lens).__name__}")
    if lens.image_size is None or not readable(lens.image_size):
        return lens
    for other in lens.image_size.unique(dim=0).tolist():
        if tuple(other) != size:
            raise ValueError(
                f"the lens belongs to images of (H, W) = {tuple(round(s) for s in other)}, got "
                f"images of {size}; lens.resized({size}) is the lens of a resized image"
            )
    return lens


def check_count(lenses: int, images: Tensor) -> None:
    """ValueError unless there is a lens for each image, or one for all."""
    if lenses not in (1, images.shape[0]):
        raise ValueError(f"there must be one lens or one an image, {images.shape[0]}, got {lenses}")
