"""polar_sample, compared with code that users write without it.

`make bench`, or `python benchmarks/sampling.py [--quick] [--out FOLDER]`. Prints tables and
the ratios with their targets. With a folder, it writes a record and a plot there.
"""

import argparse
import math
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from kit.timing import OURS, Case, Timing, measure
from peers import check, compare, forward, run_suite
from torch import Tensor

from darswin import PolarView
from darswin.lens import Spherical
from darswin.ops import polar_sample


def sampling_case(size: int, batch: int):
    """Images, the grid of the lenses, and the mesh for grid_sample and remap."""
    images = torch.randn(batch, 3, size, size)
    lens = Spherical.from_fov(torch.linspace(0.1, 0.9, batch), math.radians(170), size / 2)
    grid = PolarView(rings=16, sectors=64, samples=(10, 10)).grid(lens, (size, size))
    x = grid.center[:, 0, None, None] + grid.radii[:, :, None] * torch.cos(grid.azimuths)
    y = grid.center[:, 1, None, None] + grid.radii[:, :, None] * torch.sin(grid.azimuths)
    mesh = 2 * torch.stack((x, y), -1) / (size - 1) - 1
    return images, grid, mesh, (x, y)


def to_tokens(planes: Tensor) -> Tensor:
    """Samples (B, C, 160, 640) → tokens (B, 16, 64, 100·C) for the embedding."""
    batch, channels = planes.shape[:2]
    patches = planes.reshape(batch, channels, 16, 10, 64, 10).permute(0, 2, 4, 3, 5, 1)
    return patches.reshape(batch, 16, 64, 100 * channels)


def as_tokens(result: Tensor) -> Tensor:
    """Converts planes to tokens; leaves other results unchanged."""
    return to_tokens(result) if result.shape[-2:] == (160, 640) else result


def sampling(size: int, batch: int, seconds: float) -> list[Timing]:
    case = partial(Case, "polar_sample", f"{size}×{size}", batch, torch.get_num_threads())
    images, grid, mesh, (x, y) = sampling_case(size, batch)
    arguments = (grid.radii, grid.azimuths, grid.center)
    small = size <= 256

    def ours(image, **options):
        return polar_sample(image, *arguments, samples=(10, 10), **options)

    def planes(image):
        return F.grid_sample(image, mesh, align_corners=True)

    def tokens(image):
        return to_tokens(planes(image))

    def half(image):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            return ours(image)

    def drop_in(image):  # the call of docs/howto/sampling.md
        return polar_sample(image, *arguments, samples=(1, 1), layout="image")

    maps = [(a.numpy(), b.numpy()) for a, b in zip(x, y, strict=True)]
    frames = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in images]

    def remap() -> list[Tensor]:
        cv2.setNumThreads(torch.get_num_threads())
        pairs = zip(frames, maps, strict=True)
        return [torch.from_numpy(cv2.remap(frame, *xy, cv2.INTER_LINEAR)) for frame, xy in pairs]

    def remapped() -> list[Tensor]:
        return [to_tokens(torch.stack(remap()).permute(0, 3, 1, 2))]

    torch._dynamo.reset()
    peer, peer_tokens, remaps = "F.grid_sample", "F.grid_sample + permute", "cv2.remap"
    runs = {OURS: ours, peer: planes, peer_tokens: tokens}
    runs[f"compiled {peer_tokens}"] = torch.compile(tokens, dynamic=False)
    # The coordinates of grid_sample are float32: at 1000 px, their error is 1e-4 px.
    tolerance = 1e-4 if small else 1e-3
    targets = {peer: 5.0, peer_tokens: 10.0} if small else {peer: 2.5}
    timings = compare(
        case("forward"), runs, [images], seconds,
        targets=targets, tolerance=tolerance, view=as_tokens,
    )  # fmt: skip
    # cv2.remap rounds coordinates to 1/32 px, which the check allows. It is timed without permute.
    step, targets = forward(ours, [images]), {remaps: 2.4 if small else 1.4}
    check(case("forward"), {OURS: step, remaps: remapped}, 0.05)
    timings += measure(case("forward"), {OURS: step, remaps: remap}, seconds, targets=targets)[1:]
    pair, least = {OURS: drop_in, peer: planes}, 2.5 if size == 64 else 1.8
    timings += compare(
        case("forward, layout image"), pair, [images], seconds,
        targets={peer: least}, tolerance=tolerance,
    )  # fmt: skip
    timings += compare(
        case("forward+backward, layout image"), pair, [images], seconds,
        targets={peer: 3.5}, tolerance=tolerance,
    )  # fmt: skip
    for channels in (1, 16, 64) if small else ():
        timings += compare(
            case(f"forward, layout image, channels: {channels}"), pair,
            [torch.randn(batch, channels, size, size)], seconds,
            targets={peer: 1.0}, tolerance=tolerance,
        )  # fmt: skip
    jittered = {OURS: lambda image: ours(image, jitter=1.0, seed=1), "darswin without jitter": ours}
    timings += compare(
        case("forward, jitter"), jittered, [images], seconds,
        targets={"darswin without jitter": 1 / 1.6}, tolerance=None,
    )  # fmt: skip
    halves = {OURS: half, peer_tokens: lambda image: tokens(image).bfloat16()}
    timings += compare(case("forward, bfloat16"), halves, [images], seconds, tolerance=0.01)
    normalized = {
        OURS: lambda image: ours(image, mean=0.5, std=0.25),
        peer_tokens: lambda image: tokens((image / 255 - 0.5) / 0.25),
    }
    raw = torch.randint(256, images.shape, dtype=torch.uint8)
    timings += compare(case("forward, uint8"), normalized, [raw], seconds, tolerance=tolerance)
    if not small:
        timings += large(case, images, ours, tokens, remap, seconds)
    targets = {peer: 4.5, peer_tokens: 7.0} if small else {peer_tokens: 2.5}
    return timings + compare(
        case("forward+backward"), runs, [images], seconds,
        targets=targets, tolerance=tolerance, view=as_tokens,
    )  # fmt: skip


def large(case, images: Tensor, ours, tokens, remap, seconds: float) -> list[Timing]:
    """Large images, channels last or gray; the peers get their best layout."""
    together = images.contiguous(memory_format=torch.channels_last)
    peer = "F.grid_sample + permute"
    step = forward(ours, [together])
    runs = {
        OURS: step,
        f"{peer}, planes": forward(tokens, [images]),
        peer: forward(tokens, [together]),
    }
    check(case("forward, channels_last"), runs, 1e-3)
    targets = {f"{peer}, planes": 2.5, peer: 2.5, "cv2.remap": 1.3}
    timings = measure(
        case("forward, channels_last"), runs | {"cv2.remap": remap}, seconds, targets=targets
    )
    gray = images[:, :1].contiguous()
    return timings + compare(
        case("forward, gray"), {OURS: ours, peer: tokens}, [gray], seconds,
        targets={peer: 1.5}, tolerance=1e-3,
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    torch.manual_seed(0)
    sizes = [(64, 8)] if args.quick else [(64, 8), (256, 8), (1024, 4)]
    seconds = 0.05 if args.quick else 0.3
    jobs = [partial(sampling, size, batch, seconds) for size, batch in sizes]
    run_suite("sampling", jobs, avx2_share=0.6, out=args.out)


if __name__ == "__main__":
    main()
