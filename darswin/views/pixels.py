"""The views that a network sees as pixels, and the way from their pixels back to the images."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import OUTSIDE, ray_channels, sample_at
from darswin.ops.checks import check_pair, tensor_there
from darswin.utils.arrays import as_tensor
from darswin.views.base import (
    Pair,
    PerChannel,
    Prepared,
    View,
    check_count,
    check_lens,
    check_seen_images,
)

Points = TypeVar("Points", np.ndarray, Tensor)

_ROUNDING = 1e-3  # px: a point that is this little beyond the edge of a view is on it


class PixelView(View):
    """A view whose pixels are pixels of the images. A subclass says which: three maps of points.

    Args:
        size: (H', W') of the view; None for the size of the images, if the view ignores its lens.
    """

    def __init__(
        self, size: Pair | None, *, mean: PerChannel | None = 0.0, std: PerChannel | None = 1.0
    ):
        super().__init__(mean, std)
        if size is not None or self.uses_lens:
            size = check_pair("size", size, 1)
        self.size = size

    def image_points(self, lens: Any, size: Pair) -> Tensor | None:
        """The points of images of (H, W) that the pixels of the view show, (N, H', W', 2) px."""
        raise NotImplementedError

    def view_points(self, lens: Any, size: Pair) -> Tensor | None:
        """The points of the view that the pixels of images of (H, W) show, (N, H, W, 2) px."""
        raise NotImplementedError

    def pixel_rays(self, lens: Any, size: Pair) -> tuple[Tensor, Tensor]:
        """The rays of the pixels of the view, as `darswin.lens.pixels.pixel_rays` returns them."""
        raise NotImplementedError

    def reads_of(self, size: Pair) -> int:
        """The points along each side of a pixel at which images of (H, W) are read."""
        return 1

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        """Pixels (N or 1, ..., 2) of the view → vectors (N, ..., 3) in the camera's frame; NaN
        where the view shows nothing. size: (H, W) of the images of N lenses."""
        raise NotImplementedError

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        """The inverse of `to_rays`: pixels (N, ..., 2) of the view, which may be outside of it."""
        raise NotImplementedError

    def to_image(self, points: Points, lens: Lens, size: Pair, **of_tile: int) -> Points:
        """Pixels (..., 2) of the view → pixels (..., 2) of images of (H, W), exactly.

        Args:
            points: x and y, a NumPy array or a tensor; computed in float64.
            lens: one lens. size: (H, W) of its images.
            of_tile: `tile=k`, the number of the tile, if the view has tiles.

        Returns:
            Points as given; NaN where the image shows nothing: no ray lands, or it is outside.
        """

        def move(pixels: Tensor, exact: Lens) -> Tensor:
            places = exact.project_points(self.to_rays(pixels, exact, size, **of_tile), size)
            sides = tensor_there(size[::-1], places)
            beyond = (places + 0.5 - sides / 2).abs() > sides / 2 + _ROUNDING
            return torch.where(beyond.any(-1, keepdim=True), torch.nan, places)

        return _exactly(points, lens, size, move)

    def to_view(self, points: Points, lens: Lens, size: Pair, **of_tile: int) -> Points:
        """Pixels (..., 2) of images of (H, W) → pixels (..., 2) of the view: the inverse of
        `to_image`, with its arguments."""
        return _exactly(points, lens, size, lambda pixels, exact: self.to_points(
            exact.unproject_points(pixels, size), exact, size, **of_tile))  # fmt: skip

    def prepare(
        self,
        lens: Lens | None,
        size: Pair,
        *,
        back: bool | Pair = True,
        rays: bool = True,
        maps: Sequence[Pair] = (),
    ) -> Prepared:
        if self.uses_lens or rays:
            check_lens(lens, size)
        points = self.image_points(lens, size)
        places = self.shown_points(lens, size) if back else None
        return Prepared(
            size,
            points,
            places,
            ray_channels(*self.pixel_rays(lens, size)) if rays else None,
            [_centers(of_map, None if points is None else points.device) for of_map in maps],
            shown=None if places is None else places[..., 0] != OUTSIDE,
            around=self.goes_around(lens, size) if back else None,
        )

    def shown_points(self, lens: Any, size: Pair) -> Tensor | None:
        """`view_points`, with `OUTSIDE` beyond the edges of the view."""
        points = self.view_points(lens, size)
        if points is None:
            return None
        assert self.size is not None
        last = tensor_there([side - 0.5 + _ROUNDING for side in self.size[::-1]], points)
        within = (points >= -0.5 - _ROUNDING) & (points <= last)
        return torch.where(within.all(-1, keepdim=True), points, OUTSIDE)

    def goes_around(self, lens: Any, size: Pair) -> Tensor | None:
        """`Prepared.around`."""
        return None

    def see(self, images: Tensor, prepared: Prepared, dtype: torch.dtype = torch.float32) -> Tensor:
        images = self.floating(images, dtype)
        if prepared.points is None:
            return images
        assert isinstance(prepared.points, Tensor)
        check_count(prepared.points.shape[0], images)
        return sample_at(images, prepared.points)

    def back(self, maps: Tensor, prepared: Prepared) -> Tensor:
        points = self.back_points(prepared, (maps.shape[2], maps.shape[3]))
        if prepared.around is not None:
            maps = torch.cat((maps[..., -1:], maps, maps[..., :1]), -1)
        return sample_at(maps, points)

    def back_points(self, prepared: Prepared, size: Pair) -> Tensor:
        """The pixels of a map of this size that `back` brings to the pixels of the images,
        (N, H, W, 2). If a view goes `around`, the map has one more column on each side."""
        assert isinstance(prepared.back, Tensor)
        points, around = self.scaled(prepared.back, size), prepared.around
        inner = self.within(points, size)
        if around is not None:
            x, y = inner.unbind(-1)
            x = torch.where(around.to(points.device)[:, None, None], points[..., 0], x)
            inner = torch.stack((x + 1, y), -1)
        return torch.where(prepared.back == OUTSIDE, OUTSIDE, inner)

    def scaled(self, points: Tensor, size: Pair) -> Tensor:
        """Points of the view in a map of this size."""
        if size == self.size:
            return points
        assert self.size is not None
        scale = [of / to for of, to in zip(size, self.size, strict=True)]
        return (points + 0.5) * tensor_there(scale[::-1], points) - 0.5

    @staticmethod
    def within(points: Tensor, size: Pair) -> Tensor:
        """Points of a map, whose outermost pixels extend to its edges."""
        return torch.minimum(points.clamp(min=0), tensor_there(size[::-1], points) - 1)

    def check_seen(self, seen: Tensor, prepared: Prepared, channels: int | None) -> Tensor:
        seen = check_seen_images(seen, self.size or prepared.size, channels)
        if isinstance(prepared.points, Tensor):
            check_count(prepared.points.shape[0], seen)
        return seen

    def extra_repr(self) -> str:
        return f"size={self.size}"


def _exactly(
    points: Points, lens: Lens, size: Pair, move: Callable[[Tensor, Lens], Tensor]
) -> Points:
    """Moves points (..., 2) through one lens of images of (H, W) in float64."""
    if len(check_lens(lens, size)) != 1:
        raise ValueError(f"points move through one lens, got {len(lens)}")
    if (shape := tuple(np.shape(points)))[-1:] != (2,):
        raise ValueError(f"points must have shape (..., 2), got {shape}")
    if not isinstance(points, Tensor):
        places = np.asarray(points)
        exact = as_tensor(places, torch.float64)
        moved = move(exact[None], lens.detach().to("cpu", torch.float64))[0]
        return moved.numpy().astype(np.result_type(places, np.float32), copy=False)
    moved = move(points[None].to(torch.float64), lens.to(points.device, torch.float64))[0]
    return moved.to(torch.promote_types(points.dtype, torch.float32))


def _centers(size: Pair, device: torch.device | None) -> Tensor:
    """The centres of the tokens of a map, (1, H', W', 2): x and y in [-1, 1]."""
    y, x = ((2 * torch.arange(side, device=device) + 1) / side - 1 for side in size)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None]


def resized(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Maps (B, K, H', W') in another size, bilinearly; of integers it takes the nearest."""
    if tuple(maps.shape[2:]) == tuple(size):
        return maps
    if maps.is_floating_point():
        return F.interpolate(maps, size, mode="bilinear", align_corners=False)
    return F.interpolate(maps.double(), size, mode="nearest-exact").to(maps.dtype)
