"""window_attention, forward and forward+backward, against what a user would write without it.

`make bench`, or `python benchmarks/attention.py [--quick]`. Writes benchmarks/results/*.json and a
plot beside it, and prints the tables of the README and each ratio against its bar.
"""

import argparse
import math

import torch
import torch.nn.functional as F
from common import OURS, THREADS, Result, compare, finish, forward, forward_backward, machine
from tqdm import tqdm

from darswin.ops import reference, use_reference, window_attention

ATTENTION = {
    # (R, A, heads), window, shift
    "A stage 1": ((16, 64, 3), (1, 16), (0, 4)),
    "A stage 2": ((16, 16, 6), (1, 16), (0, 0)),
    "A stage 3": ((16, 4, 12), (4, 4), (2, 0)),
    "A stage 4": ((16, 1, 24), (16, 1), (0, 0)),
    "RA stage 1": ((16, 64, 3), (4, 4), (2, 2)),
}


def attention(case: str, batch: int, threads: int, seconds: float) -> list[Result]:
    (rings, sectors, heads), window, shift = ATTENTION[case]
    qkv = torch.randn(batch, rings, sectors, 3, heads, 32)
    bias = torch.randn(1, heads, 2 * window[0] - 1, 2 * window[1] - 1)
    options = dict(window=window, shift=shift)
    mr, ma, nr, na = *window, rings // window[0], sectors // window[1]
    visible = reference.visible_pairs(rings, sectors, window, shift, (False, True), qkv.device)
    hidden = torch.zeros(visible.shape).masked_fill(~visible, -math.inf)[:, :, None]

    def ours(qkv, bias):
        return window_attention(qkv, bias, **options)

    def eager(qkv, bias):
        with use_reference():
            return window_attention(qkv, bias, **options)

    def sdpa(qkv, bias):
        x = qkv.roll((-shift[0], -shift[1]), (1, 2)).reshape(batch, nr, mr, na, ma, 3, heads, 32)
        q, k, v = x.permute(5, 0, 1, 3, 6, 2, 4, 7).flatten(5, 6)
        mask = reference.pairwise_bias(bias, window)[:, None, None] + hidden
        mask = mask.expand(batch, -1, -1, -1, -1, -1).flatten(0, 2)
        q, k, v = (t.flatten(0, 2) for t in (q, k, v))
        out = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        out = out.reshape(batch, nr, na, heads, mr, ma, 32).permute(0, 1, 4, 2, 5, 3, 6)
        return out.reshape(batch, rings, sectors, heads * 32).roll(shift, (1, 2))

    results = []
    for mode, wrap in (("forward", forward), ("forward+backward", forward_backward)):
        torch._dynamo.reset()
        peers = {OURS: ours, "eager": eager, "F.sdpa": sdpa}
        if mode == "forward":
            peers["compiled F.sdpa"] = torch.compile(sdpa, dynamic=False)
        candidates = {name: wrap(run, [qkv, bias]) for name, run in peers.items()}
        results += compare(
            "window_attention", f"{case}, batch {batch}", candidates,
            mode=mode, threads=threads, min_run_time=seconds,
        )  # fmt: skip
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    args = parser.parse_args()
    torch.manual_seed(0)
    cases = ["A stage 3"] if args.quick else list(ATTENTION)
    batches = [8] if args.quick else [8, 32]
    seconds = 0.05 if args.quick else 0.5
    print(" ".join(f"{k}={v}" for k, v in machine().items()))
    results: list[Result] = []
    for case, batch in tqdm([(c, b) for c in cases for b in batches], unit="case"):
        for threads in THREADS:
            results += attention(case, batch, threads, seconds)
    finish(results, "attention", avx2_share=0.65, keep=not args.quick)


if __name__ == "__main__":
    main()
