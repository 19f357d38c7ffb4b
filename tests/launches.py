"""Kernel launches and waits of a device, counted without one: on tensors of the device "meta"."""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

from darswin.ops import _library

# What makes memory, or another tensor of the same memory, and launches nothing.
_FREE = {
    "aten::empty.memory_format", "aten::empty_like", "aten::empty_strided", "aten::new_empty",
    "aten::new_empty_strided", "aten::_unsafe_view", "aten::_reshape_alias", "aten::detach",
    "aten::lift_fresh",
}  # fmt: skip
# Of our operators with kernels, those of several launches: tests/gpu/test_launches.py counts them.
_SEVERAL = {
    "darswin::polar_embed": 2, "darswin::polar_embed_backward": 3,
    "darswin::window_attention_backward": 3,
}  # fmt: skip


class Launches(TorchDispatchMode):
    """Within it, operations on the device are counted: `names`, and their number `total`.

    Views and empty tensors are none. An operation that reads a value on the host, or whose shape
    depends on one, fails on "meta" by itself; a copy between host and device is an AssertionError.
    An operation of torch counts once, though it may take several kernels.
    """

    def __init__(self) -> None:
        super().__init__()
        self.names: Counter[str] = Counter()

    @property
    def total(self) -> int:
        return self.names.total()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        made = {t.device.type for t in _tensors(out)}
        # A number on the CPU comes along with what is launched.
        given = [t for t in _tensors((args, kwargs)) if t.dim() or "copy" in func.name()]
        mixed = made and {t.device.type for t in given} - made
        assert not mixed, f"{func} copies between host and device"
        if "meta" in made and not _is_view(func) and func.name() not in _FREE:
            self.names[func.name()] += _SEVERAL.get(func.name(), 1)
            if func.namespace == "darswin":  # whose kernels read contiguous tensors
                self.names["aten::contiguous"] += sum(not t.is_contiguous() for t in given)
        return out


def _tensors(values: Any) -> Iterator[Tensor]:
    return (v for v in pytree.tree_leaves(values) if isinstance(v, Tensor))


def _is_view(func: Any) -> bool:
    infos = [result.alias_info for result in func._schema.returns]
    return bool(infos) and all(info is not None and not info.is_write for info in infos)


def launches(function: Callable[..., Any], *arguments: Any) -> Counter[str]:
    """The names of what a call launches, and how often."""
    with Launches() as counted:
        function(*arguments)
    return counted.names


@contextlib.contextmanager
def with_kernels() -> Iterator[None]:
    """Within it the operators run as on a GPU that has their kernels, with Triton or without."""
    with mock.patch.object(_library, "has_kernels", lambda tensor: tensor.device.type == "meta"):
        yield
