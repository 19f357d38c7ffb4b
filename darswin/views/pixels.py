"""The views that a network sees as pixels, and the way from their pixels back to the images."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens import ImplausibleLens, Lens
from darswin.lens.files.load import reach
from darswin.lens.pixels import OUTSIDE, as_map, pixel_grid, ray_channels, sample_at
from darswin.lens.plausible import doubts
from darswin.lens.solve import length_of
from darswin.ops.checks import as_int, check_pair, tensor_there
from darswin.views.base import (
    Pair,
    PerChannel,
    PreparedPixels,
    View,
    check_count,
    check_lens,
    check_seen_images,
    in_full_precision,
)
from darswin.views.orientation import AXIS
from darswin.views.remap import Remap
from darswin.views.turn import STILL

_MOST = 16  # points along each side of a pixel
_ROUNDING = 1e-3  # px: a point that is this little beyond the edge of a view is on it


class PixelView(View):
    """A view whose pixels are pixels of the images. A subclass says which, by rays: `to_rays` and
    `to_points`. If it knows a shorter way, it has `to_image`, `to_view` or `pixel_rays` too.

    Args:
        size: (H', W') of the view; None for the size of the images, if the view ignores its lens.

    Attributes:
        turn: of the view relative to the picture.
        tiles: the views of which this one consists, if there are several.
    """

    turn = STILL
    tiles: Sequence["PixelView"] = ()

    def __init__(
        self, size: Pair | None, *, mean: PerChannel | None = 0.0, std: PerChannel | None = 1.0
    ):
        super().__init__(mean, std)
        if size is not None or self.uses_lens:
            size = check_pair("size", size, 1)
        self.size = size

    def at(self, lens: Lens | None, size: Pair) -> Remap:
        """The map between this view and pictures of (H, W) of one lens. See `Remap`.

        Warns:
            ImplausibleLens: a lens without an image_size does not fit pictures of this size.
        """
        remap = Remap(self, lens, size)
        if lens is not None and lens.image_size is None:  # others are judged as they are read
            sized = lens.detach().replace(image_size=lens.theta_max.new_tensor([remap.size]))
            (doubt,) = doubts(sized.with_theta_max(reach(sized)))
            if doubt:
                warnings.warn(f"the lens describes {doubt}", ImplausibleLens, stacklevel=2)
        return remap

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        """Pixels (N or 1, ..., 2) of the view → vectors (N, ..., 3) in the camera's frame; NaN
        where the view shows nothing. size: (H, W) of the images of N lenses."""
        raise NotImplementedError

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        """The inverse of `to_rays`: pixels (N, ..., 2) of the view, which may be outside of it."""
        raise NotImplementedError

    def to_image(self, points: Tensor, lens: Any, size: Pair) -> Tensor:
        """Pixels (N or 1, ..., 2) of the view → pixels (N, ..., 2) of images of (H, W), also beyond
        their edges; NaN where the view shows nothing. `Remap` has this for arrays, in float64."""
        rays = self.to_rays(points, lens, size)
        return _moved(rays, lambda known: lens.project_points(known, size))

    def to_view(self, points: Tensor, lens: Any, size: Pair) -> Tensor:
        """The inverse of `to_image`: pixels (N, ..., 2), also beyond the edges of the view."""
        rays = lens.unproject_points(points, size)
        return _moved(rays, lambda known: self.to_points(known, lens, size))

    def image_points(self, lens: Any, size: Pair) -> Tensor | None:
        """The points of images of (H, W) at which the pixels of the view are read, k² for each,
        (N, k·H', k·W', 2) px. None means that the view is the images."""
        return as_map(self.to_image(self._finely(lens, size), lens, size))

    def view_points(self, lens: Any, size: Pair) -> Tensor | None:
        """The points of the view that the pixels of images of (H, W) show, (N, H, W, 2) px."""
        return as_map(self.to_view(pixel_grid(size, lens.theta_max), lens, size))

    def pixel_rays(self, lens: Any, size: Pair) -> tuple[Tensor, Tensor]:
        """The rays of the pixels of the view, as `darswin.lens.pixels.pixel_rays` returns them."""
        rays = self.to_rays(pixel_grid(self.size or size, lens.theta_max), lens, size)
        aside = length_of(rays[..., :2])
        theta = torch.atan2(aside, rays[..., 2])
        return torch.where(lens.sees(theta), theta, torch.nan), rays[..., :2] / aside[..., None]

    def supersampling_of(self, lens: Any, size: Pair) -> int:
        """k, the points along each side of a pixel at which images of (H, W) are read."""
        return 1

    def _finely(self, lens: Any, size: Pair) -> Tensor:
        """k² points in each pixel of the view, (1, k·H', k·W', 2)."""
        assert self.size is not None
        supersampling, (height, width) = self.supersampling_of(lens, size), self.size
        grid = pixel_grid((height * supersampling, width * supersampling), lens.theta_max)
        return grid if supersampling == 1 else (grid + 0.5) / supersampling - 0.5

    # -- of one lens: what `Remap` asks for -----------------------------------------------------

    def camera(self, lens: Any, size: Pair) -> Lens | None:
        """The lens of the view's picture, if a camera could have taken it."""
        return None

    def picture(self, picture: np.ndarray, remap: Remap) -> np.ndarray:
        """`Remap.__call__` of an array."""
        return remap.sampled(picture)

    def points_read(self, lens: Any, size: Pair) -> np.ndarray:
        """`image_points` of one lens, (k·H', k·W', 2)."""
        points = self.image_points(lens, size)
        assert points is not None
        return points[0].numpy()

    def points_of_target(self, lens: Any, size: Pair) -> np.ndarray:
        """The points of the image whose labels the pixels of the view take, (H', W', 2); NaN
        where it shows nothing."""
        shape = self.size or size
        return self.to_image(exact_grid(shape), lens, size)[0].numpy()

    # -- of N lenses ----------------------------------------------------------------------------

    @in_full_precision
    def prepare(self, lens: Lens | None, size: Pair, *, back: bool | Pair = True) -> PreparedPixels:
        if self.uses_lens:
            check_lens(lens, size)
        points = self.image_points(lens, size)
        if not back:
            return PreparedPixels(size, points)
        there = self.shown_points(lens, size)
        shown = None if there is None else there[..., 0] != OUTSIDE
        return PreparedPixels(size, points, there, shown, self.goes_around(lens, size))

    @in_full_precision
    def ray_channels(self, lens: Lens | None, size: Pair) -> Tensor:
        return ray_channels(*self.pixel_rays(check_lens(lens, size), size))

    def token_positions(self, lens: Lens | None, size: Pair) -> Tensor:
        """The centres of the tokens, (1, H', W', 2): x and y in [-1, 1]."""
        device = lens.theta_max.device if self.uses_lens and lens is not None else None
        y, x = ((2 * torch.arange(side, device=device) + 1) / side - 1 for side in size)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None]

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
        """`PreparedPixels.around`."""
        return None

    def see(
        self, images: Tensor, prepared: PreparedPixels, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        images = self.floating(images, dtype)
        if prepared.points is None:
            return images
        check_count(prepared.points.shape[0], images)
        pixels = sample_at(images, prepared.points)
        assert self.size is not None
        supersampling = prepared.points.shape[2] // self.size[1]
        return pixels if supersampling == 1 else F.avg_pool2d(pixels, supersampling)

    def back(self, maps: Tensor, prepared: PreparedPixels) -> Tensor:
        points = self.back_points(prepared, (maps.shape[2], maps.shape[3]))
        if prepared.around is not None:
            maps = torch.cat((maps[..., -1:], maps, maps[..., :1]), -1)
        return sample_at(maps, points)

    def back_points(self, prepared: PreparedPixels, size: Pair) -> Tensor:
        """The pixels of a map of this size that `back` brings to the pixels of the images,
        (N, H, W, 2). If a view goes `around`, the map has one more column on each side."""
        assert prepared.back is not None
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

    def check_seen(self, sampled: Tensor, prepared: PreparedPixels, channels: int | None) -> Tensor:
        sampled = check_seen_images(sampled, self.size or prepared.size, channels)
        if prepared.points is not None:
            check_count(prepared.points.shape[0], sampled)
        return sampled

    def extra_repr(self) -> str:
        return f"size={self.size}"


def _moved(rays: Tensor, move: Callable[[Tensor], Tensor]) -> Tensor:
    """`move` of vectors (..., 3); NaN where they are, without NaN in the gradients of others."""
    known = ~rays.isnan().any(-1, keepdim=True)
    moved = move(torch.where(known, rays, tensor_there(AXIS, rays)))
    return torch.where(known, moved, torch.nan)


def check_supersampling(number: int | None) -> None:
    """ValueError unless a supersampling is None or an int that a plan of frames can hold."""
    if number is not None and not 1 <= (as_int(number) or 0) <= _MOST:
        raise ValueError(f"supersampling must be an int from 1 to {_MOST}, got {number!r}")


def exact_grid(size: Pair) -> Tensor:
    """The pixels of (H, W), (1, H, W, 2) float64."""
    return pixel_grid(size, torch.zeros((), dtype=torch.float64))


def resized(maps: Tensor, size: Sequence[int]) -> Tensor:
    """Maps (B, K, H', W') in another size, bilinearly; of integers it takes the nearest."""
    if tuple(maps.shape[2:]) == tuple(size):
        return maps
    if maps.is_floating_point():
        return F.interpolate(maps, size, mode="bilinear", align_corners=False)
    return F.interpolate(maps.double(), size, mode="nearest-exact").to(maps.dtype)
