"""polar_sample and polar_embed, forward and backward, against what one would write without them.

`make bench`, or `python benchmarks/sampling.py [--quick]`. Writes benchmarks/results/*.json and a
plot beside it, and prints the tables of the README and each ratio against its bar.
"""

import argparse
import math

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from common import OURS, Result, compare, finish, forward, forward_backward
from torch import Tensor
from tqdm import tqdm

from darswin import polar_grid
from darswin.bench.machine import THREADS, machine
from darswin.lens import Spherical
from darswin.ops import polar_embed, polar_sample


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


def samples(result: Tensor) -> Tensor:
    """Planes as tokens; other results as they are."""
    return to_tokens(result) if result.shape[-2:] == (160, 640) else result


def sampling(size: int, batch: int, threads: int, seconds: float) -> list[Result]:
    images, grid, mesh, (x, y) = sampling_case(size, batch)
    arguments = (grid.radii, grid.azimuths, grid.center)
    small = size <= 256

    def ours(image, **options):
        return polar_sample(image, *arguments, patch=(10, 10), **options)

    def planes(image):
        return F.grid_sample(image, mesh, align_corners=True)

    def tokens(image):
        return to_tokens(planes(image))

    def half(image):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return ours(image)

    maps = [(a.numpy(), b.numpy()) for a, b in zip(x, y, strict=True)]
    frames = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in images]

    def remap() -> list[Tensor]:
        cv2.setNumThreads(threads)
        pairs = zip(frames, maps, strict=True)
        return [torch.from_numpy(cv2.remap(frame, *xy, cv2.INTER_LINEAR)) for frame, xy in pairs]

    def remapped() -> list[Tensor]:
        return [to_tokens(torch.stack(remap()).permute(0, 3, 1, 2))]

    torch._dynamo.reset()
    compiled = torch.compile(tokens, dynamic=False)
    case, timing = f"{size}×{size}, batch {batch}", dict(threads=threads, min_run_time=seconds)
    # grid_sample's coordinates are float32: at 1000 px they are off by 1e-4 px.
    equal = dict(timing, tolerance=1e-4 if small else 1e-3)
    results = compare(
        "polar_sample", case,
        {
            OURS: forward(ours, [images]),
            "F.grid_sample": forward(planes, [images]),
            "F.grid_sample + permute": forward(tokens, [images]),
            "compiled F.grid_sample + permute": forward(compiled, [images]),
        },
        mode="forward", view=samples, **timing,
        bars={"F.grid_sample": 5.0 if small else 2.5} | (
            {"F.grid_sample + permute": 10.0} if small else {}),
    )  # fmt: skip
    # cv2.remap rounds coordinates to 1/32 px: checked to that, then timed without the permute.
    compare(
        "polar_sample", case, {OURS: forward(ours, [images]), "cv2.remap": remapped},
        mode="forward", tolerance=0.05, threads=threads, min_run_time=0.01,
    )  # fmt: skip
    results += compare(
        "polar_sample", case, {OURS: forward(ours, [images]), "cv2.remap": remap},
        mode="forward", tolerance=math.inf, view=lambda result: result.flatten()[:0], **timing,
        bars={"cv2.remap": 2.4 if small else 1.4},
    )[1:2]  # fmt: skip
    results += compare(
        "polar_sample", case,
        {
            # The README's drop-in call.
            OURS: forward(
                lambda image: polar_sample(image, *arguments, patch=(1, 1), layout="image"),
                [images],
            ),
            "F.grid_sample": forward(planes, [images]),
        },
        mode="forward, layout image", bars={"F.grid_sample": 1.0}, **equal,
    )  # fmt: skip
    results += compare(
        "polar_sample", case,
        {
            OURS: forward(lambda image: ours(image, jitter=1.0, seed=1), [images]),
            "darswin without jitter": forward(ours, [images]),
        },
        mode="forward, jitter", tolerance=math.inf, bars={"darswin without jitter": 1 / 1.6},
        **timing,
    )  # fmt: skip
    results += compare(
        "polar_sample", case,
        {
            OURS: forward(half, [images]),
            "F.grid_sample + permute": forward(lambda image: tokens(image).bfloat16(), [images]),
        },
        mode="forward, bfloat16", tolerance=0.01, **timing,
    )  # fmt: skip
    raw = torch.randint(256, images.shape, dtype=torch.uint8)
    results += compare(
        "polar_sample", case,
        {
            OURS: forward(lambda image: ours(image, mean=0.5, std=0.25), [raw]),
            "F.grid_sample + permute": forward(
                lambda image: tokens((image / 255 - 0.5) / 0.25), [raw]),
        },
        mode="forward, uint8", **equal,
    )  # fmt: skip
    results += compare(
        "polar_sample", case,
        {
            OURS: forward_backward(ours, [images]),
            "F.grid_sample": forward_backward(planes, [images], samples),
            "F.grid_sample + permute": forward_backward(tokens, [images]),
            "compiled F.grid_sample + permute": forward_backward(compiled, [images]),
        },
        mode="forward+backward", view=samples, **equal,
        bars={"F.grid_sample": 4.5, "F.grid_sample + permute": 7.0} if small
        else {"F.grid_sample + permute": 2.5},
    )  # fmt: skip
    return results + (embedding(size, batch, threads, seconds) if small else [])


def embedding(size: int, batch: int, threads: int, seconds: float) -> list[Result]:
    images, grid, mesh, _ = sampling_case(size, batch)
    arguments = (grid.radii, grid.azimuths, grid.center)
    weight, bias = torch.randn(96, 300) / 300**0.5, torch.randn(96)

    def ours(image, weight, bias):
        return polar_embed(image, *arguments, weight, bias, patch=(10, 10))

    def steps(image, weight, bias):
        return F.linear(to_tokens(F.grid_sample(image, mesh, align_corners=True)), weight, bias)

    case, timing = f"{size}×{size}, batch {batch}", dict(threads=threads, min_run_time=seconds)
    name, inputs = "F.grid_sample + permute + F.linear", [images, weight, bias]
    tokens = to_tokens(F.grid_sample(images, mesh, align_corners=True))
    results = compare(
        "polar_embed", case,
        {
            OURS: forward(ours, inputs),
            name: forward(steps, inputs),
            "F.linear alone": forward(lambda _, w, b: F.linear(tokens, w, b), inputs),
        },
        mode="forward", bars={name: 5.0, "F.linear alone": 1 / 1.4}, **timing,
    )  # fmt: skip
    results += compare(
        "polar_embed", case,
        {OURS: forward_backward(ours, inputs), name: forward_backward(steps, inputs)},
        mode="forward+backward, all gradients", bars={name: 4.0}, tolerance=1e-3, **timing,
    )  # fmt: skip
    return results + compare(
        "polar_embed", case,
        {
            OURS: forward_backward(lambda *wb: ours(images, *wb), inputs[1:]),
            name: forward_backward(lambda *wb: steps(images, *wb), inputs[1:]),
        },
        mode="forward+backward, weight and bias", bars={name: 4.0}, tolerance=1e-3, **timing,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    args = parser.parse_args()
    torch.manual_seed(0)
    sizes = [(64, 8)] if args.quick else [(64, 8), (256, 8), (1024, 4)]
    seconds = 0.05 if args.quick else 0.3
    print(" ".join(f"{k}={v}" for k, v in machine().items()))
    results: list[Result] = []
    for size, batch in tqdm(sizes, unit="case"):
        for threads in THREADS:
            results += sampling(size, batch, threads, seconds)
    finish(results, "sampling", avx2_share=0.6, keep=not args.quick)


if __name__ == "__main__":
    main()
