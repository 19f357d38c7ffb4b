"""A device "other" whose tensors hold ones of the CPU: a GPU without a GPU, for tests of programs.

Everything has its values, an operation on tensors of both devices fails as it does on a GPU, and
autocast casts the arguments of matrix products and convolutions, as there.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode

NAME = "other"
aten = torch.ops.aten
# These may take tensors of both devices.
BOTH = (aten.copy_.default, aten._to_copy.default, aten.index.Tensor)
# What autocast makes of arguments; that of CUDA widens those of `grid_sampler`.
AUTOCAST = {
    "conv2d": torch.bfloat16,
    "grid_sampler": torch.float32,
    "linear": torch.bfloat16,
    "matmul": torch.bfloat16,
}


class Other(Tensor):
    """A tensor on the device."""

    held: Tensor  # on the CPU
    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @staticmethod
    def __new__(cls, held: Tensor) -> "Other":
        return Tensor._make_wrapper_subclass(
            cls, held.shape, held.stride(), held.storage_offset(),
            dtype=held.dtype, device=torch.device(NAME, 0),
        )  # fmt: skip

    def __init__(self, held: Tensor):
        self.held = held

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _compute(func, args, kwargs or {})


class OtherDevice(TorchDispatchMode):
    """A context in which the device exists. After it, torch keeps the device's name."""

    def __init__(self) -> None:
        super().__init__()
        module: Any = backend_registration._DummyBackendModule()
        module.get_amp_supported_dtype = lambda: [torch.bfloat16]
        backend_registration._setup_privateuseone_for_python_backend(NAME, module)
        libraries = [
            torch.library.Library(of, "IMPL", "AutocastPrivateUse1") for of in ("_", "aten")
        ]
        every, own = self.libraries = libraries
        every.fallback(torch.library.fallthrough_kernel)
        for name, dtype in AUTOCAST.items():
            own.impl(name, partial(_cast, getattr(aten, name).default, dtype))

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _compute(func, args, kwargs or {})


def _compute(func: Callable, args: Any, kwargs: Any) -> Any:
    leaves = pytree.tree_leaves((args, kwargs))
    given = [t for t in leaves if isinstance(t, Tensor)]
    there = any(isinstance(t, Other) for t in given)
    # A number on the CPU is passed with the launch.
    if there and func not in BOTH and any(t.is_cpu and t.dim() for t in given):
        raise RuntimeError(f"{func} gets tensors of two devices")
    devices = [x.type for x in leaves if isinstance(x, torch.device)] or [NAME] * there
    args, kwargs = pytree.tree_map(_on_cpu, (args, kwargs))
    out = func(*args, **kwargs)
    if NAME not in devices:
        return out
    changed = {id(t.held): t for t in given if isinstance(t, Other)}  # in place
    return pytree.tree_map_only(Tensor, lambda t: changed.get(id(t), Other(t)), out)


def _on_cpu(value: Any) -> Any:
    if isinstance(value, torch.device):
        return torch.device("cpu")
    return value.held if isinstance(value, Other) else value


def _cast(operator: Callable, dtype: torch.dtype, *args: Any) -> Any:
    with torch.autocast(NAME, enabled=False):
        return operator(*pytree.tree_map_only(Tensor, lambda t: t.to(dtype), args))
