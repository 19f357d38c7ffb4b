"""Several stereographic pictures that cover what a camera sees, for a network that runs on each."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import OUTSIDE, as_map, pixel_grid, sample_at
from darswin.ops.checks import as_int
from darswin.utils.angles import degrees_hint
from darswin.utils.poses import AXIS, PICTURE_TOP, frame_of
from darswin.views.base import (
    Pair,
    PerChannel,
    PreparedPixels,
    check_count,
    check_seen_images,
)
from darswin.views.directions import check_sees
from darswin.views.orientation import Vector, unit_vector
from darswin.views.pixels import PixelView
from darswin.views.registry import register_view
from darswin.views.stereographic import StereographicView

# For each count: whether a tile is in the middle; and in degrees, for fields of view from 165°, the
# angle of the others from the middle, their first azimuth, and the field of view of a tile.
_LAYOUTS = {
    4: (False, 45, 0, 105),
    5: (True, 60, 0, 85),
    6: (True, 60, -90, 85),
    7: (True, 60, 0, 80),
    8: (True, 65, -90, 80),
    9: (True, 65, 0, 80),
}
_WHOLE = math.radians(165)  # for wider lenses, tiles that look farther aside found no more


@register_view("tiles")
class TilesView(PixelView):
    """4 to 9 stereographic pictures that together cover what a camera sees.

    A network sees B·n images, the n tiles of each image in turn. Its maps come back to the pixels
    of the images: each pixel takes the tile in which it is farthest from a border. A `LensAdapter`
    warps boxes back and merges those of all tiles. Each tile is level with `up`.

    Args:
        size: (H', W') of a tile. Tiles that are much smaller than 512 pixels find less than one
            view of the whole picture.
        count: n, from 4 to 9.
        fov: the horizontal field of view that the tiles cover together, rad. The default suits
            lenses of 165° and more.
        theta_max: the largest incident angle that is shown, rad; None means θ_max of each lens.
        tile_fov: the horizontal field of view of a tile, rad; None suits `count` and `fov`.
        directions: (n, 3), the middles of the tiles in the camera's frame, in place of `count`,
            `fov` and `direction`; `tile_fov` must be given too.
        up, direction, supersampling: see `RayView`; `direction` is the middle of the whole.
        mean, std: the arguments of `View`.

    Raises:
        ValueError: `count` is not in 4 … 9, or an argument is wrong as for `RayView`.
    """

    size: Pair
    tiles: Sequence[StereographicView]

    def __init__(
        self,
        size: Pair,
        count: int = 5,
        fov: float = _WHOLE,
        theta_max: float | None = None,
        *,
        tile_fov: float | None = None,
        directions: Sequence[Vector] | None = None,
        up: Vector | None = None,
        direction: Vector | None = None,
        supersampling: int | None = None,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(size, mean=mean, std=std)
        if not 0 < fov <= 2 * math.pi:
            raise ValueError(f"fov must be in (0, 2π] rad, got {fov}{degrees_hint(fov)}")
        if directions is None:
            if as_int(count) not in _LAYOUTS:
                raise ValueError(
                    f"count must be from {min(_LAYOUTS)} to {max(_LAYOUTS)}, got {count}"
                )
            share = min(1.0, fov / _WHOLE)
            directions = _directions(count, share, up, direction)
            if tile_fov is None:
                tile_fov = math.radians(_LAYOUTS[count][3]) * share
        elif tile_fov is None or not len(directions):
            raise ValueError("directions must be one or more, and be given with tile_fov")
        elif (count, fov) != (5, _WHOLE) or direction is not None:
            raise ValueError("directions stand in for count, fov and direction: leave these out")
        if not 0 < tile_fov <= StereographicView.widest:
            hint = degrees_hint(tile_fov)
            raise ValueError(
                f"tile_fov must be in (0, {StereographicView.widest:.4g}] rad, got {tile_fov}{hint}"
            )
        self.tiles = [
            StereographicView(
                size,
                tile_fov,
                theta_max,
                up=up,
                direction=middle,
                supersampling=supersampling,
                mean=mean,
                std=std,
            )
            for middle in directions
        ]
        self.count = len(self.tiles)

    def image_points(self, lens: Lens, size: Pair) -> Tensor:
        """The points of the tiles below each other, (N, n·H', W', 2) px."""
        points = torch.cat([tile.read_points(lens, size) for tile in self.tiles], 1)
        return check_sees(points, self, lens, size)

    def shown_points(self, lens: Lens, size: Pair) -> Tensor:
        return self.view_points(lens, size)

    def view_points(self, lens: Lens, size: Pair) -> Tensor:
        """The points of the tiles below each other that the pixels of the images show, and
        `OUTSIDE` beyond the tiles."""
        height, width = self.size
        best = torch.full((1,), -0.5)
        points = torch.full((1, 2), OUTSIDE)
        best, points = best.to(lens.theta_max), points.to(lens.theta_max)
        grid = pixel_grid(size, lens.theta_max)
        for k, tile in enumerate(self.tiles):
            x, y = as_map(tile.to_view(grid, lens, size)).unbind(-1)
            margin = torch.stack((x, width - 1 - x, y, height - 1 - y)).amin(0)
            inner = margin > best
            best = torch.where(inner, margin, best)
            # A point just above the lower edge must not round to the next tile.
            point = torch.stack((x, y.clamp(max=height - 0.51) + k * height), -1)
            points = torch.where(inner[..., None], point, points)
        return points

    def pixel_rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        theta, direction = zip(*(tile.pixel_rays(lens, size) for tile in self.tiles), strict=True)
        return torch.cat(theta, 1), torch.cat(direction, 1)

    def supersampling_of(self, lens: Lens, size: Pair) -> int:
        return self.tiles[0].supersampling_of(lens, size)

    def see(
        self, images: Tensor, prepared: PreparedPixels, dtype: torch.dtype = torch.float32
    ) -> Tensor:
        rows = self.tiles[0].see(images, prepared, dtype)
        return rows.unflatten(2, (self.count, -1)).transpose(1, 2).flatten(0, 1)

    def back(self, maps: Tensor, prepared: PreparedPixels) -> Tensor:
        assert prepared.back is not None
        rows = prepared.back[..., 1]
        tile = torch.floor((rows + 0.5) / self.size[0])
        inner = torch.stack((prepared.back[..., 0], rows - tile * self.size[0]), -1)
        size, first = (maps.shape[2], maps.shape[3]), self.tiles[0]
        x, y = first.within(first.scaled(inner, size), size).unbind(-1)
        points = torch.stack((x, y + tile * maps.shape[2]), -1)
        stacked = maps.unflatten(0, (-1, self.count)).transpose(1, 2).flatten(2, 3)
        return sample_at(stacked, torch.where(prepared.back == OUTSIDE, OUTSIDE, points))

    def check_seen(self, sampled: Tensor, prepared: PreparedPixels, channels: int | None) -> Tensor:
        sampled = check_seen_images(sampled, self.size, channels)
        if sampled.shape[0] % self.count:
            raise ValueError(
                f"sampled must have {self.count} tiles for each image, got {sampled.shape[0]}"
            )
        assert prepared.points is not None
        check_count(prepared.points.shape[0], sampled.shape[0] // self.count)
        return sampled

    def rays(self, lens: Lens, size: Pair) -> Tensor:
        """The rays of the pixels of the tiles, unit vectors (N, n, H', W', 3); see `RayView`."""
        return torch.stack([tile.rays(lens, size) for tile in self.tiles], 1)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, count={self.count}, of {self.tiles[0].extra_repr()}"


def _directions(
    count: int, share: float, up: Vector | None, direction: Vector | None
) -> list[list[float]]:
    """The middles of the tiles of a layout, level with `up`."""
    in_middle, angle, first, _ = _LAYOUTS[count]
    axis = unit_vector("direction", AXIS if direction is None else direction)
    frame = np.array(frame_of(unit_vector("up", PICTURE_TOP if up is None else up), axis, False))
    around = count - in_middle
    azimuth = math.radians(first) + np.arange(around) * (2 * math.pi / around)
    theta = np.full(around, math.radians(angle) * share)
    flat = np.sin(theta) * (np.cos(azimuth), np.sin(azimuth))
    ring = np.stack((*flat, np.cos(theta)), 1) @ frame.T
    return [list(axis)] * in_middle + ring.tolist()
