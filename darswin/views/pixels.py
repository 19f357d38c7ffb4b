"""The views that a network sees as pixels, and the way from their pixels back to the images."""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self, cast, overload

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens import ImplausibleLens, Lens
from darswin.lens.files.load import reach
from darswin.lens.pixels import OUTSIDE, as_map, pixel_grid, ray_channels, sample_at
from darswin.lens.plausible import doubts
from darswin.lens.rig import Camera, Rig
from darswin.lens.solve import length_of
from darswin.ops.checks import as_int, check_pair, tensor_there
from darswin.utils.poses import AXIS
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
from darswin.views.remap import Remap
from darswin.views.rig import RigRemap
from darswin.views.rig_reads import Seam, local
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
        is_surface: whether the view shows places, such as those of the ground, or directions.
    """

    turn = STILL
    tiles: Sequence["PixelView"] = ()
    is_surface = False

    def __init__(
        self, size: Pair | None, *, mean: PerChannel | None = 0.0, std: PerChannel | None = 1.0
    ):
        super().__init__(mean, std)
        if size is not None or self.uses_lens:
            size = check_pair("size", size, 1)
        self.size = size

    @overload
    def at(self, lens: Lens | None, size: Pair) -> Remap: ...

    @overload
    def at(
        self, lens: Rig, *, seam: Seam = "hard", gain: bool = False, distance: float | None = None
    ) -> RigRemap: ...

    def at(self, lens: Any, size: Any = None, **options: Any) -> Any:
        """The map between this view and pictures of (H, W) of one lens, see `Remap`; or those of
        all cameras of a `Rig`, see `RigRemap`, which takes `seam`, `gain` and `distance`.

        Warns:
            ImplausibleLens: a lens without an image_size does not fit pictures of this size.
        """
        if isinstance(lens, Rig):
            if size is not None:
                raise ValueError(f"a rig knows the sizes of its pictures: leave out {size}")
            return RigRemap(self, lens, **options)
        remap = Remap(self, lens, size, **options)
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

    # -- in the level frame of a rig, what `RigRemap` asks for ---------------------------------

    def in_rig(self) -> Self:
        """The same view of a rig; TypeError if the view follows one lens."""
        raise TypeError(
            f"{type(self).__name__} follows one lens, but a rig has several: show it by "
            "GroundView, CameraView or a view of rays, such as equirectangular"
        )

    def of_camera(self, camera: Camera, rig: Rig, distance: float | None) -> "PixelView":
        """What one camera of a rig shows of this view."""
        return _OfCamera(self, camera, rig, distance)

    def places(self, points: Tensor) -> Tensor:
        """Where pixels (1, ..., 2) of the view look, (1, ..., 3): x right, y down and z ahead of a
        rig. Directions, or places in metres if the view `is_surface`; NaN where it shows nothing.
        """
        assert self.size is not None
        return self.to_rays(points, cast(Lens, getattr(self, "lens", None)), self.size)

    def met_by(self, rays: Tensor, origin: Tensor) -> Tensor:
        """The pixels at which rays (1, ..., 3) from a place (3,) meet what the view shows; NaN for
        rays that do not meet it. The inverse of `places`."""
        assert self.size is not None
        return self.to_points(rays, cast(Lens, getattr(self, "lens", None)), self.size)

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
        check_count(prepared.points.shape[0], images.shape[0])
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
            check_count(prepared.points.shape[0], sampled.shape[0])
        return sampled

    def extra_repr(self) -> str:
        return f"size={self.size}"


class _OfCamera(PixelView):
    """What one camera of a rig shows of a view. `distance` is that of `RigRemap`."""

    def __init__(self, view: PixelView, camera: Camera, rig: Rig, distance: float | None):
        super().__init__(view.size, mean=view.mean, std=view.std)
        self.view, self.distance = view, distance
        self._local = partial(local, camera, rig)
        self._turn = torch.from_numpy(rig.level.T @ camera.pose[:3, :3])  # to the level frame
        self._origin = torch.from_numpy(camera.pose[:3, 3] @ rig.level)
        self._middle = torch.from_numpy(rig.middle @ rig.level)

    def to_rays(self, points: Tensor, lens: Any, size: Pair) -> Tensor:
        at = self.view.places(points)
        if self.distance is not None:
            at = self.distance * at + self._middle
        are_places = self.view.is_surface or self.distance is not None
        return F.normalize(torch.from_numpy(self._local(at.numpy(), are_places)), dim=-1)

    def to_points(self, rays: Tensor, lens: Any, size: Pair) -> Tensor:
        rays = rays @ self._turn.T
        if self.distance is not None:  # where it meets the sphere around the middle
            out = self._origin - self._middle
            along = (rays * out).sum(-1, keepdim=True)
            rays = out + rays * ((along**2 - out @ out + self.distance**2).sqrt() - along)
        return self.view.met_by(rays, self._origin)


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
