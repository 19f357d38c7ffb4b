"""Layers with packed weights, which `darswin.optimize` uses in place of a model's layers.

They are plain callables: a module would take a microsecond more for each call.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.linear import best_seconds, onednn_lack
from darswin.layers.quantized import Quantization, QuantizedLinear
from darswin.layers.transformer import WindowAttention
from darswin.ops import cpu_capability

__all__ = ["fastest_dtype"]

_OPS = torch.ops.darswin
_CPU = torch._C.DispatchKeySet(torch._C.DispatchKey.CPU)


def _operator(name: str) -> Callable[..., Any]:
    # Not by way of autograd, which would look for gradients and count versions: there are none.
    return partial(getattr(_OPS, name).default.redispatch, _CPU)


_ADD_NORM = _operator("_add_norm_")
_ADD_NORM_QUANTIZED = _operator("_add_norm_quantized_")
_NORM = _operator("_norm")
_PACK = _operator("_pack_linear")
_LINEAR = _operator("_linear")
_BLOCKS = _operator("_blocks_")


class PackedLinear:
    """A linear layer in float32 or bfloat16, with a GELU after it if asked."""

    def __init__(self, linear: object, dtype: torch.dtype, *, gelu: bool = False):
        if not isinstance(linear, nn.Linear):
            raise ValueError(f"this layer must be a linear one, got {type(linear).__name__}")
        self._product: Callable[[Tensor], Tensor]
        if dtype == torch.float32:
            weights, columns = packed_weights(linear), linear.out_features
            self._product = lambda x: _LINEAR(x, weights, columns, gelu)
            return
        # Tensors that are no parameters: in oneDNN's layout they can be neither moved nor saved.
        weight, bias = (
            None if t is None else t.detach().to(dtype, copy=True)
            for t in (linear.weight, linear.bias)
        )
        if onednn_lack(dtype) is None:
            self._product = onednn_linear(weight, bias, gelu=gelu)
        elif gelu:
            self._product = lambda x: F.gelu(F.linear(x, weight, bias))
        else:
            self._product = lambda x: F.linear(x, weight, bias)

    def __call__(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D')."""
        return self._product(x)


def onednn_linear(
    weight: Tensor | None, bias: Tensor | None, *, gelu: bool = False
) -> Callable[[Tensor], Tensor]:
    """A linear layer by oneDNN, which keeps the weight in its own layout."""
    packed = torch.ops.mkldnn._reorder_linear_weight(weight)
    product = torch.ops.mkldnn._linear_pointwise.default
    after: tuple = ("gelu", [], "none") if gelu else ("none", [], "")
    return lambda x: product(x, packed, bias, *after)


def has_own_int8() -> bool:
    """True if our own kernels compute 8-bit products here. On CPUs with AMX, oneDNN uses AMX."""
    has_vnni = torch.cpu._is_vnni_supported() and not torch.cpu._is_amx_tile_supported()
    return has_vnni and cpu_capability() == "avx512"


def packed_weights(linear: nn.Linear | QuantizedLinear) -> Tensor:
    """A linear layer as `_linear` and `_blocks_` read it, (K,): float32, or int32 if quantized."""
    weight = linear.weight.detach()
    bias = None if linear.bias is None else linear.bias.detach().float()
    if isinstance(linear, QuantizedLinear):
        return _PACK(weight, bias, linear.weight_scale.float(), *linear.activation)
    return _PACK(weight.float(), bias)


def norm_parameters(norm: nn.LayerNorm) -> Tensor:
    """The weight and the bias of a norm, (2, D) float32."""
    return torch.stack((norm.weight, norm.bias)).detach().float()


def packed_merging(norm: Any, reduction: Any) -> Callable[[Tensor], Tensor]:
    """The norm and the linear layer of a merging, as one operator."""
    weights, columns = packed_weights(reduction), reduction.out_features
    parameters = norm_parameters(norm)
    return lambda x: _LINEAR(x, weights, columns, False, parameters, norm.eps)


class PackedBlocks:
    """The blocks of a stage as one operator, in float32 or with 8-bit products. It replaces
    `Stage._run`."""

    def __init__(self, blocks: Sequence[Any]):
        self._parameters: list[Tensor] = []
        self._windows: list[int] = []
        for block in blocks:
            attn, mlp = block.attn, block.mlp
            self._parameters += [
                norm_parameters(block.norm1),
                packed_weights(attn.qkv),
                packed_weights(attn.proj),
                norm_parameters(block.norm2),
                packed_weights(mlp.fc1),
                packed_weights(mlp.fc2),
            ]
            self._windows += [*attn.window, *attn.shift, *attn.periodic]
        self._sizes = (blocks[0].attn.num_heads, blocks[0].mlp.fc1.out_features)
        self._eps = blocks[0].norm1.eps

    def __call__(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        """The map of the stage, which changes in place, and the position biases of the blocks."""
        x = x.contiguous()
        _BLOCKS(x, self._parameters, tables, self._windows, *self._sizes, self._eps)
        return x


class PackedQuantizedLinear:
    """A quantized linear layer: (..., D), uint8 of the quantization `activation` → (..., D').

    The result is float32, or the GELU of it as uint8 of the quantization `gelu`.
    """

    def __init__(self, layer: QuantizedLinear, gelu: Quantization | None = None):
        self.out_features = layer.out_features
        self.activation = layer.activation
        weight = torch.ops.onednn.qlinear_prepack(layer.weight.cpu(), None)
        zero_points = torch.zeros(self.out_features, dtype=torch.int64)
        scales = layer.weight_scale.detach().clone()
        self._dtype = torch.float32 if gelu is None else torch.uint8
        result: tuple = (1.0, 0, torch.float32, "none", [], "none")
        if gelu is not None:
            result = (*gelu, torch.uint8, "gelu", [], "none")
        self._given = (*self.activation, weight, scales, zero_points, layer.bias, *result)
        self._product = torch.ops.onednn.qlinear_pointwise.default

    def __call__(self, q: Tensor) -> Tensor:
        if not q.numel():  # oneDNN gives another shape
            return q.new_empty((*q.shape[:-1], self.out_features), dtype=self._dtype)
        return self._product(q, *self._given)


Product = PackedLinear | PackedQuantizedLinear


def packed(layer: object, dtype: torch.dtype) -> Product:
    """The packed form of a linear layer, which may be quantized."""
    if isinstance(layer, QuantizedLinear):
        return PackedQuantizedLinear(layer)
    return PackedLinear(layer, dtype)


def taken(product: object) -> Quantization | None:
    """The quantization of a product's input; None for a product without one."""
    return product.activation if isinstance(product, PackedQuantizedLinear) else None


def packed_norm(
    norm: nn.LayerNorm, dtype: torch.dtype, quantization: Quantization | None = None
) -> Callable[[Tensor], Tensor]:
    """A layer norm in `dtype`. Its result is uint8 if a quantization is given."""
    if dtype == torch.float32 and quantization is None:
        parameters = norm_parameters(norm)
        return lambda x: _NORM(x, parameters, norm.eps)
    weight, bias = norm_parameters(norm)
    if quantization is not None:
        given = (weight, bias, norm.eps, *quantization)
        return lambda x: _ADD_NORM_QUANTIZED(x.contiguous(), None, *given)
    return lambda x: torch.layer_norm(x, norm.normalized_shape, weight, bias, norm.eps)


class PackedNorm:
    """`AddNorm` as one operator. Its norm is uint8 if a quantization is given."""

    def __init__(self, norm: object, dtype: torch.dtype, quantization: Quantization | None = None):
        assert isinstance(norm, nn.LayerNorm)
        self.norm = packed_norm(norm, dtype, quantization)
        self._given = (*norm_parameters(norm), norm.eps)
        self.quantization = quantization

    def __call__(self, x: Tensor, branch: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As `AddNorm`. The sum overwrites x, and the norm may overwrite `branch`."""
        x = x.contiguous()
        if branch is None:
            return x, self.norm(x)
        branch = branch.contiguous()
        if self.quantization is not None:
            return x, _ADD_NORM_QUANTIZED(x, branch, *self._given, *self.quantization)
        _ADD_NORM(x, branch, *self._given)
        return x, branch


def packed_attention(
    attn: WindowAttention, quantization: Quantization | None
) -> Callable[[Tensor, Tensor], Tensor]:
    """`attn.attend` without its checks, which cannot fail here. It returns uint8 if quantized."""
    head_dim = attn.dim // attn.num_heads
    settings = (attn.window, attn.shift, attn.periodic, head_dim**-0.5)
    if quantization is None:
        return lambda qkv, bias: _OPS.window_attention.default(qkv, bias, *settings)
    operator = _OPS._window_attention_quantized.default
    return lambda qkv, bias: operator(qkv, bias, *settings, *quantization)


@cache
def fastest_dtype() -> torch.dtype:
    """The faster of float32 and bfloat16 on this CPU.

    It times a typical product once per process, for a tenth of a second. bfloat16 is much faster on
    CPUs with instructions for it, and slower on others. int8 needs a calibration, so it is not a
    candidate.
    """
    dtypes = [d for d in (torch.float32, torch.bfloat16) if onednn_lack(d) is None]
    if len(dtypes) < 2:
        return torch.float32
    x = torch.ones(512, 384)
    linear = nn.utils.skip_init(nn.Linear, 384, 1536)  # which draws no random numbers
    nn.init.ones_(linear.weight)
    runs = {d: partial(PackedLinear(linear, d), x.to(d)) for d in dtypes}
    with torch.inference_mode():
        seconds = best_seconds(runs, turns=9)
    return min(seconds, key=seconds.__getitem__)
