"""The operators' Triton kernels for CUDA devices. One launch replaces many launches of torch.

Each launcher has the name of its operator. It takes the arguments of the schema, allocates the
outputs and launches the kernels. The public function has already checked the arguments, and runs
the reference for arguments that the kernel does not support. Triton is optional, and no kernel is
imported before the first call on a CUDA device. docs/explanation/gpu.md describes the kernels.
Their rules:

- Programs either write to separate places or add integers (`fixed_point`) in any order, so two runs
  give the same bits. A gradient summed as integers is NaN everywhere if an incoming number is not
  finite.
- Numbers are widened to float32 when they are read, and rounded once when they are written. Each
  product states its `input_precision`, and each launch states whether multiplications and
  additions are fused.
- Offsets into tensors are int64, since a batch may have more than 2³¹ numbers.
"""

import functools
import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import torch

INSTALLED = importlib.util.find_spec("triton") is not None

# Operator → the module in this package that launches it and its backward.
_MODULES = {
    "polar_sample": "polar_sample",
    "polar_to_image": "polar_to_image",
    "window_attention": "window_attention",
}
LAUNCHERS = {name + way: module for name, module in _MODULES.items() for way in ("", "_backward")}


@functools.cache
def launcher(operator: str) -> Callable[..., Any]:
    """The function that launches an operator's kernels. Imports triton."""
    return getattr(importlib.import_module(f"{__name__}.{LAUNCHERS[operator]}"), operator)


def register() -> None:
    """Gives the operators their kernels, if triton is installed."""
    if not INSTALLED:
        return
    for operator in LAUNCHERS:

        def launch(*arguments: Any, operator: str = operator) -> Any:
            with torch.cuda.device_of(arguments[0]):  # Triton launches on the current device
                return launcher(operator)(*arguments)

        torch.library.register_kernel(f"darswin::{operator}", "cuda", launch)
