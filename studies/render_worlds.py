"""Renders pictures, labels and distances of Freedoom's worlds through lenses.

The textures of the game are drawn by hand and under the BSD licence: `apt-get install freedoom`,
https://freedoom.github.io. Training, validation and test pictures show different maps. The result
is a data set for `darswin fit --task segmentation` and `--task distance`. A rendering that was
stopped goes on. `make worlds` makes a small data set.

With `--cube 512`, the pictures are the six faces of a cube, of 512 px each, as simulators write
them: `darswin rig fisheye out/cubes/train --to lens.json --depth_unit 0.001 --out fisheye`.
"""

import argparse
import math
import os
import time
from pathlib import Path

from jobs import run_all
from worlds.cubes import write_cubes
from worlds.dataset import SPLITS, Target, jobs_of, shares, write_map
from worlds.sheet import draw_sheet


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="the default is out/worlds, or out/cubes")
    parser.add_argument(
        "--lens",
        default="0..1",
        help='"wide", ξ as "0.4", a range as "0.2..0.35", "polynomial", or a FILE[:CAMERA]',
    )
    parser.add_argument(
        "--fov-deg", type=float, default=165, help="the full field of view of lenses given by ξ"
    )
    parser.add_argument("--size", type=int, default=128, help="the size of the square pictures, px")
    parser.add_argument("--cube", type=int, help="the side of cubes' faces, in place of a lens, px")
    parser.add_argument("--train", type=int, default=1000, help="the number of pictures")
    parser.add_argument("--val", type=int, default=100, help="the number of pictures")
    parser.add_argument("--test", type=int, default=200, help="the number of pictures")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument(
        "--sheet", type=Path, help="only draws a few pictures side by side into this file"
    )
    args = parser.parse_args(arguments)
    if args.sheet:
        draw_sheet(args.sheet)
        return
    out = args.out or Path("out") / ("cubes" if args.cube else "worlds")
    start = time.perf_counter()
    counts, jobs = {split: getattr(args, split) for split in SPLITS}, []
    if args.cube:
        for split, count in counts.items():
            maps = shares(split, count)
            jobs += [(name, split, out, args.cube, number, args.seed) for name, number in maps]
        run_all(write_cubes, jobs, args.processes, "map")
    else:
        target = Target(str(out), args.lens, math.radians(args.fov_deg))
        for split, count in counts.items():
            jobs += jobs_of([target], split, count, args.size, args.seed)
        run_all(write_map, jobs, args.processes, "map")
    made = sum(counts.values())
    print(f"{made} pictures in {out} after {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
