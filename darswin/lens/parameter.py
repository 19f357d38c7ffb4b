"""The parameters of a lens model: each is declared once, with its shape, range and unit."""

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import reduce
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from darswin.utils.arrays import as_tensor
from darswin.utils.nearest import add_meant

Number = float | Sequence[float] | Sequence[Sequence[float]] | Tensor


@dataclass(frozen=True, eq=False)
class Parameter:
    """A parameter of a lens class: `xi = Parameter(low=0)` in the body of the class.

    Args:
        low, high: the smallest and the largest value. open: True excludes these two.
        shape: of one lens's values, () for a number; None stands for any length.
        optional: the parameter may be None.
        by_place: an optional parameter may be given without its name.
        in_pixels: the parameter scales with the image.
        angle: the parameter is in radians.
        starts: initial values for `fit`. bounds: the range in `fit`; None means low and high.
    """

    low: float = -math.inf
    high: float = math.inf
    _: KW_ONLY
    open: bool = False
    shape: tuple[int | None, ...] = ()
    optional: bool = False
    by_place: bool = False
    in_pixels: bool = False
    angle: bool = False
    starts: tuple[float, ...] = ()
    bounds: tuple[float, float] | None = None

    if TYPE_CHECKING:  # declared on the class, but a tensor on a lens

        def __get__(self, lens: object, owner: type) -> Any: ...

        def __set__(self, lens: object, value: object) -> None: ...

    def rows(self, name: str, value: Tensor) -> Tensor:
        """The value with shape (N or 1, ...); ValueError for a wrong shape."""
        rows = value[None] if value.dim() == len(self.shape) else value
        sides = rows.shape[1:]
        if rows.dim() != len(self.shape) + 1 or any(
            side is not None and side != length
            for side, length in zip(self.shape, sides, strict=True)
        ):
            lengths = ", ".join("K" if side is None else str(side) for side in self.shape)
            form = f"({lengths}) or (N, {lengths})" if lengths else "a number or (N,)"
            raise ValueError(f"{name} must be {form}, got shape {tuple(value.shape)}")
        return rows

    def holds(self, value: Tensor) -> bool:
        """True if all values are finite and in range."""
        if not value.numel():
            return True
        least, most = (end.item() for end in value.detach().aminmax())
        if not (math.isfinite(least) and math.isfinite(most)):  # a NaN makes both NaN
            return False
        if self.open:
            return self.low < least and most < self.high
        return self.low <= least and most <= self.high

    @property
    def range(self) -> str:
        """The range in words, for errors."""
        if self.high < math.inf:
            left, right = "()" if self.open else "[]"
            return f"in {left}{self.low:g}, {self.high:g}{right}"
        if self.low == -math.inf:
            return "finite"
        return f"finite and {'above' if self.open else 'at least'} {self.low:g}"


class Arguments:
    """The arguments of a constructor: required, optional by place, and optional by name."""

    def __init__(self, required: Sequence[str], optional: Sequence[str], by_name: Sequence[str]):
        self.positional, self.required = (*required, *optional), {*required}
        self.known = {*self.positional, *by_name}
        kind = inspect.Parameter
        self.signature = inspect.Signature(
            [
                *(kind(name, kind.POSITIONAL_OR_KEYWORD) for name in required),
                *(kind(name, kind.POSITIONAL_OR_KEYWORD, default=None) for name in optional),
                *(kind(name, kind.KEYWORD_ONLY, default=None) for name in by_name),
            ]
        )

    def bind(
        self, function: str, arguments: Sequence[Any], named: dict[str, Any]
    ) -> dict[str, Any]:
        """The values that are not None, by name; TypeError for wrong arguments."""
        bound = dict(zip(self.positional, arguments, strict=False)) | named
        all_bound = len(bound) == len(arguments) + len(named)
        if not (all_bound and self.required <= bound.keys() <= self.known):
            try:
                self.signature.bind(*arguments, **named)  # its error describes the mistake
            except TypeError as error:
                add_meant(error, self.known)
                raise TypeError(f"{function}{self.signature}: {error}") from error
        return {name: value for name, value in bound.items() if value is not None}


def as_tensors(values: Mapping[str, Number]) -> dict[str, Tensor]:
    """All values as tensors of one dtype and device, which the tensors among them determine."""
    floats = [v for v in values.values() if isinstance(v, Tensor) and v.is_floating_point()]
    dtypes = (tensor.dtype for tensor in floats)
    dtype = reduce(torch.promote_types, dtypes) if floats else torch.get_default_dtype()
    device = floats[0].device if floats else None
    tensors = {}
    for name, value in values.items():
        try:
            tensors[name] = as_tensor(value, dtype, device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(f"{name} must be a number or a tensor, got {value!r}") from error
    return tensors
