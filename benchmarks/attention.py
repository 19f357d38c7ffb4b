"""window_attention, forward and forward+backward, compared with code that users write without it.

`make bench`, or `python benchmarks/attention.py [--quick] [--only "A stage 1"] [--out FOLDER]`.
Prints tables, the ratios with their targets, and our rates with the peaks of the machine. With a
folder, it writes a record and a plot there.
"""

import argparse
import math
from functools import partial
from pathlib import Path

import peaks
import torch
import torch.nn.functional as F
from kit.timing import OURS, Case, Timing
from peers import compare, run_suite
from torch import Tensor

from darswin.ops import reference, window_attention

HEAD_DIM = 32
# (R, A, heads), window, shift of the odd blocks, periodic
ATTENTION = {
    "A stage 1": ((16, 64, 3), (1, 16), (0, 4), (False, True)),
    "A stage 2": ((16, 16, 6), (1, 16), (0, 0), (False, True)),
    "A stage 3": ((16, 4, 12), (4, 4), (2, 0), (False, True)),
    "A stage 4": ((16, 1, 24), (16, 1), (0, 0), (False, True)),
    "RA stage 1": ((16, 64, 3), (4, 4), (2, 2), (False, True)),
    "RA stage 2": ((8, 32, 6), (4, 4), (2, 2), (False, True)),
    "RA stage 3": ((4, 16, 12), (4, 4), (0, 2), (False, True)),
    "RA stage 4": ((2, 8, 24), (2, 8), (0, 0), (False, True)),
    "32x128, windows of 64": ((32, 128, 3), (1, 64), (0, 32), (False, True)),
    "Swin 4x4": ((32, 32, 3), (4, 4), (2, 2), (False, False)),
    "Swin 8x8": ((32, 32, 3), (8, 8), (4, 4), (False, False)),
}


def targets(
    mode: str, dtype: torch.dtype, batch: int, megabytes: float
) -> tuple[float, float | None]:
    """The smallest ratios of the best peer's time over ours, and of eager attention's."""
    if dtype == torch.bfloat16:
        return 3.0, None
    if mode == "forward":
        return (3.0 if batch == 32 or megabytes < 1 else 4.0), None
    return (2.5 if megabytes < 1 else 3.0), 4.0


class Peers:
    """Attention in windows as users write it: roll, partition, attend, reverse, roll back.

    As in Swin, the bias of all pairs is indexed from the table. With `slices` it is made of slices,
    because a report says that inductor miscompiles the gradient of the index (pytorch#191837).
    """

    def __init__(self, case: str, batch: int, slices: bool):
        self.pairs = pairs_by_slices if slices else reference.pairwise_bias
        (rings, sectors, heads), window, self.shift, periodic = ATTENTION[case]
        (mr, ma), (nr, na) = window, (rings // window[0], sectors // window[1])
        self.window, self.rolls = window, any(self.shift)
        self.parts = (batch, nr, mr, na, ma, 3, heads, HEAD_DIM)
        visible = reference.visible_pairs(rings, sectors, window, self.shift, periodic, "cpu")
        hidden = torch.zeros(visible.shape).masked_fill(~visible, -math.inf)[:, :, None]
        self.hidden = None if visible.all() else hidden

    def partition(self, qkv: Tensor) -> Tensor:
        """(3, B, n_r, n_a, heads, N, d)"""
        if self.rolls:
            qkv = qkv.roll((-self.shift[0], -self.shift[1]), (1, 2))
        return qkv.reshape(self.parts).permute(5, 0, 1, 3, 6, 2, 4, 7).flatten(5, 6)

    def reverse(self, out: Tensor) -> Tensor:
        batch, nr, mr, na, ma, _, heads, dim = self.parts
        out = out.reshape(batch, nr, na, heads, mr, ma, dim).permute(0, 1, 4, 2, 5, 3, 6)
        out = out.reshape(batch, nr * mr, na * ma, heads * dim)
        return out.roll(self.shift, (1, 2)) if self.rolls else out

    def mask(self, bias: Tensor, dtype: torch.dtype) -> Tensor:
        """The bias of all pairs, minus infinity for hidden pairs; n_r and n_a are 1 if all windows
        share it."""
        pairs = self.pairs(bias, self.window)[:, None, None]
        return (pairs if self.hidden is None else pairs + self.hidden).to(dtype)

    def eager(self, qkv: Tensor, bias: Tensor) -> Tensor:
        q, k, v = self.partition(qkv)
        logits = (q * HEAD_DIM**-0.5) @ k.transpose(-1, -2) + self.mask(bias, qkv.dtype)
        return self.reverse(logits.softmax(-1) @ v)

    def sdpa(self, qkv: Tensor, bias: Tensor) -> Tensor:
        batch, nr, _, na, *_ = self.parts
        q, k, v = (t.flatten(0, 2) for t in self.partition(qkv))
        mask = self.mask(bias, qkv.dtype).expand(batch, nr, na, -1, -1, -1).flatten(0, 2)
        return self.reverse(F.scaled_dot_product_attention(q, k, v, attn_mask=mask))


def pairs_by_slices(bias: Tensor, window: tuple[int, int]) -> Tensor:
    """`reference.pairwise_bias` without an index: (B or 1, heads, N, N)."""
    mr, ma = window
    table = bias.flip(2, 3)
    table = torch.stack([table[..., ma - 1 - a : 2 * ma - 1 - a] for a in range(ma)], 3)
    table = torch.stack([table[:, :, mr - 1 - r : 2 * mr - 1 - r] for r in range(mr)], 2)
    return table.transpose(3, 4).reshape(*bias.shape[:2], mr * ma, mr * ma)


def attention(name: str, batch: int, mode: str, dtype: torch.dtype, seconds: float) -> list[Timing]:
    (rings, sectors, heads), window, shift, periodic = ATTENTION[name]
    qkv = torch.randn(batch, rings, sectors, 3, heads, HEAD_DIM).to(dtype)
    bias = torch.randn(1, heads, 2 * window[0] - 1, 2 * window[1] - 1)
    peers = Peers(name, batch, slices=False)
    to_compile = Peers(name, batch, slices=mode != "forward")

    def ours(qkv: Tensor, bias: Tensor) -> Tensor:
        return window_attention(qkv, bias, window=window, shift=shift, periodic=periodic)

    torch._dynamo.reset()
    runs = {OURS: ours, "eager": peers.eager, "F.sdpa": peers.sdpa}
    for peer, run in (("eager", to_compile.eager), ("F.sdpa", to_compile.sdpa)):
        runs[f"compiled {peer}"] = torch.compile(run, dynamic=False)
    half = dtype == torch.bfloat16
    subject = "window_attention, bfloat16" if half else "window_attention"
    timings = compare(
        Case(subject, name, batch, torch.get_num_threads(), mode),
        runs,
        [qkv, bias],
        seconds,
        tolerance=5e-2 if half else 1e-4,  # the peers round to bfloat16 at each step
    )
    best_target, eager_target = targets(mode, dtype, batch, 4 * qkv.numel() / 3 / 2**20)
    next(t for t in timings if t.name == "eager").target = eager_target
    best = min((t for t in timings if not t.name.startswith(OURS)), key=lambda t: t.median)
    best.target = max(best_target, best.target or 0)
    return timings


def rates(timings: list[Timing]) -> str:
    """Our operations and memory traffic per second, compared with the peaks of the machine."""
    limits = {threads: peaks.measure(threads) for threads in sorted({t.threads for t in timings})}
    lines = [str(limit) for limit in limits.values()]
    for t in timings:
        if t.name != OURS:
            continue
        (rings, sectors, heads), window, *_ = ATTENTION[t.setting]
        numbers = t.batch * rings * sectors * heads * HEAD_DIM
        # Two products forward and five backward. Forward reads qkv and writes a map; backward reads
        # qkv, the map and its gradient, and writes the gradient of qkv.
        products, maps = (2, 4) if t.mode == "forward" else (7, 11)
        gflops = 2e-9 * products * numbers * window[0] * window[1] / t.median
        gbytes = 1e-9 * maps * numbers * (2 if "bfloat16" in t.subject else 4) / t.median
        limit = limits[t.threads]
        lines.append(
            f"{t.label}: {gflops:.0f} GFLOP/s ({gflops / limit.gflops:.0%} of the peak), "
            f"{gbytes:.1f} GB/s ({gbytes / limit.memory_gbytes:.0%} of a copy in memory)"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    parser.add_argument("--only", action="append", choices=ATTENTION, help="this case; repeatable")
    parser.add_argument("--seconds", type=float, help="of each timing")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    torch.manual_seed(0)
    names = args.only or (["A stage 3"] if args.quick else list(ATTENTION))
    batches = [8] if args.quick else [8, 32]
    seconds = args.seconds or (0.05 if args.quick else 0.5)
    kinds = [
        ("forward", torch.float32),
        ("forward+backward", torch.float32),
        ("forward+backward", torch.bfloat16),
    ]
    jobs = [
        partial(attention, name, batch, *kind, seconds)
        for name in names for batch in batches for kind in kinds
    ]  # fmt: skip
    timings = run_suite("attention", jobs, avx2_share=0.65, out=args.out)
    print(rates(timings))


if __name__ == "__main__":
    main()
