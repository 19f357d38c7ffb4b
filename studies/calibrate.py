"""Runs the calibration study: lenses found from corners of boards, by us and by others.

Each set of corners goes to each method, and the rays that a method finds are compared with the
truth: see `calibrate_rays.py`. Then the chessboards of Debian's package `opencv-doc` are calibrated:
see `calibrate_real.py`. `calibrate_tables.py` makes the tables and the figure. Run it with
`make study-calibrate`; with `--quick` it takes a minute.

mrcal (`apt-get install mrcal`) and opencv-contrib (in an environment of its own) are used if they
are there: `calibrate_peers.py` says where they are looked for.
"""

import argparse
import resource
import time
from pathlib import Path

import numpy as np
from calibrate_peers import METHODS, versions
from calibrate_rays import Set, all_sets, make, ray_errors
from calibrate_real import DATA, real_cameras

# from calibrate_tables import publish
from jobs import use_one_core
from tqdm import tqdm

QUICK = [Set("KannalaBrandt", 150, 8, compared=True), Set("Spherical", 220, 20), Set("Mei", 60, 5)]


def seconds() -> float:
    """Of one core, that this process and its programs took."""
    own, programs = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return own.ru_utime + own.ru_stime + programs.ru_utime + programs.ru_stime


def run_set(which: Set, seed: int, methods: list[str]) -> dict:
    """The errors of each method for one set, or why it failed."""
    given, true = make(which, seed)
    results = {}
    for name in methods:
        if name == "ours, auto" and not which.compared:
            continue
        start = seconds()
        try:
            off = ray_errors(METHODS[name](given), true)
            found = dict(median=float(np.median(off)), most=float(np.quantile(off, 0.95)))
        except Exception as error:  # of any tool: it is a result
            found = dict(failed=f"{type(error).__name__}: {error}")
        results[name] = found | dict(seconds=round(seconds() - start, 2))
    return which._asdict() | dict(seed=seed, results=results)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="runs three sets")
    parser.add_argument("--cell", help="runs only sets of models whose name contains this text")
    parser.add_argument("--data", type=Path, default=DATA, help="the folder with left01.jpg …")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args(arguments)
    use_one_core()
    start, tools = time.perf_counter(), versions()
    needs = {"cv2.omnidir": "opencv-contrib", "mrcal, OPENCV8": "mrcal", "mrcal, splined": "mrcal"}
    methods = [name for name in METHODS if needs.get(name, "opencv") in tools]
    chosen = [*enumerate(QUICK if args.quick else all_sets())]
    chosen = [(k, which) for k, which in chosen if (args.cell or "") in which.model]
    sets = [run_set(which, k, methods) for k, which in tqdm(chosen, unit="set")]
    real = real_cameras(args.data, auto=not args.quick) if args.data.is_dir() else []
    record = dict(
        versions=tools, minutes=round((time.perf_counter() - start) / 60, 1),
        core_minutes=round(seconds() / 60, 1), methods=methods, sets=sets, real=real,
    )  # fmt: skip
    print(record)  # publish(record, args.results)


if __name__ == "__main__":
    main()
