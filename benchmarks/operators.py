"""Both operators, forward and forward+backward, against what a user would write without them.

`make bench`, or `python benchmarks/operators.py [--quick]`. Writes benchmarks/results/*.json and a
plot beside it, and prints the tables of the README.
"""

import argparse
import math

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
from common import OURS, Result, compare, machine, save, table
from torch import Tensor
from tqdm import tqdm

from darswin import polar_grid
from darswin.lens import Spherical
from darswin.ops import polar_sample, reference, use_reference, window_attention

THREADS = sorted({1, torch.get_num_threads()})


def sampling_case(size: int, batch: int):
    """Images, lenses' grid, and the mesh that grid_sample and remap read."""
    images = torch.randn(batch, 3, size, size)
    lens = Spherical.from_fov(torch.linspace(0.1, 0.9, batch), math.radians(170), size / 2)
    grid = polar_grid(lens, (size, size), rings=16, sectors=64, samples=(10, 10))
    x = grid.center[:, 0, None, None] + grid.radii[:, :, None] * torch.cos(grid.azimuths)
    y = grid.center[:, 1, None, None] + grid.radii[:, :, None] * torch.sin(grid.azimuths)
    mesh = 2 * torch.stack((x, y), -1) / (size - 1) - 1
    return images, grid, mesh, (x, y)


def to_tokens(planes: Tensor) -> Tensor:
    """(B, 3, 160, 640) → (B, 16, 64, 300), as the embedding wants them."""
    batch = planes.shape[0]
    patches = planes.reshape(batch, 3, 16, 10, 64, 10).permute(0, 2, 4, 3, 5, 1)
    return patches.reshape(batch, 16, 64, 300)


def forward_backward(run, inputs: list[Tensor]):
    """A function that runs, and backpropagates a fixed gradient; returns output and gradients."""
    leaves = [t.detach().requires_grad_() for t in inputs]
    with torch.no_grad():
        shape = run(*leaves).shape
    grad = torch.randn(shape, generator=torch.Generator().manual_seed(0))  # for all the same

    def step() -> list[Tensor]:
        out = run(*leaves)
        return [out.detach(), *torch.autograd.grad(out, leaves, grad)]

    return step


def forward(run, inputs: list[Tensor]):
    def step() -> list[Tensor]:
        with torch.no_grad():
            return [run(*inputs)]

    return step


def sampling(size: int, batch: int, threads: int, seconds: float) -> list[Result]:
    images, grid, mesh, (x, y) = sampling_case(size, batch)
    arguments = (grid.radii, grid.azimuths, grid.center)

    def ours(image):
        return polar_sample(image, *arguments, patch=(10, 10))

    def grid_sample(image):
        return to_tokens(F.grid_sample(image, mesh, align_corners=True))

    maps = [(a.numpy(), b.numpy()) for a, b in zip(x, y, strict=True)]
    frames = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in images]

    def remap() -> list[Tensor]:
        cv2.setNumThreads(threads)
        pairs = zip(frames, maps, strict=True)
        planes = np.stack([cv2.remap(frame, *xy, cv2.INTER_LINEAR) for frame, xy in pairs])
        return [to_tokens(torch.from_numpy(planes).permute(0, 3, 1, 2))]

    case = f"{size}×{size}, batch {batch}"
    results = compare(
        "polar_sample", case,
        {
            OURS: forward(ours, [images]),
            "F.grid_sample + permute": forward(grid_sample, [images]),
        },
        mode="forward", threads=threads, min_run_time=seconds,
    )  # fmt: skip
    # cv2.remap rounds coordinates to 1/32 px, so it is checked by itself, to that.
    results += compare(
        "polar_sample", case,
        {OURS: forward(ours, [images]), "cv2.remap + permute": remap},
        mode="forward", threads=threads, tolerance=0.05, min_run_time=seconds,
    )[1:]  # fmt: skip
    results += compare(
        "polar_sample", case,
        {
            OURS: forward_backward(ours, [images]),
            "F.grid_sample + permute": forward_backward(grid_sample, [images]),
        },
        mode="forward+backward", threads=threads, min_run_time=seconds,
    )  # fmt: skip
    return results


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


def plot(results: list[Result], path) -> None:
    """Peers' times over ours, a panel an operator, at one thread."""
    figure, panels = plt.subplots(1, 2, figsize=(13, 5))
    for axes, operator in zip(panels, ("polar_sample", "window_attention"), strict=True):
        rows = [r for r in results if r.operator == operator and r.threads == 1]
        names = [n for n in dict.fromkeys(r.name for r in rows) if n != OURS]
        keys = list(dict.fromkeys((r.case, r.mode) for r in rows))
        for index, name in enumerate(names):
            points = {(r.case, r.mode): r.ratio for r in rows if r.name == name}
            places = [k for k, key in enumerate(keys) if key in points]
            axes.barh([p + 0.8 * index / len(names) for p in places],
                      [points[keys[p]] for p in places], 0.8 / len(names), label=name)  # fmt: skip
        axes.axvline(1, color="black", lw=1)
        axes.set_yticks([k + 0.3 for k in range(len(keys))], [f"{c}, {m}" for c, m in keys])
        axes.tick_params(axis="y", labelsize=7)
        axes.invert_yaxis()
        axes.set_xlabel("time of the peer / time of darswin, 1 thread")
        axes.set_title(operator)
        axes.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two small cases, short runs")
    args = parser.parse_args()
    torch.manual_seed(0)
    sizes = [(64, 8)] if args.quick else [(64, 8), (256, 8), (1024, 4)]
    cases = ["A stage 3"] if args.quick else list(ATTENTION)
    batches = [8] if args.quick else [8, 32]
    seconds = 0.05 if args.quick else 0.5
    print(" ".join(f"{k}={v}" for k, v in machine().items()))
    results: list[Result] = []
    jobs = [(sampling, size, batch) for size, batch in sizes]
    jobs += [(attention, case, batch) for case in cases for batch in batches]
    for run, what, batch in tqdm(jobs, unit="case"):
        for threads in THREADS:
            results += run(what, batch, threads, seconds)
    print(table(results))
    if not args.quick:
        path = save(results, "operators")
        plot(results, path.with_suffix(".png"))
        print(path.relative_to(path.parents[2]))


if __name__ == "__main__":
    main()
