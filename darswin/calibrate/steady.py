"""Whether all pictures agree on one lens, and how far its rays would turn if they were others."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.calibrate.refine import SHARPEST, Free, Views
from darswin.lens import Lens

FEW = 8  # places of the board
GRID, MOST = 15, 0.95  # of pixels along a side; the part of the rays that is no more unsure
SAME = 0.02  # of the board's size in the picture


class Steadiness(NamedTuple):
    """places: how many places of the board were seen. noise, scatter: rad, of rays, see `unsure`.
    growth, sure: of the scale from the first picture to the last, and by its standard deviation."""

    places: int
    noise: float
    scatter: float
    growth: float
    sure: float


def places(corners: Tensor, seen: Tensor) -> Tensor:
    """(P,): for each picture the first one that shows the board at the same place, as bursts do."""
    found = torch.arange(len(seen))
    there = torch.where(seen[..., None], corners, torch.nan)
    low, high = (torch.where(seen[..., None], corners, end) for end in (math.inf, -math.inf))
    sizes = (high.amax(1) - low.amin(1)).norm(dim=1)
    for k in range(1, len(seen)):
        apart = (there[:k] - there[k]).square().sum(-1).nanmean(1).sqrt()
        same = (apart < SAME * sizes[k]) & (found[:k] == torch.arange(k))
        found[k] = torch.cat((same.nonzero()[:, 0], found[k : k + 1]))[0]
    return found


def unsure(
    free: Free, vector: Tensor, lens: Lens, top: float, noise: Tensor, without: Tensor
) -> tuple[float, float]:
    """rad: the standard deviation of rays up to the angle `top`, after the rotation of all that
    makes it smallest; of 95 % of them, it is no larger. First by the covariance (n, n) for the
    noise of corners, then by the changes (G, n) of the numbers when a place is left out."""
    sides = [torch.linspace(0, side - 1, GRID).to(vector) for side in lens.image_size[0].tolist()]
    lens = lens.with_theta_max(None)
    rays = lens.unproject_points(torch.cartesian_prod(*sides).flip(-1))
    rays = rays[torch.atan2(rays[:, :2].norm(dim=1), rays[:, 2]) <= top]
    slopes = free.slopes(vector, lens.theta_max, rays)
    slopes = slopes[slopes.isfinite().flatten(1).all(1)]
    # The smallest turn of a ray that takes its pixel back.
    by_number, by_turn = slopes.split((len(vector), 3), -1)
    back = torch.linalg.pinv(by_turn)
    turns, aside = back @ by_number, back @ by_turn
    turns = turns - aside @ torch.linalg.lstsq(aside.sum(0), turns.sum(0)).solution
    squares = torch.einsum("kin,nm,kim->k", turns, noise, turns)
    part = 1 - 1 / len(without)
    squares = torch.stack((squares, part * (turns @ without.T).square().sum((1, 2))))
    first, second = squares.clamp(min=0).sqrt().quantile(MOST, dim=1).tolist()
    return first, second


def growth(
    views: Views, lens: Lens, slopes: Tensor, miss: Tensor, counts: Tensor, sigma: float
) -> tuple[float, float]:
    """The growth of the scale from the first picture to the last, and how many standard deviations
    that is; by a step of the scale, the center and the pose of each picture with the lens held."""
    off = views.corners - lens.center[0]
    own = torch.cat((off[..., None], torch.eye(2).to(off).expand(*off.shape, 2)), -1)
    all_ = torch.cat((own, slopes[..., -6:]), -1) * counts[..., None, None]
    all_, side = all_.flatten(1, 2), (miss * counts[..., None]).flatten(1)
    unit = all_.norm(dim=1, keepdim=True).clamp(min=1e-12)
    inverse = torch.linalg.pinv((all_ / unit).mT @ (all_ / unit), hermitian=True)
    scales = -((inverse @ ((all_ / unit).mT @ side[..., None]))[:, 0, 0] / unit[:, 0, 0])
    weight = unit[:, 0, 0].square() / (inverse[:, 0, 0] * max(sigma, SHARPEST) ** 2)
    time = torch.linspace(0, 1, len(scales)).to(scales)
    time = time - (weight * time).sum() / weight.sum()
    size = (weight * time.square()).sum()
    found = (weight * time * scales).sum() / size
    left = (
        weight * (scales - (weight * scales).sum() / weight.sum() - found * time).square()
    ).sum()
    return found.item(), (found * (size / (left / (len(scales) - 2)).clamp(min=1)).sqrt()).item()
