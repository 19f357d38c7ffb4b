"""polar_to_image on CUDA devices: forward and backward.

Each program handles a block of an image's pixels. It finds their two rings and two sectors once,
and then interpolates the four tokens in chunks of channels. In backward, a token's gradient is a
sum of integers (`fixed_point`). Each program writes its own sums for the lens, and torch adds these
up.
"""

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from darswin.ops._library import empty_gradients
from darswin.ops.polar_to_image import GRADIENTS
from darswin.ops.triton import fixed_point
from darswin.ops.triton.fixed_point import like, near_one

# The pixels of a program, and the largest number of channels in a chunk.
BLOCK, CHUNK = 64, 32
BACKWARD_BLOCK, BACKWARD_CHUNK = 32, 8
# Sums of the gradients of x and y, and of their products with the vector from the centre.
_PLANE_SUMS = 6

# Sizes that Triton would turn into constants of the kernel if they are 1.
_SIZES = ["rings", "height", "width"]


@triton.jit
def _columns(x, y, SECTORS: tl.constexpr):
    """The azimuth atan2(y, x) in units of a sector, float32. Source: Cephes, atanf.c."""
    wide, high = tl.abs(x), tl.abs(y)
    least, most = tl.minimum(wide, high), tl.maximum(wide, high)
    beyond = least > 0.4142135623730950 * most  # π/8
    tangent = tl.math.div_rn(
        tl.where(beyond, least - most, least), tl.where(beyond, least + most, most)
    )
    z = tangent * tangent
    angle = (8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1
    angle = (angle * z - 3.33329491539e-1) * z * tangent + tangent
    # Eighths of a turn are added in units of a sector, in which they are exact.
    columns = angle * (SECTORS / 6.283185307179586)
    columns = tl.where(beyond, SECTORS / 8 + columns, columns)
    columns = tl.where(high > wide, SECTORS / 4 - columns, columns)
    columns = tl.where(x < 0.0, SECTORS / 2 - columns, columns)
    return tl.where(y < 0.0, -columns, columns)


@triton.jit
def _split(column, SECTORS: tl.constexpr):
    """The sectors before and after a position, and the weight of the second one."""
    left = tl.floor(column)
    sector = (left.to(tl.int32) + SECTORS) % SECTORS
    return sector, (sector + 1) % SECTORS, column - left


@triton.jit
def _plane(center, affine, points, steps, b, k, mask, width):
    """Positions of pixels k on the plane of radius and azimuth, their vectors from the centre, and
    the inverse matrix. Either points is given, or center with an optional affine."""
    _, center_step, affine_step, points_step, _ = steps
    if points is not None:
        place = points + b * points_step + 2 * k.to(tl.int64)
        x = tl.load(place, mask=mask, other=0.0)
        y = tl.load(place + 1, mask=mask, other=0.0)
        from_x, from_y = x, y
    else:
        from_x = (k % width).to(tl.float32) - tl.load(center + b * center_step)
        from_y = (k // width).to(tl.float32) - tl.load(center + b * center_step + 1)
        x, y = from_x, from_y
        if affine is not None:
            matrix = affine + b * affine_step
            xx, xy = tl.load(matrix), tl.load(matrix + 1)
            yx, yy = tl.load(matrix + 2), tl.load(matrix + 3)
            determinant = xx * yy - xy * yx
            x = tl.math.div_rn(yy, determinant) * from_x + tl.math.div_rn(-xy, determinant) * from_y
            y = tl.math.div_rn(-yx, determinant) * from_x + tl.math.div_rn(xx, determinant) * from_y
    return x, y, from_x, from_y


@triton.jit
def _place(radii, r_max, steps, x, y, b, mask, rings, SECTORS: tl.constexpr,
           RING_BITS: tl.constexpr):  # fmt: skip
    """For positions on the plane: whether they are on the map, the radius, the inner ring, the
    outer ring and its weight, both rings' radii, whether the position lies inside the first or
    beyond the last ring, the four tokens, and the weight of the second token of each ring."""
    radii_step, _, _, _, r_max_step = steps
    known = mask & (tl.abs(x) < float("inf")) & (tl.abs(y) < float("inf"))
    x, y = tl.where(known, x, 1.0), tl.where(known, y, 0.0)
    r = tl.math.sqrt_rn(x * x + y * y)
    known = known & (r < float("inf"))
    if r_max is not None:
        known = known & (r <= tl.load(r_max + b * r_max_step))
    radii += b * radii_step
    within = tl.zeros(x.shape, tl.int32)
    for bit in tl.static_range(RING_BITS):
        further = within + (1 << (RING_BITS - 1 - bit))
        radius = tl.load(radii + tl.minimum(further, rings) - 1)
        within = tl.where((further <= rings) & (radius <= r), further, within)
    inner, outer = tl.maximum(within - 1, 0), tl.minimum(within, rings - 1)
    first, second = tl.load(radii + inner), tl.load(radii + outer)
    pole, beyond = within == 0, within == rings
    first = tl.where(pole, -first, first)
    t = tl.where(beyond, 0.0, tl.math.div_rn(r - first, tl.where(beyond, 1.0, second - first)))
    # The azimuth at the centre itself is 0.
    column = _columns(tl.where(r == 0.0, 1.0, x), tl.where(r == 0.0, 0.0, y), SECTORS) - 0.5
    before, after, share = _split(tl.where(pole, column + SECTORS / 2, column), SECTORS)
    before_2, after_2, share_2 = _split(column, SECTORS)
    tokens = (inner * SECTORS + before, inner * SECTORS + after,
              outer * SECTORS + before_2, outer * SECTORS + after_2)  # fmt: skip
    return known, r, inner, outer, t, first, second, pole, beyond, tokens, share, share_2


@triton.jit
def _tile(place, token, channel, CHANNELS: tl.constexpr, mask):
    """Channels of tokens, in float32."""
    at = token.to(tl.int64)[:, None] * CHANNELS + channel
    return tl.load(place + at, mask=mask, other=0.0).to(tl.float32)


@triton.jit
def _in_image(k, channel, pixels, CHANNELS: tl.constexpr, TOKENS: tl.constexpr):
    """The index of the channels of pixels k in an image."""
    if TOKENS:
        return k.to(tl.int64)[:, None] * CHANNELS + channel
    else:
        return channel * pixels.to(tl.int64) + k[:, None]


@triton.jit(do_not_specialize=_SIZES)
def _forward(x, radii, center, affine, points, r_max, steps, rings, height, width, out,
             SECTORS: tl.constexpr, CHANNELS: tl.constexpr, RING_BITS: tl.constexpr,
             TOKENS: tl.constexpr, CHUNK: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    pixels = height * width
    blocks = tl.cdiv(pixels, BLOCK)
    b = (tl.program_id(0) // blocks).to(tl.int64)
    k = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)
    mask = k < pixels
    at_x, at_y, _, _ = _plane(center, affine, points, steps, b, k, mask, width)
    known, _, _, _, t, _, _, _, _, tokens, share, share_2 = _place(
        radii, r_max, steps, at_x, at_y, b, mask, rings, SECTORS, RING_BITS
    )
    x += b * rings * SECTORS * CHANNELS
    out += b * pixels * CHANNELS
    weights = ((1.0 - t) * (1.0 - share), (1.0 - t) * share, t * (1.0 - share_2), t * share_2)
    for c in range(0, CHANNELS, CHUNK):
        channel = c + tl.arange(0, CHUNK)[None, :]
        there = known[:, None] & (channel < CHANNELS)
        mixed = weights[0][:, None] * _tile(x, tokens[0], channel, CHANNELS, there)
        for n in tl.static_range(1, 4):
            mixed += weights[n][:, None] * _tile(x, tokens[n], channel, CHANNELS, there)
        # The weights of pixels outside the map may be NaN.
        mixed = tl.where(there, mixed, 0.0)
        place = _in_image(k, channel, pixels, CHANNELS, TOKENS)
        tl.store(out + place, mixed.to(out.dtype.element_ty),
                 mask=mask[:, None] & (channel < CHANNELS))  # fmt: skip


@triton.jit(do_not_specialize=_SIZES)
def _backward(x, radii, center, affine, points, r_max, steps, rings, height, width, grad_out,
              largest, map_sums, ring_sums, plane_sums, grad_points, SECTORS: tl.constexpr,
              CHANNELS: tl.constexpr, RING_BITS: tl.constexpr, TOKENS: tl.constexpr,
              BITS: tl.constexpr, CHUNK: tl.constexpr, BLOCK: tl.constexpr):  # fmt: skip
    pixels = height * width
    blocks = tl.cdiv(pixels, BLOCK)
    b = (tl.program_id(0) // blocks).to(tl.int64)
    k = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)
    mask = k < pixels
    at_x, at_y, from_x, from_y = _plane(center, affine, points, steps, b, k, mask, width)
    known, r, inner, outer, t, first, second, pole, beyond, tokens, share, share_2 = _place(
        radii, r_max, steps, at_x, at_y, b, mask, rings, SECTORS, RING_BITS
    )
    x += b * rings * SECTORS * CHANNELS
    grad_out += b * pixels * CHANNELS
    weights = ((1.0 - t) * (1.0 - share), (1.0 - t) * share, t * (1.0 - share_2), t * share_2)
    if map_sums is not None:
        map_sums += b * rings * SECTORS * CHANNELS
        unit = near_one(tl.load(largest + b))
    by_inner, by_outer = t * 0.0, t * 0.0
    by_column = t * 0.0
    for c in range(0, CHANNELS, CHUNK):
        channel = c + tl.arange(0, CHUNK)[None, :]
        there = known[:, None] & (channel < CHANNELS)
        place = _in_image(k, channel, pixels, CHANNELS, TOKENS)
        grad = tl.load(grad_out + place, mask=there, other=0.0).to(tl.float32)
        if map_sums is not None:
            for n in tl.static_range(4):
                units = (grad * unit * weights[n][:, None] * (1 << BITS)).to(tl.int64)
                at = tokens[n].to(tl.int64)[:, None] * CHANNELS + channel
                tl.atomic_add(map_sums + at, units, mask=there, sem="relaxed")
        if ring_sums is not None:
            one = tl.sum(grad * _tile(x, tokens[0], channel, CHANNELS, there), 1)
            two = tl.sum(grad * _tile(x, tokens[1], channel, CHANNELS, there), 1)
            three = tl.sum(grad * _tile(x, tokens[2], channel, CHANNELS, there), 1)
            four = tl.sum(grad * _tile(x, tokens[3], channel, CHANNELS, there), 1)
            by_inner += (1.0 - share) * one + share * two
            by_outer += (1.0 - share_2) * three + share_2 * four
            by_column += (1.0 - t) * (two - one) + t * (four - three)
    if ring_sums is not None:
        by_t = by_outer - by_inner
        # Inside the first ring t = (r + first) / 2 first, else (r - inner) / (outer - inner).
        on_slope = known & (beyond == 0)
        slope = tl.math.div_rn(by_t, tl.where(beyond, 1.0, second - first))
        slope = tl.where(on_slope, slope, 0.0)
        ring_sums += tl.program_id(0).to(tl.int64) * rings
        for ring in range(rings):
            change = tl.where(inner == ring, (1.0 - t) * tl.where(pole, -1.0, 1.0), 0.0)
            change += tl.where(outer == ring, t, 0.0)
            tl.store(ring_sums + ring, -tl.sum(tl.where(on_slope, slope * change, 0.0)))
        # Radius and azimuth have no derivative at the centre itself.
        moves = known & (r > 0.0)
        near = tl.where(moves, r, 1.0)
        along = tl.where(moves, tl.math.div_rn(slope, near), 0.0)
        turn = tl.where(moves, by_column * (SECTORS / 6.283185307179586), 0.0)
        turn = tl.math.div_rn(turn, near * near)
        by_x = tl.where(moves, along * at_x - turn * at_y, 0.0)
        by_y = tl.where(moves, along * at_y + turn * at_x, 0.0)
        if points is not None:
            to = grad_points + b * pixels * 2 + 2 * k.to(tl.int64)
            tl.store(to, by_x, mask=mask)
            tl.store(to + 1, by_y, mask=mask)
        else:
            from_x, from_y = tl.where(moves, from_x, 0.0), tl.where(moves, from_y, 0.0)
            to = plane_sums + tl.program_id(0).to(tl.int64) * 6
            sums = (by_x, by_y, by_x * from_x, by_x * from_y, by_y * from_x, by_y * from_y)
            for n in tl.static_range(6):
                tl.store(to + n, tl.sum(sums[n]))


def _arguments(x: Tensor, lens: Sequence[Tensor | None], size: Sequence[int]) -> tuple[Any, ...]:
    """The first arguments of both kernels, up to `width`."""
    given = [None if tensor is None else tensor.contiguous() for tensor in lens]
    steps = tuple(0 if t is None or len(t) == 1 else t.stride(0) for t in given)
    return x.contiguous(), *given, steps, x.shape[1], *size


def _options(x: Tensor, tokens: bool, most_channels: int) -> dict[str, Any]:
    """The constants and the compile options of both kernels."""
    _, rings, sectors, channels = x.shape
    return dict(
        SECTORS=sectors, CHANNELS=channels, RING_BITS=rings.bit_length(), TOKENS=tokens,
        CHUNK=min(triton.next_power_of_2(channels), most_channels), num_warps=4,
        enable_fp_fusion=True,
    )  # fmt: skip


def polar_to_image(x: Tensor, *arguments: Any) -> Tensor:
    """`darswin::polar_to_image`, one launch."""
    *lens, size, tokens, _plan = arguments
    (batch, _, _, channels), (height, width) = x.shape, size
    shape = (batch, height, width, channels) if tokens else (batch, channels, height, width)
    out = x.new_empty(shape)
    if out.numel() > 0:
        _forward[(batch * triton.cdiv(height * width, BLOCK),)](
            *_arguments(x, lens, size), out, BLOCK=BLOCK, **_options(x, tokens, CHUNK)
        )
    return out


def polar_to_image_backward(x: Tensor, *arguments: Any) -> tuple[Tensor, ...]:
    """`darswin::polar_to_image_backward`: gradients of x, radii, center, affine and points."""
    *lens, size, tokens, _plan, grad_out, x_grad, lens_grad = arguments
    radii, center, affine, points, _ = lens
    gradients = empty_gradients((x, *lens), GRADIENTS, (x_grad, lens_grad))
    if grad_out.numel() == 0:
        return tuple(gradient.zero_() for gradient in gradients)
    batch, (height, width) = len(x), size
    programs = batch * triton.cdiv(height * width, BACKWARD_BLOCK)
    bits = fixed_point.bits(height * width)
    largest = map_sums = ring_sums = plane_sums = of_points = None
    if x_grad:
        largest = fixed_point.largest(grad_out)
        map_sums = fixed_point.sums(x)
    if lens_grad:
        ring_sums = radii.new_empty((programs, x.shape[1]))
        if points is None:
            plane_sums = radii.new_empty((programs, _PLANE_SUMS))
        else:
            of_points = radii.new_empty((batch, height, width, 2))
    _backward[(programs,)](
        *_arguments(x, lens, size), grad_out.contiguous(), largest, map_sums, ring_sums,
        plane_sums, of_points, BITS=bits, BLOCK=BACKWARD_BLOCK,
        **_options(x, tokens, BACKWARD_CHUNK),
    )  # fmt: skip
    grad_x, *grads = gradients
    if map_sums is not None and largest is not None:
        fixed_point.finish(map_sums, largest, grad_x, bits)
    if ring_sums is not None:
        rings = ring_sums.view(batch, -1, x.shape[1])
        grads[0] = like(rings.sum(1, dtype=torch.float64), radii)
    if plane_sums is not None and center is not None:
        plane = plane_sums.view(batch, -1, _PLANE_SUMS)
        grads[1:3] = _of_lens(plane.sum(1, dtype=torch.float64), center, affine)
    if of_points is not None and points is not None:
        grads[3] = like(of_points, points)
    return grad_x, *grads


def _of_lens(sums: Tensor, center: Tensor, affine: Tensor | None) -> tuple[Tensor, Tensor]:
    """Computes the gradients of center and affine from sums over pixels: the gradient of a pixel's
    position on the plane, and the products of this gradient with the vector from the centre."""
    of_place, products = sums[:, :2], sums[:, 2:].view(-1, 2, 2)
    if affine is None:
        return like(-of_place, center), center.new_empty((0,))
    # The position is M (pixel - center) with M the inverse of the matrix A: dA = -Mᵀ products Mᵀ.
    (xx, xy), (yx, yy) = affine.double().permute(1, 2, 0)
    inverse = torch.stack((yy, -yx, -xy, xx), -1) / (xx * yy - xy * yx)[:, None]
    transposed = inverse.view(-1, 2, 2)
    of_center = -(transposed @ of_place[:, :, None])[:, :, 0]
    return like(of_center, center), like(-(transposed @ products @ transposed), affine)
