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
from darswin.layers.quantized import (
    Quantization,
    QuantizedLinear,
    quantize,
    quantized_layers,
)
from darswin.models.dat import DeformableAttention

Key = TypeVar("Key")
Layer = Callable[[Tensor], Tensor]
# The map of a stage, which may change, and the position biases of its blocks → the map.
Blocks = Callable[[Tensor, Sequence[Tensor]], Tensor]

_OPS = torch.ops.darswin
_CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)


_ADD_NORM = own_operator("_add_norm_")
_ADD_NORM_QUANTIZED = own_operator("_add_norm_quantized_")


def has_own_int8() -> bool:
    """True if our own kernels compute 8-bit products here: not where oneDNN uses AMX."""
    return not (torch.cpu._is_amx_tile_supported() and onednn_lack(torch.int8) is None)


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
    """Our own operators, in float32 and, if `has_own_int8`, of quantized layers.

    Args: weights: of the programs of a model; None for layers alone.
    """

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
    """oneDNN's products in bfloat16 and of quantized layers, and our own in float32.

    Each layer is an operator, but a sum and the norm of it are one. Where oneDNN lacks a kind of
    product, torch computes those in bfloat16, and our own operators those of quantized layers.
    """

    def __init__(self, dtype: torch.dtype, weights: Weights | None = None):
        super().__init__(weights)
        self.dtype = dtype

    def linear(
        self,
        layer: Any,
        norm: Any = None,
        *,
        gelu: bool = False,
        result: Quantization | None = None,
    ) -> Layer:
        """As `Own.linear`. A quantized layer without a norm takes uint8 of its quantization. With a
        quantization for the result, that is uint8 too."""
        taken = taken_by(layer)
        if taken is not None:
            product = _quantized_product(layer, result)
        elif self.dtype == torch.float32:
            return super().linear(layer, norm, gelu=gelu)
        else:
            product = _product(layer, self.dtype, gelu)
        if norm is None:
            return product
        normed = self.norm(norm, taken)
        return lambda x: product(normed(x))

    def norm(self, norm: nn.LayerNorm, quantization: Quantization | None = None) -> Layer:
        """A layer norm. Its result is uint8 if a quantization is given."""
        weight, bias = norm_parameters(norm)
        if quantization is not None:
            given = (weight, bias, norm.eps, *quantization)
            return lambda x: _ADD_NORM_QUANTIZED(x.contiguous(), None, *given)
        if self.dtype == torch.float32:
            return super().norm(norm)
        return lambda x: torch.layer_norm(x, norm.normalized_shape, weight, bias, norm.eps)

    def blocks(self, blocks: Sequence[Any]) -> Blocks:
        """The blocks of a stage, layer by layer. The next norm adds the branch of the last one."""
        layers = [
            (
                self._add_norm(block.norm1, taken_by(block.attn, "qkv")),
                self._attention(block.attn),
                self._add_norm(block.norm2, taken_by(block.mlp, "fc1")),
                self.linear(block.mlp.fc1, gelu=True, result=taken_by(block.mlp, "fc2")),
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
        self, norm: nn.LayerNorm, quantization: Quantization | None
    ) -> Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]]:
        """The residual and a branch to add, or None → their sum, and the norm of the sum.

        The sum overwrites the residual, and the norm may overwrite the branch.
        """
        alone, given = self.norm(norm, quantization), (*norm_parameters(norm), norm.eps)

        def run(x: Tensor, branch: Tensor | None) -> tuple[Tensor, Tensor]:
            x = x.contiguous()
            if branch is None:
                return x, alone(x)
            branch = branch.contiguous()
            if quantization is not None:
                return x, _ADD_NORM_QUANTIZED(x, branch, *given, *quantization)
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
        given: tuple = (attn.window, attn.shift, attn.periodic, sizes[2] ** -0.5)
        if (quantization := taken_by(attn, "proj")) is not None:
            attend, given = _OPS._window_attention_quantized.default, (*given, *quantization)
        return lambda x, table: proj(attend(qkv(x).unflatten(-1, sizes), table, *given))


class Libraries:
    """The libraries that compute the parts of a model fastest here.

    Args:
        dtype: of the maps between the layers.
        own_alone: chooses our own operators where oneDNN is faster too.

    Attributes:
        weights: of the programs of the model.
    """

    def __init__(self, dtype: torch.dtype, *, own_alone: bool = False):
        self.dtype, self.weights, self._own_alone = dtype, Weights(), own_alone

    def of(self, layer: nn.Module) -> Own:
        """The library of a layer, or of a part of a model."""
        own = self.dtype == torch.float32 and (
            not quantized_layers(layer) or self._own_alone or has_own_int8()
        )
        return Own(self.weights) if own else OneDNN(self.dtype, self.weights)


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


def _quantized_product(layer: QuantizedLinear, result: Quantization | None) -> Layer:
    """A quantized layer: float32, or its GELU as uint8 of the quantization `result`. By oneDNN if
    its sums are exact here."""
    if onednn_lack(torch.int8) is not None:
        own = OwnLinear(packed_weights(layer), layer.out_features, gelu=result is not None)
        return own if result is None else lambda q: quantize(own(q), result)
    columns, dtype = layer.out_features, torch.float32 if result is None else torch.uint8
    weight = torch.ops.onednn.qlinear_prepack(layer.weight.cpu(), None)
    zero_points = torch.zeros(columns, dtype=torch.int64)
    scales = layer.weight_scale.detach().clone()
    after: tuple = (*(result or (1.0, 0)), dtype, "none" if result is None else "gelu", [], "none")
    given = (*layer.activation, weight, scales, zero_points, layer.bias, *after)
    product = torch.ops.onednn.qlinear_pointwise.default

    def run(q: Tensor) -> Tensor:
        if not q.numel():  # oneDNN gives another shape
            return q.new_empty((*q.shape[:-1], columns), dtype=dtype)
        return product(q, *given)

    return run


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
    runs = {d: partial(Libraries(d).of(linear).linear(linear), x.to(d)) for d in dtypes}
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
