"""polar_sample, forward and forward+backward, against what a user would write without it.

`make bench`, or `python benchmarks/sampling.py [--quick]`. Writes benchmarks/results/*.json and a
plot beside it, and prints the tables of the README and each ratio against its bar.
"""

import argparse
import math

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from common import OURS, THREADS, Result, compare, finish, forward, forward_backward, machine
from torch import Tensor
from tqdm import tqdm

from darswin import polar_grid
from darswin.lens import Spherical
from darswin.ops import polar_sample


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    args = parser.parse_args()
    torch.manual_seed(0)
    sizes = [(64, 8)] if args.quick else [(64, 8), (256, 8), (1024, 4)]
    seconds = 0.05 if args.quick else 0.5
    print(" ".join(f"{k}={v}" for k, v in machine().items()))
    results: list[Result] = []
    for size, batch in tqdm(sizes, unit="case"):
        for threads in THREADS:
            results += sampling(size, batch, threads, seconds)
    finish(results, "sampling", avx2_share=0.6, keep=not args.quick)


if __name__ == "__main__":
    main()
