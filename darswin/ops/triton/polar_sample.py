"""polar_sample on CUDA devices: forward and backward.

Forward is one launch, in which each program computes a block of samples in the order of the output.
In backward, each program handles one radius of one image, and the image's gradient is a sum of
integers (`fixed_point`).
"""

from typing import Any

import torch
import torch.nn.functional as F
import triton
import triton.language as tl
from torch import Tensor

from darswin.ops._library import empty_gradients
from darswin.ops._sampling import GRADIENTS, Sampling
from darswin.ops.triton import fixed_point
from darswin.ops.triton.fixed_point import like, near_one
from darswin.ops.triton.points import cell, four_pixels, inside, locate, point_of, token_order

BLOCK = 256  # samples per program
# Sums per radius: of the radius, of its steps inward and outward by jitter, of x and y, and of the
# matrix (four).
_LENS_SUMS = 9

# Sizes that vary, or that Triton would turn into constants of the kernel if they are 1.
_SIZES = ["seed", "height", "width", "rows"]


@triton.jit
def _mix(image, strides, scale, shift, cells, height, width, c, CHANNELS: tl.constexpr):
    """Channel c of points: the weighted sum of four pixels, or 0 if there is no channel c."""
    column, row, right, lower, touches = cells
    upper_left, upper_right, lower_left, lower_right = four_pixels(
        image, strides, scale, shift, column, row, touches & (c < CHANNELS), height, width, c
    )
    above, before = 1.0 - lower, 1.0 - right
    total = before * above * upper_left + right * above * upper_right
    return total + before * lower * lower_left + right * lower * lower_right


@triton.jit(do_not_specialize=_SIZES)
def _forward(image, radii, azimuths, center, affine, offsets, jitter, seed, scale, shift, strides,
             steps, height, width, rows, out, COLUMNS: tl.constexpr, S_R: tl.constexpr,
             S_A: tl.constexpr, CHANNELS: tl.constexpr, TOKENS: tl.constexpr, CHUNK: tl.constexpr,
             BLOCK: tl.constexpr):  # fmt: skip
    points = rows * COLUMNS
    blocks = tl.cdiv(points, BLOCK)
    b = (tl.program_id(0) // blocks).to(tl.int64)
    k = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)
    mask = k < points
    if TOKENS:
        i, j = point_of(k, COLUMNS, S_R, S_A)
    else:
        i, j = k // COLUMNS, k % COLUMNS
    x, y, _, _, _, _, _, _ = locate(
        radii, azimuths, center, affine, offsets, jitter, seed, steps, b, i, j, mask, rows, COLUMNS
    )
    cells = cell(x, y, mask, height, width)
    image += b * strides[0]
    out += b * points * CHANNELS
    for c in range(0, CHANNELS, CHUNK):
        mixed = _mix(image, strides, scale, shift, cells, height, width, c, CHANNELS)
        if CHUNK == 1:
            mixed = mixed[:, None]
        else:
            second = _mix(image, strides, scale, shift, cells, height, width, c + 1, CHANNELS)
            if CHUNK == 4:
                third = _mix(image, strides, scale, shift, cells, height, width, c + 2, CHANNELS)
                fourth = _mix(image, strides, scale, shift, cells, height, width, c + 3, CHANNELS)
                mixed, second = tl.join(mixed, third), tl.join(second, fourth)
            mixed = tl.join(mixed, second).reshape(BLOCK, CHUNK)
        channel = c + tl.arange(0, CHUNK)[None, :]
        if TOKENS:
            place = k.to(tl.int64)[:, None] * CHANNELS + channel
        else:
            place = channel * points.to(tl.int64) + k[:, None]
        there = mask[:, None] & (channel < CHANNELS)
        tl.store(out + place, mixed.to(out.dtype.element_ty), mask=there)


@triton.jit(do_not_specialize=_SIZES)
def _backward(image, radii, azimuths, center, affine, offsets, jitter, seed, scale, shift, strides,
              steps, height, width, rows, grad_out, largest, image_sums, lens_sums, grad_offsets,
              COLUMNS: tl.constexpr, S_R: tl.constexpr, S_A: tl.constexpr, CHANNELS: tl.constexpr,
              TOKENS: tl.constexpr, BITS: tl.constexpr, LENS_SUMS: tl.constexpr,
              BLOCK: tl.constexpr):  # fmt: skip
    b = (tl.program_id(0) // rows).to(tl.int64)
    i = tl.program_id(0) % rows + tl.zeros([BLOCK], tl.int32)
    image += b * strides[0]
    grad_out += b * rows * COLUMNS * CHANNELS
    if image_sums is not None:
        image_sums += b * CHANNELS * height * width
        unit = near_one(tl.load(largest + b))
    zero = tl.zeros([BLOCK], tl.float32)
    along_sum, inward_sum, outward_sum, x_sum, y_sum = zero, zero, zero, zero, zero
    xx_sum, xy_sum, yx_sum, yy_sum = zero, zero, zero, zero
    for start in range(0, COLUMNS, BLOCK):
        j = start + tl.arange(0, BLOCK)
        mask = j < COLUMNS
        x, y, across, down, east, south, moved, clamped = locate(
            radii, azimuths, center, affine, offsets, jitter, seed, steps, b, i, j, mask, rows,
            COLUMNS,
        )  # fmt: skip
        column, row, right, lower, touches = cell(x, y, mask, height, width)
        by_x, by_y = right * 0.0, right * 0.0
        for c in range(CHANNELS):
            if TOKENS:
                place = token_order(i, j, COLUMNS, S_R, S_A).to(tl.int64) * CHANNELS + c
            else:
                place = c * (rows * COLUMNS).to(tl.int64) + i * COLUMNS + j
            grad = tl.load(grad_out + place, mask=touches, other=0.0).to(tl.float32)
            if image_sums is not None:
                for side in tl.static_range(4):
                    share = right if side % 2 else 1.0 - right
                    share = share * (lower if side // 2 else 1.0 - lower)
                    there = inside(column + side % 2, row + side // 2, touches, height, width)
                    pixel = (row + side // 2).to(tl.int64) * width + column + side % 2
                    units = (grad * unit * share * (1 << BITS)).to(tl.int64)
                    tl.atomic_add(image_sums + c * height.to(tl.int64) * width + pixel, units,
                                  mask=there, sem="relaxed")  # fmt: skip
            if lens_sums is not None or grad_offsets is not None:
                upper_left, upper_right, lower_left, lower_right = four_pixels(
                    image, strides, scale, shift, column, row, touches, height, width, c
                )
                upper, bottom = upper_right - upper_left, lower_right - lower_left
                by_x += grad * ((1.0 - lower) * upper + lower * bottom)
                left, past = lower_left - upper_left, lower_right - upper_right
                by_y += grad * ((1.0 - right) * left + right * past)
        if grad_offsets is not None:
            to = grad_offsets + 2 * b * rows * COLUMNS + i * COLUMNS + j
            tl.store(to, by_x, mask=mask)
            tl.store(to + rows * COLUMNS, by_y, mask=mask)
        if lens_sums is not None:
            along = tl.where(touches & (clamped == 0), by_x * across + by_y * down, 0.0)
            along_sum += along
            x_sum += by_x
            y_sum += by_y
            if seed is not None:
                inward_sum += tl.where(moved < 0.0, along * moved, 0.0)
                outward_sum += tl.where(moved < 0.0, 0.0, along * moved)
            if affine is not None:
                xx_sum += tl.where(touches, by_x * east, 0.0)
                xy_sum += tl.where(touches, by_x * south, 0.0)
                yx_sum += tl.where(touches, by_y * east, 0.0)
                yy_sum += tl.where(touches, by_y * south, 0.0)
    if lens_sums is not None:
        to = lens_sums + tl.program_id(0).to(tl.int64) * LENS_SUMS
        sums = (along_sum, inward_sum, outward_sum, x_sum, y_sum, xx_sum, xy_sum, yx_sum, yy_sum)
        for n in tl.static_range(LENS_SUMS):
            tl.store(to + n, tl.sum(sums[n]))


def _arguments(sampling: Sampling) -> tuple[Any, ...]:
    """The first arguments of both kernels, up to `rows`."""
    image, *geometry = sampling[:6]
    radii, azimuths, center, affine, offsets = (
        None if tensor is None else tensor.contiguous() for tensor in geometry
    )
    lens = (radii, center, affine, offsets)
    steps = tuple(0 if t is None or len(t) == 1 else t.stride(0) for t in lens)
    # Numbers on the CPU are passed as arguments of the launch.
    jitter = None if sampling.jitter is None else sampling.jitter.item()
    seed = sampling.seed if sampling.jitter is not None else None
    key = seed.item() if seed is not None and seed.device.type == "cpu" else seed
    scale = shift = None
    if image.dtype == torch.uint8:
        scale = tuple(1 / (255 * std) for std in sampling.std)
        shift = tuple(-mean / std for mean, std in zip(sampling.mean, sampling.std, strict=True))
    return (
        image, radii, azimuths, center, affine, offsets, jitter, key, scale, shift,
        image.stride(), steps, *image.shape[2:], sampling.radii.shape[1],
    )  # fmt: skip


def _options(sampling: Sampling, tokens: bool) -> dict[str, Any]:
    """The constants and the compile options of both kernels."""
    along, around = sampling.samples
    return dict(
        COLUMNS=len(sampling.azimuths), S_R=along, S_A=around, CHANNELS=sampling.image.shape[1],
        TOKENS=tokens, enable_fp_fusion=True,
    )  # fmt: skip


def polar_sample(*arguments: Any) -> Tensor:
    """`darswin::polar_sample`, one launch."""
    *fields, tokens = arguments
    sampling = Sampling(*fields)
    batch, channels = sampling.image.shape[:2]
    rows, columns = sampling.radii.shape[1], len(sampling.azimuths)
    shape: tuple[int, ...] = (batch, channels, rows, columns)
    if tokens:
        shape = (*sampling.map_size(), sampling.token_size())
    out = sampling.new_output(shape)
    if out.numel() > 0:
        _forward[(batch * triton.cdiv(rows * columns, BLOCK),)](
            *_arguments(sampling), out, CHUNK=min(triton.next_power_of_2(channels), 4),
            BLOCK=BLOCK, num_warps=4, **_options(sampling, tokens),
        )  # fmt: skip
    return out


def polar_sample_backward(*arguments: Any) -> tuple[Tensor, ...]:
    """`darswin::polar_sample_backward`. grad_out has the output's order and any shape."""
    *fields, tokens, grad_out, image_grad, lens_grad, offsets_grad = arguments
    sampling = Sampling(*fields)
    gradients = empty_gradients(sampling, GRADIENTS, (image_grad, lens_grad, offsets_grad))
    if grad_out.numel() == 0:
        return tuple(gradient.zero_() for gradient in gradients)
    image, radii, azimuths, _, _, offsets = sampling[:6]
    batch, rows, columns = len(image), radii.shape[1], len(azimuths)
    largest = image_sums = lens_sums = each_offsets = None
    grad_out = grad_out.contiguous()
    if image_grad:
        largest = fixed_point.largest(grad_out.view(batch, -1))
        image_sums = fixed_point.sums(image)
    if lens_grad:
        lens_sums = radii.new_empty((batch, rows, _LENS_SUMS))
    if offsets_grad and offsets is not None:
        each_offsets = radii.new_empty((batch, *offsets.shape[1:]))
    block = min(128, max(32, triton.next_power_of_2(columns)))
    bits = fixed_point.bits(rows * columns)
    _backward[(batch * rows,)](
        *_arguments(sampling), grad_out, largest, image_sums, lens_sums, each_offsets,
        BITS=bits, LENS_SUMS=_LENS_SUMS, BLOCK=block, num_warps=block // 32,
        **_options(sampling, tokens),
    )  # fmt: skip
    if image_sums is not None and largest is not None:
        fixed_point.finish(image_sums, largest, gradients[0], bits)
    of_lens = gradients[1:4] if lens_sums is None else _fold(sampling, lens_sums)
    of_offsets = gradients[4]
    if each_offsets is not None and offsets is not None:
        of_offsets = like(each_offsets, offsets)
    return gradients[0], *of_lens, of_offsets


def _fold(sampling: Sampling, sums: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Computes the gradients of radii, center and affine from the sums of each radius."""
    sums = sums.double()
    of_radii = sums[..., 0]
    if sampling.seed is not None and of_radii.shape[1] > 1:
        # Jitter moves points by steps between radii. At the ends, both sides share one step.
        inward, outward = sums[..., 1], sums[..., 2]
        steps = inward[:, 1:] + outward[:, :-1]
        steps[:, 0] += inward[:, 0]
        steps[:, -1] += outward[:, -1]
        of_radii = of_radii + F.pad(steps, (1, 0)) - F.pad(steps, (0, 1))
    of_center, of_affine = sums[..., 3:].sum(1).split((2, 4), 1)
    affine = sampling.affine
    return (
        like(of_radii, sampling.radii),
        like(of_center, sampling.center),
        sampling.radii.new_empty((0,))
        if affine is None
        else like(of_affine.view(-1, 2, 2), affine),
    )
