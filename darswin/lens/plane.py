"""Maps of the plane onto itself: their derivatives, and where they take a value."""

import torch
from torch import Tensor

from darswin.lens.base import length_of
from darswin.lens.inverse import Function
from darswin.ops.waiting import readable


def newton(
    function: Function,
    slopes: Function,
    goal: Tensor,
    point: Tensor,
    end: Tensor,
    rounds: int = 60,
) -> Tensor:
    """Where a map of the plane takes the value `goal`.

    Newton's steps, each shortened until it comes nearer to the goal and stays where the map keeps
    its orientation. From a point where it does, they end at the goal or at a fold of the map.

    Args:
        function: (..., 2) → (..., 2). slopes: (..., 2) → (..., 2, 2), its derivatives.
        goal, point: (n, 2), or any shape where it is not `readable`.
        end: how far from the origin to look.
    """
    found, places = point.clone(), torch.arange(len(point), device=point.device)
    error = function(point) - goal
    step, missed, part = (
        solve(slopes(point), error),
        length_of(error),
        torch.ones_like(error[..., 0]),
    )
    for _ in range(rounds):
        trial = point - part[..., None] * step
        error, slope = function(trial) - goal, slopes(trial)
        better = (length_of(error) < missed) & (determinant(slope) > 0) & (length_of(trial) <= end)
        point = torch.where(better[..., None], trial, point)
        step = torch.where(better[..., None], solve(slope, error), step)
        missed = torch.where(better, length_of(error), missed)
        part = torch.where(better, (2 * part).clamp(max=1), part / 4)
        if not readable(missed):
            continue  # no shape depends on values
        found[places] = point
        going = missed > 16 * torch.finfo(goal.dtype).eps * (1 + length_of(goal))
        going &= part > 1e-6
        if not going.any():
            return found
        places, goal, point, step, missed, part = (
            x[going] for x in (places, goal, point, step, missed, part)
        )
    found[places] = point
    return found


def determinant(matrix: Tensor) -> Tensor:
    """The determinants (...) of matrices (..., 2, 2)."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    return a * d - b * c


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """(..., 2, 2)⁻¹ @ (..., 2)."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    solved = torch.stack((d * x - b * y, a * y - c * x), -1)
    return solved / determinant(matrix)[..., None]


def radial_slopes(ratio: Tensor, slope: Tensor, direction: Tensor) -> Tensor:
    """(..., 2, 2): the derivatives of a radial map, `ratio` across and `slope` along a radius."""
    along = direction[..., :, None] * direction[..., None, :]
    across = torch.eye(2, dtype=ratio.dtype, device=ratio.device) - along
    return ratio[..., None, None] * across + slope[..., None, None] * along
