"""Training with less memory: values that are cheap to compute again are not kept for backward."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from darswin.layers.attention import WindowAttention
from darswin.ops import window_attention


def checkpointed(block: Any, x: Tensor, table: Tensor) -> Tensor:
    """`Block.forward`, whose backward recomputes the norms, the GELU and the window attention.

    They are a few percent of the work. The gradients stay the same, bit for bit.
    """
    y = block.norm1(x)
    with recomputed(y, block.norm1, x):
        y = _attention(block.attn, y, table)
    x = x + block.drop_path(y)
    y = block.norm2(x)
    with recomputed(y, block.norm2, x):
        y = block.mlp(y)
    return x + block.drop_path(y)


def _attention(attn: nn.Module, x: Tensor, table: Tensor) -> Tensor:
    if not isinstance(attn, WindowAttention):
        return attn(x, table)
    attend: Callable[..., Tensor] = partial(window_attention, **attn.windows())
    qkv = attn.queries_keys_values(x)
    out = attend(qkv, table)
    with recomputed(out, attend, qkv, table):
        return attn.proj(out)


def recomputed(
    value: Tensor, function: Callable[..., Any], *inputs: Tensor
) -> contextlib.AbstractContextManager:
    """A context in which autograd recomputes `value` in backward, instead of keeping it in memory.

    `value` is the result of `function(*inputs)`, which gives the same bits again. Autograd keeps
    the inputs in any case, for the gradient of the function.
    """
    # torch's selective checkpointing saves the same memory, but its Python mode intercepts every
    # operator: a training step takes 10 to 50 % longer.
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
