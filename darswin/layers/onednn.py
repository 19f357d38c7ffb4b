"""oneDNN's matrix products, those that torch's own library carries. Nothing else names them.

torch uses them for bfloat16, but MKL for float32, which on AMD's CPUs is half as fast.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.ops._transpose_sum import transpose_sum


def missing(dtype: torch.dtype) -> str | None:
    """Why this torch on this machine has no such products in `dtype`; None where it has them."""
    if dtype not in (torch.float32, torch.bfloat16):
        return f"oneDNN has no products in {dtype}"
    if not torch.backends.mkldnn.is_available():
        return f"torch {torch.__version__} is built without oneDNN"
    if not torch.backends.mkldnn.enabled:
        return "torch.backends.mkldnn.enabled is False"
    if not hasattr(torch.ops.mkldnn, "_linear_pointwise"):
        return f"torch {torch.__version__} has no linear operator of oneDNN"
    if dtype == torch.bfloat16 and not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return "oneDNN has no bfloat16 products on this CPU"
    return None


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
