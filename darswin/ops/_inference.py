"""Private operators of our own layers. They have no reference; those for inference have no gradient
either. Results do not depend on the number of threads."""

from collections.abc import Sequence

import torch
from torch import Tensor

from darswin.ops import _library


def add_norm_(x: Tensor, y: Tensor, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
    """Adds y to x, then makes y the layer norm of the sum: one pass over memory.

    x and y are (..., D), contiguous, float32 or bfloat16; weight and bias are (D,), float32. With
    bfloat16 the arithmetic is float32, and the sum is rounded before it is normalized. Returns y.
    """
    torch.ops.darswin._add_norm_.default(x, y, weight, bias, eps)
    return y


def add_norm_quantized_(
    x: Tensor,
    y: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    eps: float,
    quantization: tuple[float, int],
) -> Tensor:
    """`add_norm_` of float32 that returns the norm as uint8, by scale and zero point; y does not
    change, and None adds nothing."""
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
    """`window_attention` of float32 that returns uint8, by scale and zero point."""
    return torch.ops.darswin._window_attention_quantized.default(
        qkv, bias, window, shift, periodic, scale, *quantization
    )


def transpose_sum(x: Tensor) -> tuple[Tensor, Tensor]:
    """The transpose of a contiguous float32 matrix (M, N) and the sums of its columns, for the
    gradients of a linear layer: (N, M) and (N,). Its own gradient is torch's transpose and sum."""
    _library.refuse_other_derivatives("transpose_sum", (x,))
    return torch.ops.darswin._transpose_sum.default(x)


@torch.library.register_fake("darswin::_add_norm_")
def _fake_add_norm(x, y, weight, bias, eps):
    return None


@torch.library.register_fake("darswin::_add_norm_quantized_")
def _fake_add_norm_quantized(x, y, weight, bias, eps, scale, zero_point):
    return torch.empty_like(x, dtype=torch.uint8)


@torch.library.register_fake("darswin::_window_attention_quantized")
def _fake_attention(qkv, bias, window, shift, periodic, scale, out_scale, zero_point):
    return qkv.new_empty((*qkv.shape[:3], qkv.shape[4] * qkv.shape[5]), dtype=torch.uint8)


@torch.library.register_fake("darswin::_transpose_sum")
def _fake_transpose_sum(x):
    return x.new_empty(x.shape[::-1]), x.new_empty(x.shape[1:])


def _transpose_sum_backward(ctx, grad_transposed, grad_sums):
    return grad_transposed.t() + grad_sums


torch.library.register_autograd("darswin::_transpose_sum", _transpose_sum_backward)
_library.without_gradient("_add_norm_", changes=2, instead="torch.layer_norm(x + y, ...)")
_library.without_gradient(
    "_add_norm_quantized_", changes=1, instead="quantize(torch.layer_norm(x + y, ...), ...)"
)
_library.without_gradient(
    "_window_attention_quantized", changes=0, instead="quantize(window_attention(...), ...)"
)
