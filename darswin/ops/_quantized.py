"""8 bits between operators and oneDNN's integer products. Private: inference on the CPU alone."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from darswin.ops import _library


class Quantization(NamedTuple):
    """How numbers become 8 bits: q = round(x / scale) + zero_point, kept in 0 … 255.

    Attributes: scale: of one step, positive. zero_point: what 0 becomes, in 0 … 255.
    """

    scale: float
    zero_point: int


def quantize(x: Tensor, quantization: Quantization) -> Tensor:
    """float32 → uint8 of the same shape; ties go to even, and NaN becomes what 0 does."""
    scale, zero_point = quantization
    steps = torch.round(x * (1 / scale)).nan_to_num(0.0)
    return (steps + zero_point).clamp(0, 255).to(torch.uint8)


def dequantize(q: Tensor, quantization: Quantization) -> Tensor:
    """uint8 → the float32 that stands for it."""
    scale, zero_point = quantization
    return (q.float() - zero_point) * scale


def add_norm_quantized_(
    x: Tensor,
    y: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    eps: float,
    quantization: Quantization,
) -> Tensor:
    """`add_norm_` whose norm comes out as 8 bits, uint8 like x; y stays, and None adds nothing.

    Args:
        x: (..., D), contiguous, float32; it becomes x + y. y: of the same type and size.
        weight, bias: (D,), float32. eps: added to the variance.

    Raises:
        RuntimeError: as `add_norm_`; a scale or a zero point out of range.
    """
    return torch.ops.darswin._add_norm_quantized_.default(x, y, weight, bias, eps, *quantization)


def window_attention_quantized(
    qkv: Tensor,
    bias: Tensor,
    window: Sequence[int],
    shift: Sequence[int],
    periodic: Sequence[int],
    scale: float,
    quantization: Quantization,
) -> Tensor:
    """`darswin.ops.window_attention` of float32 whose result comes out as 8 bits, uint8.

    Args:
        scale: of the logits, given. The others are as there, checked.
    """
    return torch.ops.darswin._window_attention_quantized.default(
        qkv, bias, window, shift, periodic, scale, *quantization
    )


@torch.library.register_fake("darswin::_add_norm_quantized_")
def _fake_add_norm(x, y, weight, bias, eps, scale, zero_point):
    return torch.empty_like(x, dtype=torch.uint8)


@torch.library.register_fake("darswin::_window_attention_quantized")
def _fake_attention(qkv, bias, window, shift, periodic, scale, out_scale, zero_point):
    return qkv.new_empty((*qkv.shape[:3], qkv.shape[4] * qkv.shape[5]), dtype=torch.uint8)


_library.without_gradient(
    "_add_norm_quantized_", changes=1, instead="quantize(torch.layer_norm(x + y, ...), ...)"
)
_library.without_gradient(
    "_window_attention_quantized", changes=0, instead="quantize(window_attention(...), ...)"
)
