"""The operators in plain PyTorch.

These functions define the operators, and the tests compare with them. They run within
`use_reference` and on devices other than the CPU. Each has the name and the parameters of its
operator. The arguments are already checked, and those of a sampling are one `Sampling`.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.ops._sampling import Sampling
from darswin.ops.checks import tensor_there

_WORD = 0xFFFFFFFF
# Up to this side of an image, its coordinates between -1 and 1 are exact to 1e-5 px in float32.
_MESH_SIDE = 256


def philox(seed: Tensor, low: Tensor, high: Tensor) -> list[Tensor]:
    """The four 32-bit words of Philox4x32-10 for key `seed` and counter (low, high), as int64.

    Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
    """
    k0, k1 = seed & _WORD, (seed >> 32) & _WORD
    c0, c1, c2, c3 = torch.broadcast_tensors(
        low & _WORD, (low >> 32) & _WORD, high & _WORD, (high >> 32) & _WORD
    )
    for _ in range(10):
        (hi0, lo0), (hi1, lo1) = _multiply(0xD2511F53, c0), _multiply(0xCD9E8D57, c2)
        c0, c1, c2, c3 = hi1 ^ c1 ^ k0, lo1, hi0 ^ c3 ^ k1, lo0
        k0, k1 = (k0 + 0x9E3779B9) & _WORD, (k1 + 0xBB67AE85) & _WORD
    return [c0, c1, c2, c3]


def _multiply(a: int, b: Tensor) -> tuple[Tensor, Tensor]:
    """Upper and lower word of a 32x32-bit product, without an overflow of int64."""
    upper, lower = a * (b >> 16), a * (b & 0xFFFF)
    total = ((upper & 0xFFFF) << 16) + lower
    return (upper >> 16) + (total >> 32), total & _WORD


def _jittered(
    radii: Tensor, azimuths: Tensor, batch: int, jitter: Tensor, seed: Tensor
) -> tuple[Tensor, Tensor]:
    """Radius and azimuth of each point, (B, N_r, N_a)."""
    rows, columns, device = radii.shape[1], azimuths.shape[0], radii.device
    point = torch.arange(rows * columns, device=device).reshape(1, rows, columns)
    image = torch.arange(batch, device=device).reshape(-1, 1, 1)
    # Word p % 4 of counter p / 4; u and v in [-1/2, 1/2) are its halves.
    words = torch.stack(philox(seed, point // 4, image))
    word = words.gather(0, (point % 4).expand(1, batch, rows, columns))[0]
    u, v = (
        (half.to(radii.dtype) * 2.0**-16 - 0.5) * jitter for half in (word >> 16, word & 0xFFFF)
    )
    # Infinite radii become NaN, since clamping would turn minus infinity into 0.
    radii = torch.where(radii.isfinite(), radii, math.nan)
    # The steps to the outer and to the inner neighbour; the ends have only one of the two.
    steps = radii.diff(dim=1) if rows > 1 else torch.zeros_like(radii)
    outer = torch.cat((steps, steps[:, -1:]), 1)[:, :rows, None]
    inner = torch.cat((steps[:, :1], steps), 1)[:, :rows, None]
    moved = radii[:, :, None] + u * torch.where(u < 0, inner, outer)
    return moved.clamp(min=0), azimuths + v * (2 * math.pi / columns)


def normalized(
    image: Tensor, mean: Sequence[float], std: Sequence[float], dtype: torch.dtype = torch.float32
) -> Tensor:
    """`(pixel - mean) / std` of an image (B, C, H, W) in [0, 1], in `dtype`, for each channel. A
    uint8 image is divided by 255 first."""
    m, s = (
        # One number is enough if all channels share it.
        tensor_there(values if len(set(values)) > 1 else values[:1], image, dtype)[:, None, None]
        for values in (mean, std)
    )
    pixels = image.to(dtype) / 255 if image.dtype == torch.uint8 else image.to(dtype)
    return (pixels - m) / s


def polar_sample(sampling: Sampling, tokens: bool) -> Tensor:
    """See `darswin.ops.polar_sample`."""
    image, radii, azimuths, center, affine, offsets = sampling[:6]
    if image.dtype != torch.uint8:
        image = image.to(radii.dtype)  # bfloat16 is computed in float32
    batch, channels, height, width = image.shape
    rows, columns = radii.shape[1], azimuths.shape[0]
    r, a = radii[:, :, None], azimuths[None, None, :]
    jitter, seed = sampling.jitter, sampling.seed
    if jitter is not None and seed is not None and rows > 0 and columns > 0:
        r, a = _jittered(radii, azimuths, batch, jitter, seed)
    # Keep NaN and infinity out of the gradients: they do not vanish when multiplied by 0.
    known = r.isfinite() & a.isfinite()
    r, a = torch.where(r.isfinite(), r, 0), torch.where(a.isfinite(), a, 0)
    x, y = r * torch.cos(a), r * torch.sin(a)  # (B or 1, N_r, N_a)
    if affine is not None:
        known = known & affine.isfinite().all(2).all(1)[:, None, None]
        (xx, xy), (yx, yy) = affine.nan_to_num(0, 0, 0).permute(1, 2, 0)[..., None, None]
        x, y = xx * x + xy * y, yx * x + yy * y
    x, y = center[:, 0, None, None] + x, center[:, 1, None, None] + y
    if offsets is not None:
        x, y = x + offsets[:, 0], y + offsets[:, 1]
    touches = known & (x > -1) & (x < width) & (y > -1) & (y < height)  # NaN touches nothing
    x, y = torch.where(touches, x, -2), torch.where(touches, y, -2)
    # A frame of a camera would become floats as a whole.
    if image.dtype != torch.uint8 and _meshes(height, width, radii):
        return laid_out(_sampled(image, x, y), sampling, tokens)
    left, top = x.detach().floor(), y.detach().floor()
    right, lower = x - left, y - top
    # Index the values in their order in memory, where the channels of a camera frame lie side by
    # side. Otherwise an exported graph would copy the whole image to change the order.
    if image.stride(1) == 1:
        values, pixel_step, channel_step = image.permute(0, 2, 3, 1).flatten(1), channels, 1
    else:
        values, pixel_step, channel_step = image.flatten(1), 1, height * width
    channel = torch.arange(channels, device=image.device)[:, None] * channel_step
    out = radii.new_zeros(())
    for down, wy in ((0, 1 - lower), (1, lower)):
        for across, wx in ((0, 1 - right), (1, right)):
            column, row = left.long() + across, top.long() + down
            inside = touches & (column >= 0) & (column < width) & (row >= 0) & (row < height)
            pixel = torch.where(inside, row * width + column, 0).flatten(1)
            index = (pixel[:, None] * pixel_step + channel).flatten(1).expand(batch, -1)
            corner = values.gather(1, index) if height * width else values.new_zeros(index.shape)
            corner = corner.unflatten(1, (channels, rows, columns))
            if corner.dtype == torch.uint8:
                corner = normalized(corner, sampling.mean, sampling.std)
            # A pixel outside the image must not count, even if the gathered value is NaN.
            corner = torch.where(inside[:, None], corner, 0)
            out = out + (wx * wy)[:, None] * corner
    return laid_out(out, sampling, tokens)


def _meshes(height: int, width: int, like: Tensor) -> bool:
    """True if `_sampled` is to be used: in the graphs for other runtimes, where it is fast."""
    small = max(height, width) <= _MESH_SIDE and min(height, width) > 0
    return torch.compiler.is_exporting() and small and like.dtype == torch.float32


def _sampled(image: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Samples images (B, C, H, W) at points (B or 1, N_r, N_a), px: (B, C, N_r, N_a)."""
    batch, channels, height, width = image.shape
    mesh = torch.stack(((2 * x + 1) / width - 1, (2 * y + 1) / height - 1), -1)
    if mesh.shape[0] != 1:
        return F.grid_sample(image, mesh, align_corners=False)
    sampled = F.grid_sample(image.flatten(0, 1)[None], mesh, align_corners=False)
    return sampled[0].unflatten(0, (batch, channels))


def laid_out(out: Tensor, sampling: Sampling, tokens: bool) -> Tensor:
    """The samples (B, C, R·S_r, A·S_φ) in the dtype and the layout of the output."""
    out = out.bfloat16() if sampling.bfloat16 else out
    if not tokens:
        return out
    size, (along, around) = sampling.map_size(), sampling.samples
    out = out.reshape(*out.shape[:2], size[1], along, size[2], around)
    return out.permute(0, 2, 4, 3, 5, 1).reshape(*size, sampling.token_size())


def polar_to_image(
    x: Tensor,
    radii: Tensor,
    center: Tensor | None,
    affine: Tensor | None,
    points: Tensor | None,
    r_max: Tensor | None,
    size: Sequence[int],
    tokens: bool,
    plan: Tensor | None = None,
) -> Tensor:
    """See `darswin.ops.polar_to_image`. It computes the positions itself and ignores the plan."""
    batch, rings, sectors, channels = x.shape
    if points is None and center is not None:
        points = on_polar_plane(size, center, affine)
    assert points is not None
    across, down = points.unbind(-1)  # (N, H, W)
    known = across.isfinite() & down.isfinite()
    across, down = torch.where(known, across, 1), torch.where(known, down, 0)
    # Neither the radius nor the azimuth has a derivative at the centre itself.
    middle = (across == 0) & (down == 0)
    across = torch.where(middle, 1, across)
    r = torch.where(middle, 0, (across.square() + down.square()).sqrt())
    azimuth = torch.atan2(down, across)
    known = known & r.isfinite()
    if r_max is not None:
        known = known & (r <= r_max[:, None, None])

    rows = 1 if r.shape[0] == radii.shape[0] == 1 else batch
    r, azimuth = (t.expand(rows, *t.shape[1:]) for t in (r, azimuth))
    known, radii = known.expand(rows, *known.shape[1:]), radii.expand(rows, rings)
    # The ring centres on both sides of each pixel. Inside the first ring, the inner centre lies
    # across the pole, at a negative radius. Beyond the last ring, both are the last centre.
    above = ranks(radii.detach(), r.detach().flatten(1)).reshape(r.shape)
    pole, beyond = above == 0, above == rings
    inner, outer = (above - 1).clamp(min=0), above.clamp(max=rings - 1)
    first, second = (radii.gather(1, k.flatten(1)).reshape(r.shape) for k in (inner, outer))
    first = torch.where(pole, -first, first)
    span = torch.where(beyond, 1, second - first)
    t = torch.where(beyond, 0, (r - first) / span)

    column = azimuth * (sectors / (2 * math.pi)) - 0.5
    if sectors % 2 == 0 and _meshes(rings, sectors, radii):
        # The map with the ring across the pole before the first, and the first sector again.
        maps = torch.cat((x[:, :1].roll(sectors // 2, 2), x), 1).to(radii.dtype)
        maps = torch.cat((maps, maps[:, :, :1]), 2).permute(0, 3, 1, 2)
        out = _sampled(maps, column.remainder(sectors), above + t)
        out = torch.where(known[:, None], out, 0).to(x.dtype)
        return out.permute(0, 2, 3, 1) if tokens else out
    maps = x.to(radii.dtype).flatten(1, 2)  # bfloat16 is computed in float32
    out = maps.new_zeros(())
    for ring, weight, place in (
        (inner, 1 - t, torch.where(pole, column + sectors / 2, column)),
        (outer, t, column),
    ):
        left = place.detach().floor()
        for sector, share in ((left, 1 - (place - left)), (left + 1, place - left)):
            index = (ring * sectors + sector.long() % sectors).flatten(1)
            index = index[:, :, None].expand(batch, -1, channels)
            corner = maps.gather(1, index).unflatten(1, tuple(size))
            out = out + (weight * share)[..., None] * corner
    out = torch.where(known[..., None], out, 0).to(x.dtype)
    return out if tokens else out.permute(0, 3, 1, 2).contiguous()


def ranks(rising: Tensor, values: Tensor) -> Tensor:
    """Counts (N, K): for each of the values (N, K), how many of the `rising` (N, R) are at most
    the value."""
    if not torch.compiler.is_compiling():
        return torch.searchsorted(rising.contiguous(), values.contiguous(), right=True)
    # ONNX has no searchsorted: a binary search, from the highest bit of the count to the lowest.
    most = rising.shape[1]
    count = torch.zeros_like(values, dtype=torch.long)
    for bit in reversed(range(most.bit_length())):
        more = count + (1 << bit)
        last = rising.gather(1, more.clamp(max=most) - 1)
        count = torch.where((more <= most) & (last <= values), more, count)
    return count


def on_polar_plane(size: Sequence[int], center: Tensor, affine: Tensor | None) -> Tensor:
    """(N, H, W, 2): each pixel's position relative to the centre, with the matrix inverted."""
    height, width = size
    y, x = (torch.arange(n, dtype=center.dtype, device=center.device) for n in (height, width))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    points = pixels - center[:, None, None]
    if affine is None:
        return points
    (a, b), (c, d) = affine.permute(1, 2, 0)
    inverse = torch.stack((torch.stack((d, -b), -1), torch.stack((-c, a), -1)), -2)
    inverse = inverse / (a * d - b * c)[:, None, None]
    return torch.einsum("nij,nhwj->nhwi", inverse, points)


def mlp(x: Tensor, weight1: Tensor, bias1: Tensor, weight2: Tensor, bias2: Tensor) -> Tensor:
    """`darswin.ops.linear.mlp`."""
    return F.linear(F.gelu(F.linear(x, weight1, bias1)), weight2, bias2)


def window_attention(
    qkv: Tensor,
    bias: Tensor,
    window: tuple[int, int],
    shift: tuple[int, int],
    periodic: tuple[bool, bool],
    scale: float,
) -> Tensor:
    """See `darswin.ops.window_attention`."""
    batch, rings, sectors, _, heads, head_dim = qkv.shape
    dtype, qkv = qkv.dtype, qkv.to(bias.dtype)  # computes bfloat16 in float32, rounds at the end
    (mr, ma), (nr, na) = window, (rings // window[0], sectors // window[1])
    x = qkv.roll((-shift[0], -shift[1]), (1, 2)).reshape(batch, nr, mr, na, ma, 3, heads, head_dim)
    # (B, n_r, n_a, heads, M_r·M_φ, d)
    q, k, v = x.permute(5, 0, 1, 3, 6, 2, 4, 7).flatten(5, 6)
    logits = q @ k.transpose(-1, -2) * scale
    logits = logits + pairwise_bias(bias, window)[:, None, None]
    if (shift[0] and not periodic[0]) or (shift[1] and not periodic[1]):
        visible = visible_pairs(rings, sectors, window, shift, periodic, qkv.device)
        logits = logits.masked_fill(~visible[:, :, None], -math.inf)
    out = (logits.softmax(-1) @ v).unflatten(4, (mr, ma))
    out = out.permute(0, 1, 4, 2, 5, 3, 6).reshape(batch, rings, sectors, heads * head_dim)
    return out.roll(shift, (1, 2)).to(dtype)


def pairwise_bias(bias: Tensor, window: tuple[int, int]) -> Tensor:
    """The bias of each pair (query, key): (B or 1, heads, N, N) for N = M_r·M_φ tokens."""
    r = torch.arange(window[0], device=bias.device)
    a = torch.arange(window[1], device=bias.device)
    delta_r = (r[:, None] - r[None, :] + window[0] - 1)[:, None, :, None]
    delta_a = (a[:, None] - a[None, :] + window[1] - 1)[None, :, None, :]
    return bias[:, :, delta_r, delta_a].flatten(4, 5).flatten(2, 3)


def visible_pairs(rings, sectors, window, shift, periodic, device) -> Tensor:
    """(n_r, n_a, N, N): True for pairs of a window's tokens on the same side of the border."""
    side = torch.zeros(rings, sectors, dtype=torch.long, device=device)
    if not periodic[0]:
        side[rings - shift[0] :] += 1
    if not periodic[1]:
        side[:, sectors - shift[1] :] += 2
    side = side.reshape(rings // window[0], window[0], sectors // window[1], window[1])
    side = side.transpose(1, 2).flatten(2, 3)
    return side[:, :, :, None] == side[:, :, None, :]
