"""Sums of float32 numbers that do not depend on the order, because integers are added.

Each number becomes an integer count of units. A unit is 2⁻ᵇⁱᵗˢ times a power of two close to the
largest number. The number of bits depends on the count of summands, so that no sum overflows. A
unit is smaller than the rounding error of the largest summand.
"""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024


def bits(summands: int) -> int:
    """The number of fraction bits with which the sum of `summands` numbers below 4 fits 63 bits."""
    return 60 - math.ceil(math.log2(max(summands, 1)))


def sums(of: Tensor) -> Tensor:
    """Contiguous int64 zeros, to which the gradient of a tensor is added in units. One launch."""
    return torch.zeros(of.shape, dtype=torch.int64, device=of.device)


def largest(values: Tensor) -> Tensor:
    """The largest magnitude of each image, (B,) float32; NaN if any value is. One launch."""
    axes = tuple(range(1, values.ndim))
    return torch.linalg.vector_norm(values, math.inf, axes, dtype=torch.float32)


@triton.jit
def _exponent(largest):
    return tl.maximum((largest.to(tl.int32, bitcast=True) >> 23) & 0xFF, 1)


@triton.jit
def near_one(largest):
    """A power of two. Numbers up to `largest` are below 4 when multiplied by it."""
    return (tl.maximum(255 - _exponent(largest), 1) << 23).to(tl.float32, bitcast=True)


@triton.jit(do_not_specialize=["count", "each"])
def _finish(sums, largest, out, count, each, BITS: tl.constexpr, BLOCK: tl.constexpr):
    k = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = k < count
    exponent = _exponent(tl.load(largest + k // each, mask=mask, other=0.0))
    value = tl.load(sums + k, mask=mask, other=0).to(tl.float32) * (0.5 / (1 << BITS))
    # Infinity and NaN have the exponent 255.
    power = tl.where(exponent == 255, 0x7FC00000, exponent << 23).to(tl.float32, bitcast=True)
    tl.store(out + k, (value * power).to(out.dtype.element_ty), mask=mask)


def finish(sums: Tensor, largest: Tensor, out: Tensor, bits: int) -> None:
    """Converts sums in units to numbers and writes them to `out`. One launch."""
    if out.numel() > 0:
        _finish[(triton.cdiv(out.numel(), BLOCK),)](
            sums, largest, out, out.numel(), out[0].numel(), BITS=bits, BLOCK=BLOCK, num_warps=4,
            enable_fp_fusion=True,
        )  # fmt: skip


def like(gradients: Tensor, tensor: Tensor) -> Tensor:
    """Converts gradients per image to the shape and dtype of a tensor that images may share."""
    if len(tensor) < len(gradients):
        gradients = gradients.sum(0, keepdim=True)
    return gradients.to(tensor.dtype).contiguous()
