"""Counts kernel launches and finds waits without a GPU, on tensors of the device "meta"."""

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

from darswin.ops import _library

# Operations that only allocate memory or make a view, and launch nothing.
_FREE = {
    "aten::empty.memory_format", "aten::empty_like", "aten::empty_strided", "aten::new_empty",
    "aten::new_empty_strided", "aten::_unsafe_view", "aten::_reshape_alias", "aten::detach",
    "aten::lift_fresh",
}  # fmt: skip
# Our operators that launch several kernels; tests/gpu/test_launches.py counts the launches.
_SEVERAL = {
    "darswin::window_attention_backward": 3,
}  # fmt: skip


class Launches(TorchDispatchMode):
    """A context that counts the operations on the device by name, and in `total`.

    Views and empty tensors do not count. An operation fails on "meta" by itself if it reads a value
    on the host or if its shape depends on a value. A copy between host and device raises an
    AssertionError. An operation of torch counts once, even if it launches several kernels.
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
        # A number on the CPU is passed with the launch and needs no copy.
        given = [t for t in _tensors((args, kwargs)) if t.dim() or "copy" in func.name()]
        mixed = made and {t.device.type for t in given} - made
        assert not mixed, f"{func} copies between host and device"
        if "meta" in made and not _is_view(func) and func.name() not in _FREE:
            self.names[func.name()] += _SEVERAL.get(func.name(), 1)
            if func.namespace == "darswin":  # their kernels read contiguous tensors
                self.names["aten::contiguous"] += sum(not t.is_contiguous() for t in given)
        return out


def _tensors(values: Any) -> Iterator[Tensor]:
    return (v for v in pytree.tree_leaves(values) if isinstance(v, Tensor))


def _is_view(func: Any) -> bool:
    infos = [result.alias_info for result in func._schema.returns]
    return bool(infos) and all(info is not None and not info.is_write for info in infos)


def launches(function: Callable[..., Any], *arguments: Any) -> Counter[str]:
    """The names of the operations that a call launches, with their counts."""
    with Launches() as counted:
        function(*arguments)
    return counted.names


@contextlib.contextmanager
def with_kernels() -> Iterator[None]:
    """A context in which the operators take the path of a GPU with Triton kernels."""
    with mock.patch.object(_library, "has_kernels", lambda tensor: tensor.device.type == "meta"):
        yield
