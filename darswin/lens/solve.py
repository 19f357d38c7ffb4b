"""Inverses of rising functions and of maps of the plane, and the limits up to which they rise."""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch._higher_order_ops.while_loop import while_loop
from torch.autograd import forward_ad

from darswin.ops._library import no_gradients, transformed
from darswin.ops.checks import readable

Function = Callable[[Tensor], Tensor]
State = tuple[Tensor, ...]

_STEPS = 40  # Newton steps or bisections
_TABLE = 1024  # entries of a table of the function
_HAS_LOOPS = torch.__version__ >= "2.12"  # torch.onnx of 2.10 cannot translate a loop


def inverse(function: Function, slope: Function, value: Tensor, end: Tensor) -> Tensor:
    """The x in [0, end] at which a function that rises from 0 has a value, elementwise.

    Newton's method within a bracket. A step that leaves the bracket, or is more than half as long
    as the step before, is replaced by a bisection. Two more steps carry the gradients of the
    inverse, to `value` and to the tensors that `function` and `slope` use: each step doubles the
    order of the error, so derivatives up to the third are exact.
    """
    with no_gradients(), forward_ad._set_fwd_grad_enabled(False):
        low, high, x = _brackets(function, value, end)
        eps = torch.finfo(x.dtype).eps
        # After a Newton step of this length, x is exact to rounding.
        near = math.sqrt(eps) * end

        def nearer(low: Tensor, high: Tensor, x: Tensor, moved: Tensor) -> State:
            error = function(x) - value
            low, high = torch.where(error < 0, x, low), torch.where(error > 0, x, high)
            step = error / slope(x)
            newton, length = x - step, step.abs()
            fine = (newton >= low) & (newton <= high) & (2 * length <= moved)
            fine = fine | (length <= near)  # rounding may take it across an end of the bracket
            before, x = x, torch.where(fine, newton, (low + high) / 2)
            return low, high, x, (x - before).abs()

        rounds = min(_STEPS, 1 - round(math.log2(eps)))  # more halvings change nothing
        start = low, high, x, high - low
        _, _, x, _ = repeated(nearer, lambda *state: state[-1] > near, start, rounds)
    for _ in range(gradient_steps()):
        x = x - (function(x) - value) / slope(x)
    return x


def gradient_steps() -> int:
    """The number of Newton steps after the search, which carry the gradients; a graph has none."""
    return 0 if torch.compiler.is_exporting() else 2


def repeated(
    step: Callable[..., State], going: Callable[..., Tensor], state: State, rounds: int
) -> State:
    """The state after calls of `step(*state)`, which end after `rounds` or when `going(*state)` is
    true nowhere. An exported graph has one loop for it, if torch can write that."""
    if _HAS_LOOPS and torch.compiler.is_exporting():
        # The state of a loop keeps its strides.
        dense = (x.clone(memory_format=torch.contiguous_format) for x in state)
        start = torch.zeros((), dtype=torch.int64, device=state[0].device), *dense
        return while_loop(
            lambda count, *state: (count < rounds) & going(*state).any(),
            lambda count, *state: (count + 1, *step(*state)),
            start,
        )[1:]
    stops = _stops(state[0])
    for _ in range(rounds):
        state = step(*state)
        if stops and not going(*state).any():
            break
    return state


def _stops(value: Tensor) -> bool:
    """Whether the number of steps may depend on values."""
    return readable(value) and not transformed()


def _brackets(function: Function, value: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Below and above the x of `inverse`, and a first guess of it."""
    high = torch.broadcast_tensors(end, value)[0]
    # The sizes come last: a graph would get a limit of them.
    if not _stops(value) or end.dim() == 0 or high.numel() <= 4 * _TABLE * end.numel():
        return torch.zeros_like(high), high, high * (value / function(end)).clamp(0, 1)
    # With one end for many values, as for the pixels of an image: from a table.
    steps = torch.linspace(0, 1, _TABLE, dtype=end.dtype, device=end.device)
    points = end.reshape(-1, 1) * steps
    table, rows = function(points), value.expand_as(high).reshape(len(points), -1).contiguous()
    after = torch.searchsorted(table, rows).clamp(1, _TABLE - 1)
    (x0, y0), (x1, y1) = ((points.gather(1, k), table.gather(1, k)) for k in (after - 1, after))
    guess = x0 + (x1 - x0) * ((rows - y0) / (y1 - y0)).clamp(0, 1)
    return x0.view_as(high), x1.view_as(high), guess.view_as(high)


def rising_limit(slope: Function, end: Tensor) -> Tensor:
    """The first x, (N,), at which a slope is not positive or overflows; `end`, (N,), if there is
    none among 1024 steps from 0 to `end`. It has no derivatives."""

    def rises(x: Tensor) -> Tensor:
        value = slope(x)
        return (value > 0) & (value < torch.inf)

    with no_gradients(), forward_ad._set_fwd_grad_enabled(False):
        low, high = torch.zeros_like(end)[:, None], end[:, None]
        for steps in (1024, *[32] * 10):  # down to rounding
            parts = torch.linspace(0, 1, steps + 1, dtype=end.dtype, device=end.device)
            x = low + (high - low) * parts
            falls = ~rises(x)
            if steps == 1024:
                if readable(falls) and not falls.any():
                    return end  # the usual case
                ends = falls.any(1)
            first = falls.int().argmax(1, keepdim=True)
            low, high = x.gather(1, (first - 1).clamp(min=0)), x.gather(1, first)
        return torch.where(ends, low[:, 0], end)


def newton(
    function: Callable[[Tensor], tuple[Tensor, Tensor]], goal: Tensor, point: Tensor, end: Tensor,
    rounds: int = 60,
) -> Tensor:  # fmt: skip
    """The points that a map of the plane takes to `goal`.

    Each Newton step is shortened until it comes nearer to the goal, at a point where the map keeps
    its orientation. From a start with that orientation, the steps end at the goal or at a fold.

    Args:
        function: (..., 2) → (..., 2) and (..., 2, 2), its derivatives.
        goal, point: (n, 2), or any shape if it is not `readable`.
        end: the largest distance from the origin.
    """

    def nearer(goal: Tensor, point: Tensor, step: Tensor, missed: Tensor, part: Tensor) -> State:
        trial = point - part[..., None] * step
        image, slope = function(trial)
        error = image - goal
        better = (length_of(error) < missed) & (determinant(slope) > 0) & (length_of(trial) <= end)
        point = torch.where(better[..., None], trial, point)
        step = torch.where(better[..., None], solve(slope, error), step)
        missed = torch.where(better, length_of(error), missed)
        return point, step, missed, torch.where(better, (2 * part).clamp(max=1), part / 4)

    def going(goal: Tensor, missed: Tensor, part: Tensor) -> Tensor:
        return (missed > 16 * torch.finfo(goal.dtype).eps * (1 + length_of(goal))) & (part > 1e-6)

    image, slope = function(point)
    missed = length_of(image - goal)
    state: State = point, solve(slope, image - goal), missed, torch.ones_like(missed)
    if not readable(point):  # no shape depends on values
        return repeated(
            partial(nearer, goal), lambda *state: going(goal, *state[2:]), state, rounds
        )[0]
    points, indices = point.clone(), torch.arange(len(point))
    for _ in range(rounds):
        state = nearer(goal, *state)
        points[indices] = state[0]
        left = going(goal, *state[2:])
        if not left.any():
            break
        indices, goal = indices[left], goal[left]
        state = tuple(x[left] for x in state)
    return points


def length_of(points: Tensor) -> Tensor:
    """The length of (..., 2), never 0, where a square root has no slope."""
    x, y = points.square().unbind(-1)  # ONNX Runtime cannot reduce one axis of an empty tensor
    return (x + y).clamp(min=1e-12 * torch.finfo(points.dtype).eps).sqrt()


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
    """(..., 2, 2): the derivatives of a radial map: `slope` along a radius, `ratio` across it."""
    along = direction[..., :, None] * direction[..., None, :]
    across = torch.eye(2, dtype=ratio.dtype, device=ratio.device) - along
    return ratio[..., None, None] * across + slope[..., None, None] * along


def direction_of(azimuth: Tensor) -> Tensor:
    """(..., 2): cos φ and sin φ."""
    return torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)


def vector_of(theta: Tensor, direction: Tensor) -> Tensor:
    """(..., 3): the unit vectors (x, y, z) of rays at θ in directions (cos φ, sin φ); where θ is
    NaN, NaN without a gradient."""
    known = ~theta.isnan()[..., None]
    angle = torch.where(known, theta[..., None], 0.0)  # NaN must not reach the gradients
    rays = torch.cat((torch.sin(angle) * direction, torch.cos(angle)), -1)
    return torch.where(known, rays, torch.nan)
