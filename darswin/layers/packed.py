"""Linear layers for inference, their weights laid out as oneDNN's products read them."""

import time
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.layers.onednn import missing
from darswin.layers.quantized import Quantization, QuantizedLinear


class PackedLinear(nn.Module):
    """A linear layer for inference, its weight laid out as the product reads it.

    Where oneDNN lacks the product, torch's own does the same.

    Args:
        linear: whose weights are copied. dtype: of the products.
    """

    def __init__(self, linear: nn.Linear, dtype: torch.dtype):
        super().__init__()
        if not isinstance(linear, nn.Linear):
            raise ValueError(f"this layer must be a linear one, got {type(linear).__name__}")
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
        if not q.numel():
            return self._nothing(q, torch.float32)
        return self._product(q, *self._given, 1.0, 0, torch.float32, "none", [], "none")

    def quantized_gelu(self, q: Tensor, to: Quantization) -> Tensor:
        """(..., D), uint8 of `activation` → the GELU of the result, uint8 of `to`."""
        if not q.numel():
            return self._nothing(q, torch.uint8)
        return self._product(q, *self._given, *to, torch.uint8, "gelu", [], "none")

    def _nothing(self, q: Tensor, dtype: torch.dtype) -> Tensor:
        # Of no rows oneDNN's product has another shape.
        return q.new_empty((*q.shape[:-1], self.out_features), dtype=dtype)

    def extra_repr(self) -> str:
        return f"in_features={self.in_features}, out_features={self.out_features}"


@cache
def fastest_dtype() -> torch.dtype:
    """float32 or bfloat16: in which this CPU computes a usual product sooner.

    Measured once a process, in a tenth of a second: bfloat16 wins by far where the CPU has
    instructions for it, and loses where oneDNN has to do without them. 8 bits, which need a
    calibration, are not asked.
    """
    dtypes = [d for d in (torch.float32, torch.bfloat16) if missing(d) is None]
    if len(dtypes) < 2:
        return torch.float32
    seconds = dict.fromkeys(dtypes, float("inf"))
    x = torch.ones(512, 384)
    linear = nn.utils.skip_init(nn.Linear, 384, 1536)  # which draws no random numbers
    nn.init.ones_(linear.weight)
    runs = {d: (PackedLinear(linear, d), x.to(d)) for d in dtypes}
    with torch.inference_mode():
        for turn in range(9):
            for dtype, (layer, rows) in runs.items():
                start = time.perf_counter()
                layer(rows)
                if turn:  # the first one makes what oneDNN keeps for the shape
                    seconds[dtype] = min(seconds[dtype], time.perf_counter() - start)
    return min(seconds, key=seconds.__getitem__)
