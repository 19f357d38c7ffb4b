"""oneDNN's matrix products, those that torch's own library carries. Nothing else names them.

torch uses them for bfloat16, but MKL for float32, which on AMD's CPUs is half as fast.
"""

from functools import cache
from typing import Any

import torch
from torch import Tensor

from darswin.ops._inference import transpose_sum


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
        if not _int8_is_exact():
            return "oneDNN's int8 products overflow: ONEDNN_MAX_CPU_ISA keeps it from using VNNI"
    return None


def _has_int8() -> bool:
    """Whether this CPU adds up products of 8 bits in 32: those of others overflow in 16."""
    if torch.cpu._is_vnni_supported():
        return True
    tell: Any = getattr(torch.cpu, "get_capabilities", dict)  # older versions of torch lack it
    return any(tell().get(name) for name in ("avx_vnni", "amx_int8"))


@cache
def _int8_is_exact() -> bool:
    """Whether the largest product that there is comes out right. Without VNNI it does not."""
    size, largest = 64, 127
    weight = torch.full((size, size), largest, dtype=torch.int8)
    packed = torch.ops.onednn.qlinear_prepack(weight, None)
    scales, zero_points = torch.ones(size), torch.zeros(size, dtype=torch.int64)
    q = torch.full((size, size), 255, dtype=torch.uint8)
    found = torch.ops.onednn.qlinear_pointwise.default(
        q, 1.0, 0, packed, scales, zero_points, None, 1.0, 0, torch.float32, "none", [], "none"
    )
    return bool((found == size * largest * 255).all())


def product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`F.linear(x, weight, bias)`; any strides, no gradient."""
    return torch.ops.mkldnn._linear_pointwise.default(x, weight, bias, "none", [], "")


def parameter_gradients(g: Tensor, x: Tensor, with_bias: bool) -> tuple[Tensor, Tensor | None]:
    """Of `F.linear(x, weight, bias)` in float32, x (M, D), whose result has the gradient g."""
    # oneDNN's product wants one of the two transposed in memory; torch's own copy is a slow one.
    transposed, grad_bias = transpose_sum(g.contiguous())
    return product(transposed, x.t()), grad_bias if with_bias else None
