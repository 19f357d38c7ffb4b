"""The operators' kernels for CUDA devices, in Triton: one launch where torch takes many.

A function of the operator's name takes the arguments of the schema, makes the outputs and launches.
The public function has checked the arguments; the reference runs those that the kernel does not
take. Triton is no dependency, and no kernel is imported before the first call on a CUDA device.
docs/explanation/gpu.md describes the kernels. Their rules:

- A program owns what it writes, or adds integers to it (`fixed_point`), in any order: two runs give
  the same bits. Such a gradient is NaN all over where a number that arrives is not finite.
- Numbers are widened to float32 as they are read, and rounded once as they are written. Each
  product names its `input_precision`, each launch whether multiplications and additions are fused.
- Places in tensors are int64: a batch may have more than 2³¹ numbers.
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
    "polar_embed": "polar_sample",
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
            with torch.cuda.device_of(arguments[0]):  # Triton launches on the current one
                return launcher(operator)(*arguments)

        torch.library.register_kernel(f"darswin::{operator}", "cuda", launch)
