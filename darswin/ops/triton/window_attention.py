"""window_attention on CUDA devices: forward and backward.

A program attends in some windows of one image, one after the other, for one head. It reads queries,
keys and values where they lie: the shift and the wrap are in the places. The pairs of a window's
tokens are a square that stays in registers, probabilities and bias too; backward computes the
probabilities again. Tokens and head dim are filled up to powers of two, at least 16, which is what
tensor cores multiply; what is filled in is neither read nor written.

The gradient of the bias is a sum over all windows. Each program adds up the pairs of its own
windows in turn and writes them, torch adds up the programs', and a second kernel gathers the pairs
of each entry of the table. So every sum has its order, and two runs give the same bits.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

# A program gets several windows where there are more than this many, which fill a large GPU.
PROGRAMS = 8192
_ENTRIES = 64  # of the table, a program


@triton.jit
def _pairs(M_R: tl.constexpr, M_A: tl.constexpr, TOKENS: tl.constexpr):
    """Of each pair (query, key) of a window's tokens: its entry of the table, and whether both are
    there."""
    token = tl.arange(0, TOKENS)
    r, a, there = token // M_A, token % M_A, token < M_R * M_A
    along, across = r[:, None] - r[None, :] + M_R - 1, a[:, None] - a[None, :] + M_A - 1
    return along * (2 * M_A - 1) + across, there[:, None] & there[None, :]


@triton.jit
def _places(image, window, rings, sectors, shift_r, shift_a, seam_r, seam_a,
            M_R: tl.constexpr, M_A: tl.constexpr, TOKENS: tl.constexpr):  # fmt: skip
    """Of each token of a window: its place among all, and its side of the seams that the roll has
    brought into the window."""
    token, across = tl.arange(0, TOKENS), sectors // M_A
    r, a = window // across * M_R + token // M_A, window % across * M_A + token % M_A
    side = (r >= seam_r).to(tl.int32) * 2 + (a >= seam_a).to(tl.int32)
    place = (r + shift_r) % rings * sectors + (a + shift_a) % sectors
    return image.to(tl.int64) * rings * sectors + place, side


@triton.jit
def _probabilities(q, k, scale, bias, seen, EXACT: tl.constexpr):
    """softmax(q·k·scale + bias) over the keys that a query sees, 0 elsewhere."""
    logits = tl.dot(q, tl.trans(k), input_precision=EXACT) * scale + bias
    logits = tl.where(seen, logits, -float("inf"))
    powers = tl.where(seen, tl.exp(logits - tl.max(logits, 1)[:, None]), 0.0)
    total = tl.sum(powers, 1)
    # Only a query that is not there sees nothing.
    return powers / tl.where(total == 0, 1.0, total)[:, None]


@triton.jit
def _forward(qkv, bias, out, scale, rings, sectors, shift_r, shift_a, seam_r, seam_a, heads,
             bias_images, chunks, chunk, M_R: tl.constexpr, M_A: tl.constexpr, DIM: tl.constexpr,
             TOKENS: tl.constexpr, DIMS: tl.constexpr, EXACT: tl.constexpr, PARTS: tl.constexpr):  # fmt: skip
    # Neighbouring programs take a window's heads, which lie beside each other.
    program = tl.program_id(0)
    head, image = program % heads, program // heads // chunks
    first = program // heads % chunks * chunk
    entry, pair = _pairs(M_R, M_A, TOKENS)
    table = (image % bias_images * heads + head) * ((2 * M_R - 1) * (2 * M_A - 1))
    logit_bias = tl.load(bias + table + entry, mask=pair, other=0.0)
    token, dim = tl.arange(0, TOKENS), tl.arange(0, DIMS)
    there = (token < M_R * M_A)[:, None] & (dim < DIM)[None, :]
    last = min(first + chunk, rings // M_R * (sectors // M_A))
    for window in range(first, last):
        place, side = _places(image, window, rings, sectors, shift_r, shift_a, seam_r, seam_a,
                              M_R, M_A, TOKENS)  # fmt: skip
        row = heads * DIM
        at = qkv + place[:, None] * (3 * row) + (head * DIM + dim)[None, :]
        q = tl.load(at, mask=there, other=0.0).to(tl.float32)
        k = tl.load(at + row, mask=there, other=0.0).to(tl.float32)
        v = tl.load(at + 2 * row, mask=there, other=0.0).to(tl.float32)
        seen = pair & (side[:, None] == side[None, :])
        p = _probabilities(q, k, scale, logit_bias, seen, EXACT)
        result = tl.dot(p, v, input_precision=PARTS)
        to = out + place[:, None] * row + (head * DIM + dim)[None, :]
        tl.store(to, result.to(out.dtype.element_ty), mask=there)


@triton.jit
def _backward(qkv, bias, grad_out, grad_qkv, grad_pairs, scale, rings, sectors, shift_r, shift_a,
              seam_r, seam_a, heads, bias_images, chunks, chunk, M_R: tl.constexpr,
              M_A: tl.constexpr, DIM: tl.constexpr, TOKENS: tl.constexpr, DIMS: tl.constexpr,
              EXACT: tl.constexpr, PARTS: tl.constexpr):  # fmt: skip
    program = tl.program_id(0)
    head, image = program % heads, program // heads // chunks
    first = program // heads % chunks * chunk
    entry, pair = _pairs(M_R, M_A, TOKENS)
    table = (image % bias_images * heads + head) * ((2 * M_R - 1) * (2 * M_A - 1))
    logit_bias = tl.load(bias + table + entry, mask=pair, other=0.0)
    token, dim = tl.arange(0, TOKENS), tl.arange(0, DIMS)
    there = (token < M_R * M_A)[:, None] & (dim < DIM)[None, :]
    total = tl.zeros((TOKENS, TOKENS), tl.float32)
    last = min(first + chunk, rings // M_R * (sectors // M_A))
    for window in range(first, last):
        place, side = _places(image, window, rings, sectors, shift_r, shift_a, seam_r, seam_a,
                              M_R, M_A, TOKENS)  # fmt: skip
        row = heads * DIM
        offset = place[:, None] * (3 * row) + (head * DIM + dim)[None, :]
        q = tl.load(qkv + offset, mask=there, other=0.0).to(tl.float32)
        k = tl.load(qkv + offset + row, mask=there, other=0.0).to(tl.float32)
        v = tl.load(qkv + offset + 2 * row, mask=there, other=0.0).to(tl.float32)
        at = grad_out + place[:, None] * row + (head * DIM + dim)[None, :]
        grad = tl.load(at, mask=there, other=0.0).to(tl.float32)
        seen = pair & (side[:, None] == side[None, :])
        p = _probabilities(q, k, scale, logit_bias, seen, EXACT)
        to = grad_qkv + offset
        kind = grad_qkv.dtype.element_ty
        grad_v = tl.dot(tl.trans(p), grad, input_precision=PARTS)
        tl.store(to + 2 * row, grad_v.to(kind), mask=there)
        grad_p = tl.dot(grad, tl.trans(v), input_precision=EXACT)
        mean = tl.sum(tl.where(seen, p * grad_p, 0.0), 1)
        grad_logits = tl.where(seen, p * (grad_p - mean[:, None]), 0.0)
        total += grad_logits
        grad_q = tl.dot(grad_logits, k, input_precision=PARTS) * scale
        tl.store(to, grad_q.to(kind), mask=there)
        grad_k = tl.dot(tl.trans(grad_logits), q, input_precision=PARTS) * scale
        tl.store(to + row, grad_k.to(kind), mask=there)
    COUNT: tl.constexpr = M_R * M_A
    square = ((image * chunks + program // heads % chunks) * heads + head).to(tl.int64)
    spot = grad_pairs + square * (COUNT * COUNT) + token[:, None] * COUNT + token[None, :]
    tl.store(spot, total, mask=pair)


@triton.jit
def _fold(grad_pairs, grad_bias, M_R: tl.constexpr, M_A: tl.constexpr, ENTRIES: tl.constexpr):
    """Each entry of a table's gradient is the sum of its pairs', query by query."""
    WIDTH: tl.constexpr = 2 * M_A - 1
    SIZE: tl.constexpr = (2 * M_R - 1) * WIDTH
    COUNT: tl.constexpr = M_R * M_A
    table = tl.program_id(0)
    entry = tl.program_id(1) * ENTRIES + tl.arange(0, ENTRIES)
    along, across = entry // WIDTH - (M_R - 1), entry % WIDTH - (M_A - 1)
    total = tl.zeros((ENTRIES,), tl.float32)
    for query in range(COUNT):
        r, a = query // M_A - along, query % M_A - across
        inside = (r >= 0) & (r < M_R) & (a >= 0) & (a < M_A) & (entry < SIZE)
        at = grad_pairs + (table * COUNT + query) * COUNT + r * M_A + a
        total += tl.load(at, mask=inside, other=0.0)
    tl.store(grad_bias + table * SIZE + entry, total, mask=entry < SIZE)


class _Plan(NamedTuple):
    """How a call is launched: what the kernels share, in their order."""

    programs: int
    squares: tuple[int, int]  # of the gradient of the pairs: images, chunks of windows
    numbers: tuple[Any, ...]
    options: dict[str, Any]


def _plan(qkv: Tensor, bias: Tensor, window, shift, periodic, scale: float) -> _Plan:
    batch, rings, sectors, _, heads, head_dim = qkv.shape
    windows = rings // window[0] * (sectors // window[1])
    chunk = min(max(batch * heads * windows // PROGRAMS, 1), windows)
    chunks = triton.cdiv(windows, chunk)
    # Beyond a seam lie the tokens that the roll has brought from the other end.
    seams = [
        size if wraps else size - shifted
        for size, shifted, wraps in zip((rings, sectors), shift, periodic, strict=True)
    ]
    numbers = (scale, rings, sectors, *shift, *seams, heads, len(bias), chunks, chunk)
    tokens = window[0] * window[1]
    small = tokens <= 16
    half = qkv.dtype != torch.float32
    exact, parts = ("tf32", "tf32x3") if half else ("ieee", "ieee")
    options = dict(
        M_R=window[0], M_A=window[1], DIM=head_dim,
        TOKENS=max(16, triton.next_power_of_2(tokens)),
        DIMS=max(16, triton.next_power_of_2(head_dim)),
        EXACT=exact, PARTS=parts, num_warps=1 if small else 8, num_stages=1,
        enable_fp_fusion=True,
    )  # fmt: skip
    return _Plan(batch * chunks * heads, (batch, chunks), numbers, options)


def window_attention(
    qkv: Tensor,
    bias: Tensor,
    window: Sequence[int],
    shift: Sequence[int],
    periodic: Sequence[int],
    scale: float,
) -> Tensor:
    """See `darswin.ops.window_attention`."""
    qkv, bias = qkv.contiguous(), bias.contiguous()
    out = qkv.new_empty((*qkv.shape[:3], qkv.shape[4] * qkv.shape[5]))
    plan = _plan(qkv, bias, window, shift, periodic, scale)
    if plan.programs:
        with torch.cuda.device_of(qkv):
            _forward[plan.programs,](qkv, bias, out, *plan.numbers, **plan.options)
    return out


def window_attention_backward(
    qkv: Tensor,
    bias: Tensor,
    window: Sequence[int],
    shift: Sequence[int],
    periodic: Sequence[int],
    scale: float,
    grad_out: Tensor,
) -> tuple[Tensor, Tensor]:
    """The gradients of qkv and of the bias."""
    qkv, bias, grad_out = qkv.contiguous(), bias.contiguous(), grad_out.contiguous()
    plan = _plan(qkv, bias, window, shift, periodic, scale)
    if not plan.programs:
        return torch.empty_like(qkv), torch.zeros_like(bias)
    grad_qkv, grad_bias = torch.empty_like(qkv), torch.empty_like(bias)
    tokens = window[0] * window[1]
    pairs = bias.new_empty((*plan.squares, qkv.shape[4], tokens, tokens))
    with torch.cuda.device_of(qkv):
        _backward[plan.programs,](
            qkv, bias, grad_out, grad_qkv, pairs, *plan.numbers, **plan.options
        )
        pairs = pairs.sum((0, 1) if len(bias) == 1 else 1)
        entries = triton.cdiv(grad_bias[0, 0].numel(), _ENTRIES)
        _fold[len(bias) * qkv.shape[4], entries](
            pairs, grad_bias, window[0], window[1], _ENTRIES, num_warps=2
        )
    return grad_qkv, grad_bias
