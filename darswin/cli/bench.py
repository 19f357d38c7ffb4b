"""The command `darswin bench`."""

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from darswin.bench import candidates, memory, report
from darswin.bench.machine import THREADS, machine
from darswin.bench.timing import OURS, PRODUCTS, REFERENCE, Timing, in_turns, summary
from darswin.cli.arguments import with_lists
from darswin.layers import linear
from darswin.models import list_models

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
RUNS = 7  # at least: steps of training are too long to be many, and some are disturbed
MOST = 65536  # px, and images at once
LATENCY_RUNS = 100  # at batch 1: what a 99th percentile takes
# How far the results of two candidates may be apart, of their norm.
TOLERANCES = {"float32": 1e-4, "bfloat16": 5e-2}


def bench(
    *,
    model: str = "darswin_a_small",
    size: int = 64,
    batches: Sequence[int] = (1, 8, 32),
    compiled: Sequence[int] = (8,),
    seconds: float = 2.0,
    out: Path = Path(),
) -> report.Record:
    """Measures inference and training of a model on this machine, and prints what it found.

    Args:
        model: its name. size: px, of square images. batches: B.
        compiled: the batches at which the compiled reference is measured too, at all threads.
        seconds: of each timing, about.
        out: the folder of the record, `model--<tier>.json`, and its plot.
    """
    out.mkdir(parents=True, exist_ok=True)  # before the work
    head = machine()
    print(" ".join(f"{k}={v}" for k, v in head.items()), flush=True)
    threads_before = torch.get_num_threads()
    timings: list[Timing] = []
    try:
        for mode in ("inference", "training"):
            for dtype in DTYPES:
                for batch in batches:
                    for threads in THREADS:
                        case = (mode, dtype, batch, threads)
                        with_compiled = batch in compiled and threads == max(THREADS)
                        timings += _measure(case, model, size, seconds, with_compiled)
    finally:
        torch.set_num_threads(threads_before)
    record = report.Record(
        machine=head,
        model=model,
        size=size,
        operations=candidates.operations_of(model, size),
        timings=timings,
        memory=_memory(model, size, 8) if memory.available() else [],
        products=[
            dict(shape._asdict(), seconds=seconds)
            for shape, seconds in linear.autotune_results().items()
        ],
    )
    path = out / f"model--{head['tier']}.json"
    record.save(path)
    for part in (report.products, report.table, report.memory_table, report.roof):
        print(part(record), "", sep="\n")
    print(*report.bar_lines(record), path, sep="\n")
    try:
        report.plot(record, path.with_suffix(".png"))
        print(path.with_suffix(".png"))
    except ImportError as error:
        print(f"no plot: {error}", file=sys.stderr)
    return record


def _measure(
    case: tuple[str, str, int, int], model: str, size: int, seconds: float, compiled: bool
) -> list[Timing]:
    mode, dtype, batch, threads = case
    torch.set_num_threads(threads)  # which inductor writes into its code
    kind = (model, size, DTYPES[dtype], batch)
    if mode == "inference":
        runs = candidates.inference(*kind, compiled=compiled)
    else:
        runs = candidates.training(*kind)
    _check(runs, TOLERANCES[dtype])
    least = LATENCY_RUNS if mode == "inference" and batch == 1 else RUNS
    turns = in_turns(runs, seconds, least)
    found = [summary(case, name, of_it, turns[OURS]) for name, of_it in turns.items()]
    times = ", ".join(f"{t.name} {1e3 * t.median:.1f} ms" for t in found)
    print(f"{mode}, {dtype}, batch {batch}, {threads} threads: {times}", flush=True)
    return found


def _check(runs: dict[str, candidates.Run], tolerance: float) -> None:
    """RuntimeError unless all candidates, in training at their first step, find the same."""
    results: dict[str, Tensor] = {}
    for name, run in runs.items():
        if name == PRODUCTS:
            continue
        torch.manual_seed(0)  # of jitter and drop path
        results[name] = run().float()
    want = results[REFERENCE]
    for name, got in results.items():
        error = ((got - want).norm() / want.norm()).item()
        if not error <= tolerance:
            raise RuntimeError(f"{name} is off the reference's result by {error:.1e} of its norm")


def _memory(model: str, size: int, batch: int) -> list[memory.Memory]:
    return [
        memory.measure(mode, model, size, dtype, batch, name, max(THREADS))
        for mode in ("inference", "training")
        for dtype in DTYPES
        for name in (OURS, REFERENCE)
    ]


def main(argv: list[str]) -> None:
    """`darswin bench`, with its options."""
    parser = argparse.ArgumentParser(
        prog="darswin bench", description=bench.__doc__.split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )  # fmt: skip
    default = bench.__kwdefaults__
    parser.add_argument("--model", choices=list_models(), metavar="NAME", help="a model's name")
    parser.add_argument("--size", type=_count, help="px, of the square images")
    parser.add_argument("--batches", type=_counts, metavar="B,B", help="images at once")
    parser.add_argument(
        "--compiled", type=_counts, nargs="?", const=(), metavar="B,B",
        help="batches at which torch.compile is measured too, about a minute each; none: no value",
    )  # fmt: skip
    parser.add_argument("--seconds", type=_seconds, help="of each timing, about")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    parser.set_defaults(**default)
    bench(**vars(parser.parse_args(with_lists(argv, ("batches", "compiled")))))


def _count(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= MOST:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1 to {MOST}, got {text}")
    return int(text)


def _counts(text: str) -> list[int]:
    return [_count(part) for part in text.strip("[]").split(",")]


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 0 < seconds < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, got {text}")
    return seconds
