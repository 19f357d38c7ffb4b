"""Backward recomputes what is cheap to compute, so that memory need not keep it."""

import contextlib
from collections.abc import Callable

import torch
from torch import Tensor


def recomputed(
    value: Tensor, function: Callable[..., Tensor], *inputs: Tensor, when: bool
) -> contextlib.AbstractContextManager:
    """A context in which autograd does not keep `value`, but recomputes it from `inputs`.

    It saves memory where autograd keeps `inputs` anyway, at the cost of `function`. The recomputed
    value, and so the gradients, are the same, bit for bit. Of nested contexts the inner one acts.

    Args:
        value: the result of `function(*inputs)`, which must not be random.
        when: False makes it a context that does nothing.
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
            return function(*inputs).view(kept)

    return torch.autograd.graph.saved_tensors_hooks(pack, unpack)
