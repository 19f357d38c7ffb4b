"""window_attention on CUDA devices: forward and backward.

Each program handles one head in several windows of one image, one window after the other. The pairs
of a window's tokens are a square matrix in registers. Tokens and head dim are padded to powers of
two of at least 16, the sizes that tensor cores multiply. The padding is neither read nor written.

A seam may divide a window. Then a NaN or an infinity among the values or the gradients of one side
reaches the other side, since 0 times NaN is NaN. A NaN among queries and keys does not.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

# This many programs fill a large GPU. With more windows, each program handles several.
PROGRAMS = 8192
_ENTRIES = 64  # entries of the table per program


class _Map(NamedTuple):
    """Values that all programs of a launch share."""

    rings: int
    sectors: int
    shift_r: int
    shift_a: int
    # The first ring and sector of the rolled map that came from the other end. For a periodic axis,
    # the size of the axis.
    seam_r: int
    seam_a: int
    heads: int
    tables: int  # 1, or one per image
    chunks: int  # chunks of windows in an image, each for one program
    chunk: int  # windows in a chunk


@triton.jit
def _share(of, M_R: tl.constexpr, M_A: tl.constexpr):
    """The program's head, image, first window, end of its windows, and offset of its bias table."""
    # Neighbouring programs handle the heads of one window, which are neighbours in memory.
    program = tl.program_id(0)
    head, image = program % of.heads, program // of.heads // of.chunks
    first = program // of.heads % of.chunks * of.chunk
    last = min(first + of.chunk, (of.rings // M_R) * (of.sectors // M_A))
    table = (image % of.tables * of.heads + head) * ((2 * M_R - 1) * (2 * M_A - 1))
    return head, image.to(tl.int64), first, last, table


@triton.jit
def _pairs(M_R: tl.constexpr, M_A: tl.constexpr, TOKENS: tl.constexpr):
    """The table entry of each pair (query, key) of a window, and whether the pair exists."""
    token = tl.arange(0, TOKENS)
    r, a, there = token // M_A, token % M_A, token < M_R * M_A
    along, across = r[:, None] - r[None, :] + M_R - 1, a[:, None] - a[None, :] + M_A - 1
    return along * (2 * M_A - 1) + across, there[:, None] & there[None, :]


@triton.jit
def _places(image, window, of, M_R: tl.constexpr, M_A: tl.constexpr, TOKENS: tl.constexpr):
    """The index in the map of each token of a window, and the token's side of the seams."""
    token, across = tl.arange(0, TOKENS), of.sectors // M_A
    r, a = window // across * M_R + token // M_A, window % across * M_A + token % M_A
    side = (r >= of.seam_r).to(tl.int32) * 2 + (a >= of.seam_a).to(tl.int32)
    r, a = (r + of.shift_r) % of.rings, (a + of.shift_a) % of.sectors
    return (image * of.rings + r) * of.sectors + a, side


@triton.jit
def _probabilities(q, k, scale, bias, seen, EXACT: tl.constexpr):
    """softmax(q·k·scale + bias) over the keys that a query sees, 0 elsewhere."""
    logits = tl.dot(q, tl.trans(k), input_precision=EXACT) * scale + bias
    logits = tl.where(seen, logits, -float("inf"))
    powers = tl.where(seen, tl.exp(logits - tl.max(logits, 1)[:, None]), 0.0)
    total = tl.sum(powers, 1)
    # Only a query in the padding has a total of 0.
    return powers / tl.where(total == 0, 1.0, total)[:, None]


@triton.jit
def _forward(
    qkv, bias, out, scale, of,
    M_R: tl.constexpr, M_A: tl.constexpr, TOKENS: tl.constexpr, DIM: tl.constexpr,
    DIMS: tl.constexpr, EXACT: tl.constexpr, SPLIT: tl.constexpr,
):  # fmt: skip
    head, image, first, last, table = _share(of, M_R, M_A)
    entry, pair = _pairs(M_R, M_A, TOKENS)
    apart = tl.load(bias + table + entry, mask=pair, other=0.0)
    dim, row = tl.arange(0, DIMS), of.heads * DIM
    there = (tl.arange(0, TOKENS) < M_R * M_A)[:, None] & (dim < DIM)[None, :]
    column = (head * DIM + dim)[None, :]
    for window in range(first, last):
        place, side = _places(image, window, of, M_R, M_A, TOKENS)
        at = qkv + place[:, None] * (3 * row) + column
        q = tl.load(at, mask=there, other=0.0).to(tl.float32)
        k = tl.load(at + row, mask=there, other=0.0).to(tl.float32)
        v = tl.load(at + 2 * row, mask=there, other=0.0).to(tl.float32)
        seen = pair & (side[:, None] == side[None, :])
        p = _probabilities(q, k, scale, apart, seen, EXACT)
        result = tl.dot(p, v, input_precision=SPLIT)
        to = out + place[:, None] * row + column
        tl.store(to, result.to(out.dtype.element_ty), mask=there)


@triton.jit
def _backward(
    qkv, bias, grad_out, grad_qkv, grad_pairs, scale, of,
    M_R: tl.constexpr, M_A: tl.constexpr, TOKENS: tl.constexpr, DIM: tl.constexpr,
    DIMS: tl.constexpr, EXACT: tl.constexpr, SPLIT: tl.constexpr,
):  # fmt: skip
    head, image, first, last, table = _share(of, M_R, M_A)
    entry, pair = _pairs(M_R, M_A, TOKENS)
    apart = tl.load(bias + table + entry, mask=pair, other=0.0)
    token, dim, row = tl.arange(0, TOKENS), tl.arange(0, DIMS), of.heads * DIM
    there = (token < M_R * M_A)[:, None] & (dim < DIM)[None, :]
    column = (head * DIM + dim)[None, :]
    total = tl.zeros((TOKENS, TOKENS), tl.float32)
    for window in range(first, last):
        place, side = _places(image, window, of, M_R, M_A, TOKENS)
        at = place[:, None] * (3 * row) + column
        q = tl.load(qkv + at, mask=there, other=0.0).to(tl.float32)
        k = tl.load(qkv + at + row, mask=there, other=0.0).to(tl.float32)
        v = tl.load(qkv + at + 2 * row, mask=there, other=0.0).to(tl.float32)
        upper = grad_out + place[:, None] * row + column
        grad = tl.load(upper, mask=there, other=0.0).to(tl.float32)
        seen = pair & (side[:, None] == side[None, :])
        p = _probabilities(q, k, scale, apart, seen, EXACT)
        grad_p = tl.dot(grad, tl.trans(v), input_precision=EXACT)
        mean = tl.sum(tl.where(seen, p * grad_p, 0.0), 1)
        grad_logits = tl.where(seen, p * (grad_p - mean[:, None]), 0.0)
        grad_v = tl.dot(tl.trans(p), grad, input_precision=SPLIT)
        tl.store(grad_qkv + at + 2 * row, grad_v.to(grad_qkv.dtype.element_ty), mask=there)
        total += grad_logits
        if SPLIT != "ieee":  # read again, because there are too few registers to keep it
            q = tl.load(qkv + at, mask=there, other=0.0).to(tl.float32)
        grad_k = tl.dot(tl.trans(grad_logits), q, input_precision=SPLIT) * scale
        tl.store(grad_qkv + at + row, grad_k.to(grad_qkv.dtype.element_ty), mask=there)
        if SPLIT != "ieee":
            k = tl.load(qkv + at + row, mask=there, other=0.0).to(tl.float32)
        grad_q = tl.dot(grad_logits, k, input_precision=SPLIT) * scale
        tl.store(grad_qkv + at, grad_q.to(grad_qkv.dtype.element_ty), mask=there)
    COUNT: tl.constexpr = M_R * M_A
    square = (image * of.chunks + first // of.chunk) * of.heads + head
    to = grad_pairs + square * (COUNT * COUNT) + token[:, None] * COUNT + token[None, :]
    tl.store(to, total, mask=pair)


@triton.jit
def _fold(grad_pairs, grad_bias, M_R: tl.constexpr, M_A: tl.constexpr, ENTRIES: tl.constexpr):
    """Adds up the gradients of the pairs that share a table entry, query by query."""
    WIDTH: tl.constexpr = 2 * M_A - 1
    SIZE: tl.constexpr = (2 * M_R - 1) * WIDTH
    COUNT: tl.constexpr = M_R * M_A
    table = tl.program_id(0).to(tl.int64)
    entry = tl.program_id(1) * ENTRIES + tl.arange(0, ENTRIES)
    along, across = entry // WIDTH - (M_R - 1), entry % WIDTH - (M_A - 1)
    total = tl.zeros((ENTRIES,), tl.float32)
    for query in range(COUNT):
        r, a = query // M_A - along, query % M_A - across
        inside = (entry < SIZE) & (r >= 0) & (r < M_R) & (a >= 0) & (a < M_A)
        at = grad_pairs + (table * COUNT + query) * COUNT + r * M_A + a
        total += tl.load(at, mask=inside, other=0.0)
    tl.store(grad_bias + table * SIZE + entry, total, mask=entry < SIZE)


Pair = Sequence[int]


def _map(qkv: Tensor, bias: Tensor, window: Pair, shift: Pair, periodic: Pair) -> _Map:
    batch, rings, sectors, _, heads, _ = qkv.shape
    windows = (rings // window[0]) * (sectors // window[1])
    chunk = min(max(batch * heads * windows // PROGRAMS, 1), windows)
    return _Map(
        rings=rings, sectors=sectors, shift_r=shift[0], shift_a=shift[1],
        seam_r=rings if periodic[0] else rings - shift[0],
        seam_a=sectors if periodic[1] else sectors - shift[1],
        heads=heads, tables=len(bias), chunks=triton.cdiv(windows, chunk), chunk=chunk,
    )  # fmt: skip


def _constants(qkv: Tensor, window: Pair) -> dict[str, Any]:
    """The constants that a kernel is compiled for."""
    tokens, head_dim = window[0] * window[1], qkv.shape[5]
    # Tensor cores multiply 16-bit inputs exactly. They multiply float32 probabilities in two parts
    # of 8 bits, accurate to 2⁻¹⁶. Products of float32 inputs run on the other cores.
    exact, split = ("ieee", "ieee") if qkv.dtype == torch.float32 else ("tf32", "bf16x3")
    # A warp has the registers for 16 tokens.
    warps = 1 if tokens <= 16 else 4 if split == "bf16x3" else 8
    return dict(
        M_R=window[0], M_A=window[1], TOKENS=max(16, triton.next_power_of_2(tokens)),
        DIM=head_dim, DIMS=max(16, triton.next_power_of_2(head_dim)), EXACT=exact, SPLIT=split,
        num_warps=warps, num_stages=1, enable_fp_fusion=True,
    )  # fmt: skip


def window_attention(
    qkv: Tensor, bias: Tensor, window: Pair, shift: Pair, periodic: Pair, scale: float
) -> Tensor:
    """`darswin::window_attention`."""
    qkv, bias = qkv.contiguous(), bias.contiguous()
    out = qkv.new_empty((*qkv.shape[:3], qkv.shape[4] * qkv.shape[5]))
    if out.numel() > 0:
        of = _map(qkv, bias, window, shift, periodic)
        programs = len(qkv) * of.chunks * of.heads
        _forward[programs,](qkv, bias, out, scale, of, **_constants(qkv, window))
    return out


def window_attention_backward(
    qkv: Tensor, bias: Tensor, window: Pair, shift: Pair, periodic: Pair, scale: float,
    grad_out: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """`darswin::window_attention_backward`: gradients of qkv and bias. Each sum has a fixed order:
    a program adds the pairs of its windows, torch adds over programs, and `_fold` adds the pairs of
    each table entry."""
    qkv, bias, grad_out = qkv.contiguous(), bias.contiguous(), grad_out.contiguous()
    grad_qkv, grad_bias = torch.empty_like(qkv), torch.empty_like(bias)
    if qkv.numel() == 0:
        return grad_qkv, grad_bias.zero_()
    of, tokens = _map(qkv, bias, window, shift, periodic), window[0] * window[1]
    grad_pairs = bias.new_empty((len(qkv), of.chunks, of.heads, tokens, tokens))
    _backward[grad_pairs[..., 0, 0].numel(),](
        qkv, bias, grad_out, grad_qkv, grad_pairs, scale, of, **_constants(qkv, window)
    )
    grad_pairs = grad_pairs.sum(1 if of.tables > 1 else (0, 1))
    entries = triton.cdiv(grad_bias[0, 0].numel(), _ENTRIES)
    _fold[of.tables * of.heads, entries](
        grad_pairs, grad_bias, *window, _ENTRIES, num_warps=_ENTRIES // 32, enable_fp_fusion=True
    )
    return grad_qkv, grad_bias
