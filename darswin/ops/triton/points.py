"""Kernel functions for the positions of a polar grid's points and the pixels around them.

Angles are reduced to values near 0 in float64, and the rest is computed in float32. Cosine and sine
are accurate to about one rounding for any angle. Jitter uses the same random words as the
reference.
"""

import triton
import triton.language as tl

_PI = tl.constexpr(3.141592653589793)


@triton.jit
def sin_cos(angle):
    """Sine and cosine of float64 angles, in float32. Source: Cephes, sinf.c."""
    quarters = tl.floor(angle * (2 / _PI) + 0.5)
    near = (angle - quarters * (_PI / 2)).to(tl.float32)
    quarter = tl.where(tl.abs(quarters) < 2147483648.0, quarters, 0.0).to(tl.int32)
    z = near * near
    sin = (-1.9515295891e-4 * z + 8.3321608736e-3) * z - 1.6666654611e-1
    sin = sin * z * near + near
    cos = (2.443315711809948e-5 * z - 1.388731625493765e-3) * z + 4.166664568298827e-2
    cos = cos * z * z - 0.5 * z + 1.0
    turned = (quarter & 1) != 0
    sin, cos = tl.where(turned, cos, sin), tl.where(turned, sin, cos)
    sin = tl.where((quarter & 2) != 0, -sin, sin)
    cos = tl.where(((quarter + 1) & 2) != 0, -cos, cos)
    return sin, cos


@triton.jit
def random_shift(jitter, seed, image, point):
    """u·jitter and v·jitter for points of an image, from the halves of a Philox4x32-10 word."""
    key = tl.load(seed) if seed.dtype.is_ptr() else seed
    image = image.to(tl.int32)
    first, second, third, fourth = tl.philox(key.to(tl.int64), point // 4, 0, image, 0)
    lane = point % 4
    word = tl.where(lane < 2, tl.where(lane == 0, first, second),
                    tl.where(lane == 2, third, fourth))  # fmt: skip
    u = (word >> 16).to(tl.float32) * 0.0000152587890625 - 0.5
    v = (word & 0xFFFF).to(tl.float32) * 0.0000152587890625 - 0.5
    return u * jitter, v * jitter


@triton.jit
def _known(x):
    """x, or NaN where it is infinite."""
    return tl.where(tl.abs(x) < float("inf"), x, float("nan"))


@triton.jit
def locate(radii, azimuths, center, affine, offsets, jitter, seed, steps, b, i, j, mask, rows,
           COLUMNS: tl.constexpr):  # fmt: skip
    """Positions of the points (i, j) of image b where mask is True.

    affine, offsets, and jitter with seed may be None. steps are the strides from one image to the
    next of radii, center, affine and offsets, and 0 where images share them.

    Returns x and y; their derivatives with respect to the radius; the radius times cosine and times
    sine; the shift by jitter in cells along the radius; and whether a negative radius was clamped.
    """
    radii_step, center_step, affine_step, offsets_step = steps
    point = i * COLUMNS + j
    radius = tl.load(radii + b * radii_step + i, mask=mask, other=0.0)
    angle = tl.load(azimuths + j, mask=mask, other=0.0).to(tl.float64)
    shift = radius * 0.0
    clamped = shift > 0.0
    if seed is not None:
        shift, turn = random_shift(jitter, seed, b, point)
        # The step to the outer or to the inner neighbour; the ends have only one of the two.
        inward = shift < 0.0
        below = tl.where(inward, tl.maximum(i - 1, 0),
                         tl.minimum(i, tl.maximum(rows - 2, 0)))  # fmt: skip
        above = tl.minimum(below + 1, rows - 1)
        row = radii + b * radii_step
        outer = tl.load(row + above, mask=mask, other=0.0)
        inner = tl.load(row + below, mask=mask, other=0.0)
        # Infinite radii become NaN, since clamping would turn minus infinity into 0.
        radius = _known(radius) + shift * (_known(outer) - _known(inner))
        clamped = radius < 0.0
        radius = tl.where(clamped, 0.0, radius)
        angle += (turn * (2 * _PI / COLUMNS)).to(tl.float64)
    sin, cos = sin_cos(angle)
    across, down = cos, sin
    if affine is not None:
        matrix = affine + b * affine_step
        across = tl.load(matrix) * cos + tl.load(matrix + 1) * sin
        down = tl.load(matrix + 2) * cos + tl.load(matrix + 3) * sin
    x = tl.load(center + b * center_step) + radius * across
    y = tl.load(center + b * center_step + 1) + radius * down
    if offsets is not None:
        place = offsets + b * offsets_step + point
        x += tl.load(place, mask=mask, other=0.0)
        y += tl.load(place + rows * COLUMNS, mask=mask, other=0.0)
    return x, y, across, down, radius * cos, radius * sin, shift, clamped


@triton.jit
def cell(x, y, mask, height, width):
    """The column and row of the pixel above and to the left of each point, the distances from it to
    the point, and whether the point touches the image. A point at NaN touches nothing."""
    touches = mask & (x > -1.0) & (x < width) & (y > -1.0) & (y < height)
    x, y = tl.where(touches, x, 0.0), tl.where(touches, y, 0.0)
    left, top = tl.floor(x), tl.floor(y)
    return left.to(tl.int32), top.to(tl.int32), x - left, y - top, touches


@triton.jit
def inside(column, row, touches, height, width):
    """True for pixels that lie in the image and whose point touches the image."""
    return touches & (column >= 0) & (column < width) & (row >= 0) & (row < height)


@triton.jit
def token_order(i, j, COLUMNS: tl.constexpr, S_R: tl.constexpr, S_A: tl.constexpr):
    """The index of points (i, j) among the samples of all tokens."""
    token = i // S_R * (COLUMNS // S_A) + j // S_A
    return token * (S_R * S_A) + i % S_R * S_A + j % S_A


@triton.jit
def point_of(place, COLUMNS: tl.constexpr, S_R: tl.constexpr, S_A: tl.constexpr):
    """The points (i, j) at the given indices: the inverse of `token_order`."""
    token, sample = place // (S_R * S_A), place % (S_R * S_A)
    i = token // (COLUMNS // S_A) * S_R + sample // S_A
    return i, token % (COLUMNS // S_A) * S_A + sample % S_A


@triton.jit
def of_channel(values, c):
    """Element c of a tuple that holds one number per channel."""
    value = values[0]
    for k in tl.static_range(1, len(values)):
        value = tl.where(c == k, values[k], value)
    return value


@triton.jit
def four_pixels(image, strides, scale, shift, column, row, touches, height, width, c):
    """Channel c of the four pixels around each point, in float32: upper left, upper right, lower
    left, lower right. Pixels outside the image are 0. scale and shift, if given, hold one number
    per channel, and each pixel becomes pixel * scale + shift."""
    _, channel_stride, row_stride, column_stride = strides
    upper = image + tl.cast(c, tl.int64) * channel_stride + row.to(tl.int64) * row_stride
    left = column.to(tl.int64) * column_stride
    return (
        _pixel(upper + left, inside(column, row, touches, height, width), scale, shift, c),
        _pixel(upper + left + column_stride,
               inside(column + 1, row, touches, height, width), scale, shift, c),
        _pixel(upper + row_stride + left,
               inside(column, row + 1, touches, height, width), scale, shift, c),
        _pixel(upper + row_stride + left + column_stride,
               inside(column + 1, row + 1, touches, height, width), scale, shift, c),
    )  # fmt: skip


@triton.jit
def _pixel(place, there, scale, shift, c):
    value = tl.load(place, mask=there, other=0).to(tl.float32)
    if scale is not None:
        value = tl.where(there, value * of_channel(scale, c) + of_channel(shift, c), 0.0)
    return value
