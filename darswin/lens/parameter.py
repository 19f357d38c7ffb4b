"""The parameters of a lens model: each is declared once, with its shape, range and unit."""

import inspect
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

Number = float | Sequence[float] | Sequence[Sequence[float]] | Tensor


@dataclass(frozen=True, eq=False)
class Parameter:
    """A parameter of a lens class: `xi = Parameter(low=0)` in the body of the class.

    Args:
        low, high: its least and its largest value. open: these two are excluded.
        shape: of one lens's values, () for a number; None stands for any length.
        optional: it may be None. by_place: it is given without its name, though it is optional.
        in_pixels: it grows with the image.
        starts: values that `fit` starts from. bounds: of `fit`; None means low and high.
    """

    low: float = -math.inf
    high: float = math.inf
    _: KW_ONLY
    open: bool = False
    shape: tuple[int | None, ...] = ()
    optional: bool = False
    by_place: bool = False
    in_pixels: bool = False
    starts: tuple[float, ...] = ()
    bounds: tuple[float, float] | None = None

    if TYPE_CHECKING:  # a class's declaration is a lens's attribute, a tensor

        def __get__(self, lens: object, owner: type) -> Any: ...

        def __set__(self, lens: object, value: object) -> None: ...

    def rows(self, name: str, value: Tensor) -> Tensor:
        """The value as (N or 1, ...); ValueError for another shape."""
        rows = value[None] if value.dim() == len(self.shape) else value
        if rows.dim() != len(self.shape) + 1 or any(
            side not in (None, given)
            for side, given in zip(self.shape, rows.shape[1:], strict=True)
        ):
            one = ", ".join("K" if side is None else str(side) for side in self.shape)
            form = f"({one}) or (N, {one})" if one else "a number or (N,)"
            raise ValueError(f"{name} must be {form}, got shape {tuple(value.shape)}")
        return rows

    def holds(self, value: Tensor) -> Tensor:
        """True for each lens, (N,), whose values are in range."""
        value, low, high = value.detach(), self.low, self.high
        above = value > low if self.open or low == -math.inf else value >= low
        below = value < high if self.open or high == math.inf else value <= high
        inside = above & below  # NaN and infinities are not
        return inside.flatten(1).all(1) if self.shape else inside

    @property
    def range(self) -> str:
        """The range in words, for errors."""
        if self.high < math.inf:
            left, right = "()" if self.open else "[]"
            return f"in {left}{self.low:g}, {self.high:g}{right}"
        if self.low == -math.inf:
            return "finite"
        return f"finite and {'above' if self.open else 'at least'} {self.low:g}"


def signature(
    required: Iterable[str], optional: Iterable[str], by_name: Iterable[str]
) -> inspect.Signature:
    """The signature of a constructor."""
    kind = inspect.Parameter
    return inspect.Signature(
        [
            *(kind(name, kind.POSITIONAL_OR_KEYWORD) for name in required),
            *(kind(name, kind.POSITIONAL_OR_KEYWORD, default=None) for name in optional),
            *(kind(name, kind.KEYWORD_ONLY, default=None) for name in by_name),
        ]
    )


def bind(
    function: str, signature: inspect.Signature, arguments: tuple, named: Mapping[str, Any]
) -> dict[str, Any]:
    """The arguments by their names, but for those that are None; TypeError for wrong ones."""
    try:
        given = signature.bind(*arguments, **named).arguments
    except TypeError as error:
        raise TypeError(f"{function}{signature}: {error}") from error
    return {name: value for name, value in given.items() if value is not None}


def as_tensors(values: Mapping[str, Number]) -> dict[str, Tensor]:
    """All values as tensors of one dtype and device: those of the tensors among them, if any."""
    given = [v for v in values.values() if isinstance(v, Tensor) and v.is_floating_point()]
    dtype, device = torch.get_default_dtype(), None
    if given:
        dtype, device = reduce(torch.promote_types, (v.dtype for v in given)), given[0].device
    tensors = {}
    for name, value in values.items():
        try:
            tensors[name] = torch.as_tensor(value, dtype=dtype, device=device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(f"{name} must be a number or a tensor, got {value!r}") from error
    return tensors
