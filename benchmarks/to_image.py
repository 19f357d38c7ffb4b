"""polar_to_image, forward and backward, compared with a padded F.grid_sample.

`make bench`, or `python benchmarks/to_image.py [--quick] [--out FOLDER]`. Prints tables and
the ratios with their targets. With a folder, it writes a record and a plot there.
"""

import argparse
import math
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F
from kit.timing import OURS, Case, Timing
from peers import compare, run_suite
from torch import Tensor

from darswin.ops import polar_to_image, polar_to_image_plan

PEER = "F.pad + F.grid_sample"
# Batch, rings, sectors, channels and side of the image: the smallest ratios for forward, in tokens
# and as an image.
CASES = {(4, 16, 64, 96, 128): (4.0, 2.5), (2, 64, 256, 96, 256): (5.0, 3.0)}
# The same for images of few channels, with a plan: for forward, and for forward and backward.
FEW_CHANNELS = {(2, 64, 256, 1, 256): (1.0, 1.5), (2, 64, 256, 3, 256): (1.5, 1.5)}


def mesh(rings: int, sectors: int, size: int) -> Tensor:
    """The mesh (size, size, 2) for grid_sample on a map that is padded by a sector on both sides
    and by the ring across the pole."""
    offset = torch.arange(size) - (size - 1) / 2
    y, x = torch.meshgrid(offset, offset, indexing="ij")
    ring = (torch.hypot(x, y) * (2 * rings / size) - 0.5).clamp(max=rings - 1) + 1
    column = (torch.atan2(y, x) * (sectors / (2 * math.pi)) - 0.5) % sectors + 1
    return torch.stack(((2 * column + 1) / (sectors + 2) - 1, (2 * ring + 1) / (rings + 1) - 1), -1)


def inputs(batch: int, rings: int, sectors: int, channels: int, size: int) -> tuple[Tensor, ...]:
    """Maps, the radii of their rings, their centre, and their mesh."""
    radii = ((torch.arange(rings) + 0.5) * (size / 2 / rings))[None]
    places = mesh(rings, sectors, size).expand(batch, -1, -1, -1)
    maps = torch.randn(batch, rings, sectors, channels)
    return maps, radii, torch.full((1, 2), (size - 1) / 2), places


def padded(maps: Tensor, places: Tensor) -> Tensor:
    """Maps (B, R, A, C) as images (B, C, H, W), by `F.grid_sample`."""
    planes = maps.permute(0, 3, 1, 2)
    across = planes[:, :, :1].roll(maps.shape[2] // 2, 3)
    planes = F.pad(torch.cat((across, planes), 2), (1, 1, 0, 0), mode="circular")
    return F.grid_sample(planes, places, align_corners=False, padding_mode="border")


def to_image(
    sizes: tuple[int, int, int, int, int],
    mode: str,
    layout: str,
    seconds: float,
    planned: bool = False,
) -> list[Timing]:
    """Times one case. `layout` is that of the operator; for "tokens", the peer permutes."""
    batch, rings, sectors, channels, size = sizes
    maps, radii, center, places = inputs(*sizes)
    plan = polar_to_image_plan(maps, radii, center, (size, size)) if planned else None

    def ours(maps: Tensor) -> Tensor:
        return polar_to_image(maps, radii, center, (size, size), plan=plan, layout=layout)

    def peer(maps: Tensor) -> Tensor:
        image = padded(maps, places)
        return image.permute(0, 2, 3, 1).contiguous() if layout == "tokens" else image

    setting = f"{rings}×{sectors} → {size}×{size}"
    if sizes in FEW_CHANNELS:
        setting += f", channels: {channels}"
        targets = {PEER: FEW_CHANNELS[sizes][mode != "forward"]} if planned else {}
    else:
        targets = {PEER: CASES[sizes][layout == "image"] if mode == "forward" else 8.0}
    mode += f", layout {layout}" * (layout != "image") + ", plan kept" * planned
    case = Case("polar_to_image", setting, batch, torch.get_num_threads(), mode)
    # The coordinates of grid_sample are float32, in units of the whole map.
    return compare(case, {OURS: ours, PEER: peer}, [maps], seconds, targets=targets, tolerance=1e-4)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    torch.manual_seed(0)
    seconds = 0.05 if args.quick else 0.5
    jobs = [
        partial(to_image, sizes, mode, layout, seconds)
        for sizes in list(CASES)[: 1 if args.quick else None]
        for mode in ("forward", "forward+backward")
        for layout in ("tokens", "image")
    ]
    if not args.quick:
        jobs += [
            partial(to_image, sizes, mode, "image", seconds, planned)
            for sizes in FEW_CHANNELS
            for mode in ("forward", "forward+backward")
            for planned in (False, True)
        ]
    run_suite("to_image", jobs, avx2_share=0.6, out=args.out)


if __name__ == "__main__":
    main()
