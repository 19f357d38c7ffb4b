"""8 bits between operators and oneDNN's integer products. Private: inference on the CPU alone."""

from collections.abc import Sequence

import torch
from torch import Tensor

from darswin.ops import _library


def add_norm_quantized_(
    x: Tensor,
    y: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    eps: float,
    quantization: tuple[float, int],
) -> Tensor:
    """`add_norm_` whose norm comes out as 8 bits, uint8 like x; y stays, and None adds nothing.

    Args:
        x: (..., D), contiguous, float32; it becomes x + y. y: of the same type and size.
        weight, bias: (D,), float32. eps: added to the variance.
        quantization: scale and zero point, as `darswin.layers.quantized.Quantization`.

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
    quantization: tuple[float, int],
) -> Tensor:
    """`darswin.ops.window_attention` of float32 whose result comes out as 8 bits, uint8.

    Args:
        scale: of the logits, given. quantization: scale and zero point of the result. The others
            are as there, checked.
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
