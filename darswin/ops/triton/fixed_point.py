"""Sums of float32 numbers whose order does not matter: they are added as integers.

A number is counted in units: 2⁻ᵇⁱᵗˢ of a power of two beside the largest number there is. As many
bits are taken as the count of summands leaves, so no sum overflows, and a unit is less than the
rounding of the largest summand.
"""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024


def bits(summands: int) -> int:
    """Bits that a number below 4 may have so that the sum of `summands` of them fits 63 bits."""
    return 60 - math.ceil(math.log2(max(summands, 1)))


def sums(of: Tensor) -> Tensor:
    """Zeros for the units of a gradient of a tensor, contiguous. One launch."""
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
    """The power of two that brings numbers up to `largest` below 4."""
    return (tl.maximum(255 - _exponent(largest), 1) << 23).to(tl.float32, bitcast=True)


@triton.jit(do_not_specialize=["count", "each"])
def _finish(sums, largest, out, count, each, BITS: tl.constexpr, BLOCK: tl.constexpr):
    k = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    mask = k < count
    exponent = _exponent(tl.load(largest + k // each, mask=mask, other=0.0))
    value = tl.load(sums + k, mask=mask, other=0).to(tl.float32) * (0.5 / (1 << BITS))
    # An exponent of 255 is that of infinity and NaN.
    power = tl.where(exponent == 255, 0x7FC00000, exponent << 23).to(tl.float32, bitcast=True)
    tl.store(out + k, (value * power).to(out.dtype.element_ty), mask=mask)


def finish(sums: Tensor, largest: Tensor, out: Tensor, bits: int) -> None:
    """Writes sums of units as numbers. One launch."""
    if out.numel() > 0:
        _finish[(triton.cdiv(out.numel(), BLOCK),)](
            sums, largest, out, out.numel(), out[0].numel(), BITS=bits, BLOCK=BLOCK, num_warps=4,
            enable_fp_fusion=True,
        )  # fmt: skip


def like(gradients: Tensor, tensor: Tensor) -> Tensor:
    """Gradients of each image as that of a tensor, added up if the images share it."""
    if len(tensor) < len(gradients):
        gradients = gradients.sum(0, keepdim=True)
    return gradients.to(tensor.dtype).contiguous()
