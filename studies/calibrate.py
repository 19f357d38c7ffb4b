"""Runs the calibration study: lenses found from corners of boards, by us and by others.

Each set of corners goes to each method, and the rays that a method finds are compared with the
truth: see `calibrate_rays.py`. Then real chessboards are calibrated, as far as their pictures are
there: see `calibrate_real.py`. `calibrate_tables.py` makes the tables and the figure. Run it
with `make study-calibrate`. It takes about 15 minutes of one core; with `--quick`, a minute.

Each set is a cell with a file under `--out`, so a study that was stopped can go on. mrcal (`apt-get
install mrcal`) and opencv-contrib (in an environment of its own) are used if they are there:
`calibrate_peers.py` says where they are looked for.
"""

import argparse
import json
import os
import resource
from pathlib import Path

import numpy as np
from calibrate_peers import METHODS, NEEDS, versions
from calibrate_rays import QUICK, Set, all_sets, make, ray_errors
from calibrate_real import SETS, files_of, real_set
from calibrate_tables import publish
from jobs import key_of, run_all

from darswin.utils.files import replace_file


def seconds() -> float:
    """Of one core, that this process and its programs took."""
    own, programs = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return own.ru_utime + own.ru_stime + programs.ru_utime + programs.ru_stime


def run_set(which: Set, seed: int, tools: dict[str, str]) -> dict:
    """The errors of each method for one set, or why it failed."""
    given, true = make(which, seed)
    results = {}
    for name, method in METHODS.items():
        if NEEDS.get(name, "opencv") not in tools:
            continue
        start = seconds()
        try:
            off = ray_errors(method(given).rays, true)
            found = dict(median=float(np.median(off)), most=float(np.quantile(off, 0.95)))
        except Exception as error:  # of any tool: it is a result
            found = dict(failed=f"{type(error).__name__}: {error}")
        results[name] = found | dict(seconds=round(seconds() - start, 2))
    return which._asdict() | dict(seed=seed, results=results)


def run_cell(file: Path, work: str, *arguments: object) -> dict:
    """One set, or the real pictures; or the results of an earlier run."""
    if file.exists():
        return json.loads(file.read_text())
    start = seconds()
    result = {"set": run_set, "real": real_set}[work](*arguments)
    cell = {work: result, "seconds": round(seconds() - start, 1)}
    file.parent.mkdir(parents=True, exist_ok=True)
    replace_file(file, json.dumps(cell, indent=1, allow_nan=False))
    return cell


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick", action="store_true", help="runs three sets, and leaves the record alone"
    )
    parser.add_argument("--cell", default="", help="runs only cells whose key contains this text")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument(
        "--collect", action="store_true", help="runs nothing and collects existing results"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("out") / "boards",
        help="the folder with clones of the repositories with real boards",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("out") / "calibrate")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results")
    args = parser.parse_args(arguments)
    if args.quick:
        args.out = args.results = args.out / "quick"
    tools, jobs = versions(), []
    for seed, which in enumerate(QUICK if args.quick else all_sets()):
        key = key_of(f"{seed:03} {which.model} {which.fov} {which.pictures} {which.noise}")
        jobs.append((args.out / f"{key}.json", "set", which, seed, tools))
    for name, boards in {} if args.quick else SETS.items():
        if files := files_of(boards, args.data):
            jobs.append((args.out / f"{key_of(name)}.json", "real", name, files, tools))
    jobs = [job for job in jobs if args.cell in job[0].stem]
    if args.collect:
        jobs = [job for job in jobs if job[0].exists()]
    cells = run_all(run_cell, jobs, args.processes, "cell")
    sets = sorted((cell["set"] for cell in cells if "set" in cell), key=lambda of: of["seed"])
    record = dict(
        versions=tools, core_minutes=round(sum(cell["seconds"] for cell in cells) / 60, 1),
        sets=sets, real=[cell["real"] for cell in cells if "real" in cell],
    )  # fmt: skip
    publish(record, args.results)


if __name__ == "__main__":
    main()
