"""Layers by the libraries that compute them fastest: our own operators, and oneDNN.

They are plain callables: a module would take a microsecond more for each call.
"""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, cached_property, partial
from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.overrides import handle_torch_function, has_torch_function_unary

from darswin.deploy.own import (
    OwnLinear,
    OwnNorm,
    PackedBlocks,
    norm_parameters,
    own_operator,
    packed_weights,
    taken_by,
)
from darswin.deploy.program import Checked, Program, Weights
from darswin.layers.attention import WindowAttention
from darswin.layers.linear import onednn_lack
from darswin.layers.quantized import quantize
from darswin.models.dat import DeformableAttention

Key = TypeVar("Key")
Layer = Callable[[Tensor], Tensor]
# The map of a stage, which may change, and the position biases of its blocks → the map.
Blocks = Callable[[Tensor, Sequence[Tensor]], Tensor]

_OPS = torch.ops.darswin
_CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)


_ADD_NORM = own_operator("_add_norm_")


class OwnBlocks(PackedBlocks):
    """The blocks of a stage by one operator; weights: those of the whole model."""

    def __init__(self, blocks: Sequence[Any], weights: Weights):
        super().__init__(blocks)
        # The program of these blocks alone: a map and the position biases → the map.
        self.written = Program(weights)
        x = self.written.input(*self.map_shape)
        tables = [self.written.input(*shape) for shape in self.table_shapes]
        self.written.output(self.written.blocks(x, self, tables))

    @cached_property
    def program(self) -> Checked:
        """`written`, ready to run."""
        return self.written.checked()

    def __call__(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        if has_torch_function_unary(x):
            return handle_torch_function(OwnBlocks.__call__, (x,), self, x, tables)
        return self.program([x, *tables])[0]


class Own:
    """Our own operators, in float32 and of quantized layers.

    Args: weights: of the programs of a model; None for layers alone.
    """

    dtype = torch.float32  # of the maps between layers

    def __init__(self, weights: Weights | None = None):
        self.weights = Weights() if weights is None else weights

    def linear(self, layer: Any, norm: Any = None, *, gelu: bool = False) -> Layer:
        """A linear layer, behind a norm or before a GELU if asked."""
        before = None if norm is None else OwnNorm(norm)
        return OwnLinear(packed_weights(layer), layer.out_features, gelu=gelu, norm=before)

    def norm(self, norm: nn.LayerNorm) -> Layer:
        """A layer norm."""
        return OwnNorm(norm)

    def blocks(self, blocks: Sequence[Any]) -> Blocks:
        """The blocks of a stage: one operator, if all have window or deformable attention."""
        own = WindowAttention, DeformableAttention
        if not blocks or not all(isinstance(block.attn, own) for block in blocks):
            return OneDNN(torch.float32, self.weights).blocks(blocks)
        return OwnBlocks(blocks, self.weights)


class OneDNN(Own):
    """oneDNN's products in bfloat16, and our own in float32 and of quantized layers.

    Each layer is an operator, but a sum and the norm of it are one. Where oneDNN lacks bfloat16,
    torch computes its products.
    """

    def __init__(self, dtype: torch.dtype, weights: Weights | None = None):
        super().__init__(weights)
        self.dtype = dtype

    def linear(self, layer: Any, norm: Any = None, *, gelu: bool = False) -> Layer:
        """As `Own.linear`, but a quantized layer takes float32 without a norm too."""
        if self.dtype == torch.float32:
            product = super().linear(layer, norm, gelu=gelu)
            taken = taken_by(layer)
            if norm is not None or taken is None:
                return product
            return lambda x: product(quantize(x, taken))
        product = _product(layer, self.dtype, gelu)
        if norm is None:
            return product
        normed = self.norm(norm)
        return lambda x: product(normed(x))

    def norm(self, norm: nn.LayerNorm) -> Layer:
        """A layer norm."""
        if self.dtype == torch.float32:
            return super().norm(norm)
        weight, bias = norm_parameters(norm)
        return lambda x: torch.layer_norm(x, norm.normalized_shape, weight, bias, norm.eps)

    def blocks(self, blocks: Sequence[Any]) -> Blocks:
        """The blocks of a stage, layer by layer. The next norm adds the branch of the last one."""
        layers = [
            (
                self._add_norm(block.norm1),
                self._attention(block.attn),
                self._add_norm(block.norm2),
                self.linear(block.mlp.fc1, gelu=True),
                self.linear(block.mlp.fc2),
            )
            for block in blocks
        ]

        def run(x: Tensor, tables: Sequence[Tensor]) -> Tensor:
            branch = None
            for (norm1, attn, norm2, fc1, fc2), table in zip(layers, tables, strict=True):
                x, y = norm1(x, branch)
                x, y = norm2(x, attn(y, table))
                branch = fc2(fc1(y))
            return x if branch is None else x.add_(branch)

        return run

    def _add_norm(
        self, norm: nn.LayerNorm
    ) -> Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]:
        """The residual and a branch to add, or None → their sum, and the norm of the sum.

        The sum overwrites the residual, and the norm may overwrite the branch.
        """
        alone, given = self.norm(norm), (*norm_parameters(norm), norm.eps)

        def run(x: Tensor, branch: Tensor | None) -> tuple[Tensor, Tensor]:
            x = x.contiguous()
            if branch is None:
                return x, alone(x)
            branch = branch.contiguous()
            _ADD_NORM(x, branch, *given)
            return x, branch

        return run

    def _attention(self, attn: Any) -> Callable[[Tensor, Tensor], Tensor]:
        """Window attention without its checks, which cannot fail here; other kinds by torch."""
        if not isinstance(attn, WindowAttention):
            return InDtype(attn, self.dtype)
        qkv, proj = self.linear(attn.qkv), self.linear(attn.proj)
        sizes = (3, attn.num_heads, attn.dim // attn.num_heads)
        attend = _OPS.window_attention.default
        given = attn.window, attn.shift, attn.periodic, sizes[2] ** -0.5
        return lambda x, table: proj(attend(qkv(x).unflatten(-1, sizes), table, *given))


def library_of(dtype: torch.dtype) -> Own:
    """The library that computes the parts of a model; dtype: of the maps between its layers."""
    return Own() if dtype == torch.float32 else OneDNN(dtype)


def _product(linear: Any, dtype: torch.dtype, gelu: bool) -> Layer:
    """A linear layer in `dtype`, by oneDNN if it can."""
    # Tensors that are no parameters: in oneDNN's layout they can be neither moved nor saved.
    weight: Tensor = linear.weight.detach().to(dtype, copy=True)
    bias = None if linear.bias is None else linear.bias.detach().to(dtype, copy=True)
    if onednn_lack(dtype) is None:
        return onednn_linear(weight, bias, gelu=gelu)
    if gelu:
        return lambda x: F.gelu(F.linear(x, weight, bias))
    return lambda x: F.linear(x, weight, bias)


def onednn_linear(weight: Tensor, bias: Tensor | None, *, gelu: bool = False) -> Layer:
    """A linear layer by oneDNN, which keeps the weight in its own layout."""
    packed = torch.ops.mkldnn._reorder_linear_weight(weight)
    product = torch.ops.mkldnn._linear_pointwise.default
    after: tuple = ("gelu", [], "none") if gelu else ("none", [], "")
    return lambda x: product(x, packed, bias, *after)


class InDtype(nn.Module):
    """Runs a module by torch, under autocast for bfloat16; inputs and results are in `dtype`."""

    def __init__(self, module: nn.Module, dtype: torch.dtype):
        super().__init__()
        self.module, self.dtype = module, dtype

    def forward(self, x: Tensor, *others: Tensor) -> Tensor:
        refuse_gradients(x)
        narrow = self.dtype == torch.bfloat16
        autocast: Any = contextlib.nullcontext()
        if narrow or torch.is_autocast_enabled("cpu"):
            autocast = torch.autocast("cpu", torch.bfloat16, enabled=narrow)
        with autocast:
            return self.module(x.to(self.dtype), *others).to(self.dtype)


def refuse_gradients(x: Tensor) -> None:
    """RuntimeError if what the network sees requires a gradient."""
    if torch.is_grad_enabled() and x.requires_grad:
        raise RuntimeError(
            "an optimized model has no gradients, but its images or its lens require one: call it "
            "under torch.no_grad(), or use the original model"
        )


@cache
def fastest_dtype() -> torch.dtype:
    """The faster of float32 and bfloat16 on this CPU.

    It times a typical product once per process, for a tenth of a second. bfloat16 is much faster on
    CPUs with instructions for it, and slower on others. int8 needs typical pictures, so it is not a
    candidate.
    """
    dtypes = [d for d in (torch.float32, torch.bfloat16) if onednn_lack(d) is None]
    if len(dtypes) < 2:
        return torch.float32
    x = torch.ones(512, 384)
    linear = nn.utils.skip_init(nn.Linear, 384, 1536)  # which draws no random numbers
    nn.init.ones_(linear.weight)
    runs = {d: partial(library_of(d).linear(linear), x.to(d)) for d in dtypes}
    with torch.inference_mode():
        seconds = best_seconds(runs, turns=9)
    return min(seconds, key=seconds.__getitem__)


def best_seconds(runs: Mapping[Key, Callable[[], object]], turns: int) -> dict[Key, float]:
    """The shortest time of each run in seconds. Runs take turns; the first turn does not count."""
    seconds = dict.fromkeys(runs, float("inf"))
    for turn in range(turns):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if turn:  # in the first turn oneDNN prepares itself for the shape
                seconds[name] = min(seconds[name], time.perf_counter() - start)
    return seconds
