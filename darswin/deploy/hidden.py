"""What a network must not read while its program is written.

A program fits any number of pictures and any lens, but a branch in Python is taken once. So a
network that compares the number of pictures, or numbers of the lens, is refused.
"""

from collections.abc import Callable
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.overrides import resolve_name
from torch.utils import _pytree as pytree

from darswin.deploy.program import NoProgramError


def name_of(function: Any) -> str:
    """The name of a function of torch or of ours."""
    return resolve_name(function) or getattr(function, "__name__", str(function))


def refuse(function: Any, reason: object = None) -> NoReturn:
    """NoProgramError for a function."""
    because = "" if reason is None else f": {reason}"
    raise NoProgramError(f"{name_of(function)} is no instruction{because}")


class Pictures(int):
    """The number of pictures. A network may make shapes of it, but not compute with it."""


def _compute(*_: Any) -> NoReturn:
    raise NoProgramError("a computation with the number of pictures is no instruction")


for _name in vars(int).keys() - {"__new__", "__index__", "__repr__", "__format__", "__doc__"}:
    setattr(Pictures, _name, _compute)
del Pictures.__getattribute__
PICTURES = Pictures(10_007)  # while a program is written; no axis is as long

# What torch makes of a tensor for Python: numbers, or shapes that depend on them.
_NUMBERS = {
    "__bool__", "__int__", "__float__", "__complex__", "__index__", "__contains__", "__array__",
    "item", "tolist", "numpy", "equal", "allclose", "is_nonzero", "nonzero", "argwhere", "unique",
    "masked_select",
}  # fmt: skip


class OfLens(Tensor):
    """A tensor that depends on the lens. A program has it as an input, whatever its numbers are."""

    @classmethod
    def __torch_function__(cls, function, types, arguments=(), named=None):
        if not all(issubclass(cls, kind) for kind in types):
            return NotImplemented
        if getattr(function, "__name__", "") in _NUMBERS:
            refuse(function, "it reads numbers that depend on the lens")
        run = super().__torch_function__
        return unchanged(function, lambda *a, **n: run(function, types, a, n), arguments, named)


def unchanged(function: Any, run: Callable, arguments: Any, named: dict[str, Any] | None) -> Any:
    """What a function returns, which must not write in the tensors that it takes."""
    leaves = pytree.tree_leaves((arguments, named))
    tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
    with torch._C.DisableTorchFunctionSubclass():
        before = [*map(state_of, tensors)]
        result = run(*arguments, **(named or {}))
        if before != [*map(state_of, tensors)]:
            refuse(function, "it writes in place")
    return result


def state_of(tensor: Tensor) -> tuple:
    """What changes when a function writes in a tensor. Torch itself keeps inference tensors."""
    version = 0 if tensor.is_inference() else tensor._version
    return version, tensor.shape, tensor.stride(), tensor.untyped_storage()._cdata
