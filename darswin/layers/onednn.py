"""oneDNN's matrix products, those that torch's own library carries. Nothing else names them.

torch uses them for bfloat16, but MKL for float32, which on AMD's CPUs is half as fast.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.quantized import QuantizedLinear
from darswin.ops._quantized import Quantization
from darswin.ops._transpose_sum import transpose_sum


def missing(dtype: torch.dtype) -> str | None:
    """Why this torch on this machine has no such products in `dtype`; None where it has them."""
    if dtype not in (torch.float32, torch.bfloat16, torch.int8):
        return f"oneDNN has no products in {dtype}"
    if not torch.backends.mkldnn.is_available():
        return f"torch {torch.__version__} is built without oneDNN"
    if not torch.backends.mkldnn.enabled:
        return "torch.backends.mkldnn.enabled is False"
    if not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return f"torch {torch.__version__} has no linear operator of oneDNN"
    if dtype == torch.bfloat16 and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return "oneDNN has no bfloat16 products on this CPU"
    if dtype == torch.int8:
        if not hasattr(torch.ops.onednn, "qlinear_pointwise"):
            return f"torch {torch.__version__} has no int8 products of oneDNN"
        if not _has_int8():
            return "this CPU has no VNNI, the instructions of int8 products"
    return None


def _has_int8() -> bool:
    """Whether this CPU adds up products of 8 bits in 32: those of others overflow in 16."""
    if torch.cpu._is_vnni_supported():
        return True
    tell: Any = getattr(torch.cpu, "get_capabilities", dict)  # older versions of torch lack it
    return any(tell().get(name) for name in ("avx_vnni", "amx_int8"))


def product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`F.linear(x, weight, bias)`; any strides, no gradient."""
    return torch.ops.mkldnn._linear_pointwise.default(x, weight, bias, "none", [], "")


def parameter_gradients(g: Tensor, x: Tensor, with_bias: bool) -> tuple[Tensor, Tensor | None]:
    """Of `F.linear(x, weight, bias)` in float32, x (M, D), whose result has the gradient g."""
    # oneDNN's product wants one of the two transposed in memory; torch's own copy is a slow one.
    transposed, grad_bias = transpose_sum(g.contiguous())
    return product(transposed, x.t()), grad_bias if with_bias else None


class PackedLinear(nn.Module):
    """A linear layer for inference, its weight laid out as the product reads it.

    Where oneDNN lacks the product, torch's own does the same.

    Args:
        linear: whose weights are copied. dtype: of the products.
    """

    def __init__(self, linear: nn.Linear, dtype: torch.dtype):
        super().__init__()
        self.in_features, self.out_features = linear.in_features, linear.out_features
        self.packed = missing(dtype) is None
        # Tensors that are no parameters: in this layout they can be neither moved nor saved.
        weight, self.bias = (
            None if t is None else t.detach().to(dtype, copy=True)
            for t in (linear.weight, linear.bias)
        )
        self.weight = torch.ops.mkldnn._reorder_linear_weight(weight) if self.packed else weight
        if self.packed:
            self._product = torch.ops.mkldnn._linear_pointwise.default

    def forward(self, x: Tensor) -> Tensor:
        """(..., D) → (..., D')."""
        if self.packed:
            return self._product(x, self.weight, self.bias, "none", [], "")
        return F.linear(x, self.weight, self.bias)

    def gelu(self, x: Tensor) -> Tensor:
        """(..., D) → the GELU of the result."""
        if self.packed:
            return self._product(x, self.weight, self.bias, "gelu", [], "none")
        return F.gelu(F.linear(x, self.weight, self.bias))

    def extra_repr(self) -> str:
        return f"in_features={self.in_features}, out_features={self.out_features}"


class PackedQuantizedLinear(nn.Module):
    """A quantized layer as an integer product, its weight laid out as the product reads it."""

    def __init__(self, layer: QuantizedLinear):
        super().__init__()
        self.in_features, self.out_features = layer.in_features, layer.out_features
        self.activation = layer.activation
        weight = torch.ops.onednn.qlinear_prepack(layer.weight.cpu(), None)
        zero_points = torch.zeros(self.out_features, dtype=torch.int64)
        scales = layer.weight_scale.detach().clone()
        self._given = (*self.activation, weight, scales, zero_points, layer.bias)
        self._product = torch.ops.onednn.qlinear_pointwise.default

    def forward(self, q: Tensor) -> Tensor:
        """(..., D), uint8 of `activation` → (..., D'), float32."""
        return self._product(q, *self._given, 1.0, 0, torch.float32, "none", [], "none")

    def quantized_gelu(self, q: Tensor, to: Quantization) -> Tensor:
        """(..., D), uint8 of `activation` → the GELU of the result, uint8 of `to`."""
        return self._product(q, *self._given, *to, torch.uint8, "gelu", [], "none")

    def extra_repr(self) -> str:
        return f"in_features={self.in_features}, out_features={self.out_features}"
