"""Rising functions that have no closed inverse: how far they rise, and their inverse."""

from collections.abc import Callable

import torch
from torch import Tensor

from darswin.ops.waiting import readable

Function = Callable[[Tensor], Tensor]

_STEPS = 40  # of Newton's method or of halving the bracket


def inverse(function: Function, slope: Function, value: Tensor, end: Tensor) -> Tensor:
    """The x in [0, end] at which a function that rises from 0 takes a value.

    Newton's method inside a bracket; a step that would leave it, or is more than half as long as
    the one before, is replaced by the bracket's middle. Two more steps carry the gradients of the
    inverse, to `value` and to whatever `function` and `slope` depend on: each step doubles the
    order of the error, so that derivatives up to the third are exact.

    Args:
        function, slope: of x, elementwise. value: any shape. end: broadcasts to that of x.
    """
    with torch.no_grad():
        last = function(end)
        high = torch.broadcast_tensors(end, value)[0]
        low, x = torch.zeros_like(high), high * (value / last).clamp(0, 1)
        moved = high
        for _ in range(_STEPS):
            error = function(x) - value
            low, high = torch.where(error < 0, x, low), torch.where(error > 0, x, high)
            newton = x - error / slope(x)
            fine = (newton >= low) & (newton <= high) & (2 * (newton - x).abs() <= moved)
            before, x = x, torch.where(fine, newton, (low + high) / 2)
            moved = (x - before).abs()
    for _ in range(2):
        x = x - (function(x) - value) / slope(x)
    return x


@torch.no_grad()
def rising_limit(slope: Function, end: Tensor) -> Tensor:
    """How far functions rise from 0: the first x at which a slope is not positive or overflows, or
    `end`.

    Args:
        slope: of x (N, K), a row a function. end: (N,), how far to look, in 1024 steps.
    """
    steps = torch.linspace(0, 1, 1025, dtype=end.dtype, device=end.device)
    x = end[:, None] * steps
    falls = ~_rises(slope(x))
    if readable(falls) and not falls.any():
        return end  # the usual case
    first = falls.int().argmax(1, keepdim=True)
    low, high = x.gather(1, (first - 1).clamp(min=0)), x.gather(1, first)
    for _ in range(50):
        middle = (low + high) / 2
        rises = _rises(slope(middle))
        low, high = torch.where(rises, middle, low), torch.where(rises, high, middle)
    return torch.where(falls.any(1), low[:, 0], end)


def _rises(slope: Tensor) -> Tensor:
    return (slope > 0) & (slope < torch.inf)
