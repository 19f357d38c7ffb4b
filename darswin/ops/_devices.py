"""The operators on devices other than the CPU: in PyTorch as the reference, in few kernel launches.

On a GPU a launch costs more than the arithmetic of a small tensor, and what comes from the host is
waited for: all tensors are made on the device. `reference.py` is the definition, and what differs
is rounding. The samples are those of `F.grid_sample`, the attention is torch's own, with the
position bias for a mask; so a NaN or an infinity that a mask hides may spoil its window.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.ops import reference
from darswin.ops._sampling import Sampling

_OUTSIDE = 3.0  # in units in which the image ends at -1 and 1


def philox(seed: Tensor, counters: Tensor) -> Tensor:
    """As `reference.philox`: the words (K, 4) of counters (2, K), low and high ones.

    The words are the lower 32 bits; what lies above them has no meaning. The two multiplications
    of a round are rows of one tensor.
    """
    device, (first, second) = counters.device, (0xD2511F53, 0xCD9E8D57)
    # int64 wraps around, which leaves all 64 bits of an unsigned product right. The rows are there
    # twice, so that those in turned order are a view.
    factors = torch.arange(first, 2 * second - first, second - first, device=device)
    factors = factors[:, None].expand(2, 2, 1)
    # A seed on the CPU is read there, and given along as a number is.
    keys = torch.stack(
        [
            torch.arange(0, 10 * step, step, device=device) + key
            for step, key in ((0x9E3779B9, seed & 0xFFFFFFFF), (0xBB67AE85, seed >> 32))
        ],
        1,
    )
    even, odd = counters, counters >> 32
    for key in keys[..., None].unbind():
        products = ((even & 0xFFFFFFFF) * factors).flatten(0, 1)[1:3]
        even, odd = (products >> 32) ^ (odd ^ key), products
    return torch.stack((even[0], odd[0], even[1], odd[1]), -1)


def _jittered(
    radii: Tensor, azimuths: Tensor, batch: int, jitter: Tensor, seed: Tensor
) -> tuple[Tensor, Tensor]:
    """As `reference._jittered`: radius and azimuth of each point, (B, N_r, N_a)."""
    rows, columns, device = radii.shape[1], azimuths.shape[0], radii.device
    points = rows * columns
    point = torch.arange((points + 3) // 4, device=device)
    image = torch.arange(batch, device=device)[:, None]
    words = philox(seed, torch.stack(torch.broadcast_tensors(point, image)).flatten(1))
    words = words.view(batch, -1)[:, :points].reshape(batch, rows, columns)
    halves = (torch.stack((words >> 16, words)) & 0xFFFF).to(radii.dtype)
    u, v = ((halves * 2.0**-16 - 0.5) * jitter).unbind()
    radii = radii + radii * 0  # infinite radii are as good as NaN
    steps = radii.diff(dim=1) if rows > 1 else torch.zeros_like(radii)
    outer = torch.cat((steps, steps[:, -1:]), 1)[:, :rows, None]
    inner = torch.cat((steps[:, :1], steps), 1)[:, :rows, None]
    moved = torch.addcmul(radii[:, :, None], u, torch.where(u < 0, inner, outer))
    return moved.clamp(min=0), torch.add(azimuths, v, alpha=2 * math.pi / columns)


def polar_sample(sampling: Sampling, tokens: bool) -> Tensor:
    """See `darswin.ops.polar_sample`."""
    image, radii, azimuths, center, affine, offsets = sampling[:6]
    batch, _, height, width = image.shape
    if image.numel() == 0 or radii.numel() == 0 or azimuths.numel() == 0:
        return reference.polar_sample(sampling, tokens)
    if image.dtype == torch.uint8:
        image = reference.normalized(image, sampling.mean, sampling.std)
    image = image.to(radii.dtype)

    def pair(x: float, y: float) -> Tensor:
        return torch.linspace(x, y, 2, dtype=radii.dtype, device=radii.device)

    # A point is compared with the limit, and what is compared with NaN touches nothing. Gradients
    # must not meet NaN: what they are multiplied with is finite.
    limit = pair((width + 1) / 2, (height + 1) / 2) + azimuths[:, None] * 0
    azimuths = azimuths.detach().nan_to_num(0, 0, 0)
    r, a = radii[:, :, None], azimuths
    if sampling.jitter is not None and sampling.seed is not None:
        r, a = _jittered(radii, azimuths, batch, sampling.jitter, sampling.seed)
    r, way = r[..., None], torch.stack((torch.cos(a), torch.sin(a)), -1)
    if affine is not None:
        limit = limit + r.detach() * 0 + (affine.detach() * 0).sum((1, 2))[:, None, None, None]
        r, matrix = r.nan_to_num(0, 0, 0), affine.nan_to_num(0, 0, 0)
        way = (matrix[:, None, None] * way[..., None, :]).sum(-1)
    # From the middle of the image, (B or 1, N_r, N_a, 2).
    middle = center - pair((width - 1) / 2, (height - 1) / 2)
    points = torch.addcmul(middle[:, None, None], r, way)
    if offsets is not None:
        points = points + offsets.permute(0, 2, 3, 1)
    touches = (points.abs() < limit).all(-1, keepdim=True)
    points = torch.where(touches, points * pair(2 / width, 2 / height), _OUTSIDE)
    points = points.expand(batch, *points.shape[1:])
    out = F.grid_sample(image, points, align_corners=False)
    return reference.laid_out(out, sampling, tokens)


def polar_embed(sampling: Sampling, weight: Tensor, bias: Tensor | None) -> Tensor:
    """See `darswin.ops.polar_embed`."""
    samples = polar_sample(sampling._replace(bfloat16=False), tokens=True)
    return reference.embedded(samples, sampling, weight, bias)


def window_attention(
    qkv: Tensor,
    bias: Tensor,
    window: tuple[int, int],
    shift: tuple[int, int],
    periodic: tuple[bool, bool],
    scale: float,
) -> Tensor:
    """See `darswin.ops.window_attention`."""
    if qkv.numel() == 0:
        return reference.window_attention(qkv, bias, window, shift, periodic, scale)
    batch, rings, sectors, _, heads, head_dim = qkv.shape
    (mr, ma), (nr, na) = window, (rings // window[0], sectors // window[1])
    windows, tokens = batch * nr * na, mr * ma
    x = _rolled(qkv.to(bias.dtype), (-shift[0], -shift[1]))
    x = x.reshape(batch, nr, mr, na, ma, 3, heads, head_dim).permute(5, 0, 1, 3, 6, 2, 4, 7)
    q, k, v = x.reshape(3, windows, heads, tokens, head_dim)
    # A slice of the table for each query, its keys in turn from the last to the first.
    pairs = bias.unfold(2, mr, 1).unfold(3, ma, 1).flip(4, 5)[:, None, None]
    apart = _apart((rings, sectors), window, shift, periodic, bias.device)
    if apart is not None:
        pairs = torch.where(apart, -math.inf, pairs)
    mask = pairs.expand(batch, nr, na, *pairs.shape[3:]).reshape(windows, heads, tokens, tokens)
    out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask, scale=scale)
    out = out.reshape(batch, nr, na, heads, mr, ma, head_dim).permute(0, 1, 4, 2, 5, 3, 6)
    out = _rolled(out.reshape(batch, rings, sectors, heads * head_dim), shift)
    return out.to(qkv.dtype)


def _rolled(x: Tensor, shift: tuple[int, int]) -> Tensor:
    """(B, R, A, ...) rolled along the axes that are shifted."""
    axes = [axis for axis in (0, 1) if shift[axis]]
    return x.roll([shift[axis] for axis in axes], [1 + axis for axis in axes]) if axes else x


def _apart(
    size: tuple[int, int],
    window: tuple[int, int],
    shift: tuple[int, int],
    periodic: tuple[bool, bool],
    device: torch.device,
) -> Tensor | None:
    """Which tokens of a window the border parts, (n_r, n_a, heads, M_r, M_φ, M_r, M_φ), each size
    the whole or 1. None where it parts none."""
    apart = None
    for axis in (0, 1):
        if periodic[axis] or not shift[axis]:
            continue
        beyond = torch.arange(size[axis], device=device) >= size[axis] - shift[axis]
        side = beyond.view(-1, window[axis])
        shape = [1] * 7
        shape[axis], shape[3 + axis], shape[5 + axis] = len(side), window[axis], window[axis]
        along = (side[:, :, None] != side[:, None]).view(shape)
        apart = along if apart is None else apart | along
    return apart
