"""The way back from a polar map: what it shows, and maps of other sizes and of integers."""

import math

import torch
from torch import Tensor

from darswin.lens.solve import direction_of, length_of
from darswin.ops.reference import on_polar_plane
from darswin.views.base import Pair, PixelGrid
from darswin.views.pixels import resized


def shown_by(grid: PixelGrid, size: Pair) -> Tensor:
    """True for the pixels of images of (H, W) that a polar map reaches, (N, H, W)."""
    points = grid.points
    if points is None:
        assert grid.center is not None
        points = on_polar_plane(size, grid.center, grid.affine)
    return length_of(points.detach()) <= grid.r_max.detach()[:, None, None]


def resized_around(maps: Tensor, size: Pair) -> Tensor:
    """Polar images (B, K, R, A) in another size. The first sector follows the last one."""
    whole, rest = divmod(size[1], maps.shape[3])
    if rest or tuple(maps.shape[2:]) == size:
        return resized(maps, size)
    maps = torch.cat((maps[..., -1:], maps, maps[..., :1]), -1)
    return resized(maps, (size[0], size[1] + 2 * whole))[..., whole : whole + size[1]]


def from_edges(maps: Tensor, samples: Pair) -> Tensor:
    """Polar images whose samples (S_r, S_φ) of each cell are from border to border, at the centres
    of equal cells instead. The nearest sample of a centre has its number, as for integers."""
    for dim, count in zip((2, 3), samples, strict=True):
        number = torch.arange(count, dtype=maps.dtype, device=maps.device)
        position = (number + 0.5) * ((count - 1) / count)
        weights = (1 - (position[:, None] - number).abs()).clamp(min=0)
        cells = maps.movedim(dim, -1).unflatten(-1, (-1, count))
        maps = (cells @ weights.T).flatten(-2).movedim(-1, dim)
    return maps


def places_of(maps: Tensor) -> Tensor:
    """The places in polar maps (B, R, A, K), (1, R, A, 3): cos φ, sin φ, the number of the ring."""
    rings, sectors = maps.shape[1:3]
    ring, sector = (torch.arange(side, device=maps.device) for side in (rings, sectors))
    along = direction_of((sector + 0.5) * (2 * math.pi / sectors)).expand(rings, -1, -1)
    return torch.cat((along, ring[:, None, None].expand(-1, sectors, 1)), -1)[None]


def nearest(maps: Tensor, there: Tensor, shown: Tensor) -> Tensor:
    """The values of polar maps (B, R, A, K) that are nearest to the pixels of the images, whose
    `places_of` the maps came back as `there`, (N, 3, H, W): (B, K, H, W), 0 unless `shown`."""
    _, rings, sectors, channels = maps.shape
    c, s, ring = there.unbind(1)
    column = torch.floor(torch.atan2(s, c) * (sectors / (2 * math.pi))).long() % sectors
    index = (ring.round().long().clamp(0, rings - 1) * sectors + column).flatten(1)
    index = index[:, :, None].expand(maps.shape[0], -1, channels)
    values = maps.flatten(1, 2).gather(1, index).movedim(2, 1).unflatten(2, shown.shape[1:])
    return torch.where(shown.to(maps.device)[:, None], values, 0)
