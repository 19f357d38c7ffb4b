"""Backward makes what is cheap to make again, instead of keeping it."""

import contextlib
from collections.abc import Callable

import torch
from torch import Tensor


def recomputed(
    value: Tensor, make: Callable[..., Tensor], *inputs: Tensor, when: bool
) -> contextlib.AbstractContextManager:
    """A context in which autograd, where it would save `value`, saves `inputs` to make it from.

    Worth it where `make` costs little and autograd keeps `inputs` anyway. What is made again is the
    same, bit for bit, and so are the gradients. Contexts do not nest: the inner one acts.

    Args:
        value: what `make(*inputs)` gave, which is not random. when: else nothing is changed.
    """
    if not when or torch.compiler.is_compiling() or not torch.is_grad_enabled():
        return contextlib.nullcontext()  # a compiler decides for itself
    place, size, dtype = value.data_ptr(), value.numel(), value.dtype
    inputs = tuple(t.detach() for t in inputs)

    def pack(saved: Tensor) -> Tensor | torch.Size:
        same = saved.data_ptr() == place and saved.numel() == size and saved.dtype == dtype
        return saved.shape if same and saved.is_contiguous() else saved

    def unpack(kept: Tensor | torch.Size) -> Tensor:
        if isinstance(kept, Tensor):
            return kept
        with torch.no_grad():
            return make(*inputs).view(kept)

    return torch.autograd.graph.saved_tensors_hooks(pack, unpack)
