"""The command `darswin bench`."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from darswin.bench import candidates, memory, plot, tables, targets
from darswin.bench.machine import THREADS, machine, num_threads
from darswin.bench.record import Record
from darswin.bench.timing import MATMULS, OURS, REFERENCE, TURNS, Case, Timing, measure
from darswin.cli.arguments import with_lists
from darswin.layers import linear, onednn
from darswin.models import list_models

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
INT8 = {"int8": torch.int8}  # inference, where the CPU has it
MOST = 65536  # px, and images at once
LATENCY_RUNS = 100  # at batch 1: what a 99th percentile takes
# How far the results of two candidates may be apart, of their norm.
TOLERANCES = {"float32": 1e-4, "bfloat16": 5e-2, "int8": 1e-1}


def bench(
    *,
    model: str = "darswin_a_small",
    size: int = 64,
    batches: Sequence[int] = (1, 8, 32),
    compiled: Sequence[int] = (8,),
    seconds: float = 2.0,
    out: Path = Path(),
) -> Record:
    """Measures inference and training of a model on this machine, and prints what it found.

    With the default options it takes a quarter of an hour.

    Args:
        model: its name. size: px, of square images. batches: B.
        compiled: the batches at which the compiled reference is measured too, at all threads.
        seconds: of each timing, about.
        out: the folder of the record, `model--<CPU>-<tier>.json`, and its plot.
    """
    out.mkdir(parents=True, exist_ok=True)  # before the work
    head = machine()
    print(" ".join(f"{k}={v}" for k, v in head.items()), flush=True)
    timings: list[Timing] = []
    for mode in ("inference", "training"):
        for dtype in _dtypes(mode):
            for batch in batches:
                for threads in THREADS:
                    with_compiled = batch in compiled and threads == max(THREADS)
                    with num_threads(threads):
                        timings += _measure(mode, dtype, model, size, batch, seconds, with_compiled)
    record = Record(
        machine=head,
        timings=timings,
        memory=_memory(model, size, 8) if memory.available() else [],
        operations=candidates.operations_of(model, size),
        autotune=[
            dict(shape._asdict(), seconds=seconds)
            for shape, seconds in linear.autotune_results().items()
        ],
    )
    print(*tables.autotune_lines(record.autotune), "", sep="\n")
    print(tables.models_table(timings), "", tables.quantized_table(timings), "", sep="\n")
    print(tables.memory_table(record.memory), "", sep="\n")
    print(*tables.roofline_lines(record), "", *targets.lines(timings), sep="\n")
    if (model, f"{size}×{size}") == (targets.MODEL, targets.SETTING):
        print(*targets.memory_lines(record.memory), sep="\n")
    record.publish(out, "model", plot.draw_models)
    return record


def _measure(
    mode: str, dtype: str, model: str, size: int, batch: int, seconds: float, compiled: bool
) -> list[Timing]:
    threads = torch.get_num_threads()
    case = Case(model, f"{size}×{size}", batch, threads, f"{mode}, {dtype}")
    if mode == "inference":
        kind = (DTYPES | INT8)[dtype]
        runs = candidates.inference(model, size, kind, batch, compiled=compiled)
    else:
        runs = candidates.training(model, size, DTYPES[dtype], batch)
    _check(runs, TOLERANCES[dtype])
    least = LATENCY_RUNS if mode == "inference" and batch == 1 else TURNS
    wanted = targets.of_model(case) if threads == max(THREADS) else None
    found = measure(case, runs, seconds, least=least, targets=wanted)
    times = ", ".join(f"{t.name} {1e3 * t.median:.1f} ms" for t in found)
    print(f"{mode}, {dtype}, batch {batch}, {threads} threads: {times}", flush=True)
    return found


def _dtypes(mode: str) -> list[str]:
    quantized = mode == "inference" and onednn.missing(torch.int8) is None
    return [*DTYPES, *(INT8 if quantized else ())]


def _check(runs: dict[str, candidates.Run], tolerance: float) -> None:
    """RuntimeError unless all candidates, in training at their first step, find the same."""
    results: dict[str, Tensor] = {}
    for name, run in runs.items():
        if name == MATMULS:
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


def run(argv: list[str]) -> None:
    """Runs `darswin bench` with the arguments that follow it."""
    parser = argparse.ArgumentParser(
        prog="darswin bench", description=(bench.__doc__ or "").split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )  # fmt: skip
    parser.add_argument("--model", choices=list_models(), metavar="NAME", help="a model's name")
    parser.add_argument("--size", type=_count, help="px, of the square images")
    parser.add_argument("--batches", type=_counts, metavar="B,B", help="images at once")
    parser.add_argument(
        "--compiled", type=_counts, nargs="?", const=(), metavar="B,B",
        help="batches at which torch.compile is measured too, about a minute each; none: no value",
    )  # fmt: skip
    parser.add_argument("--seconds", type=_seconds, help="of each timing, about")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    parser.set_defaults(**(bench.__kwdefaults__ or {}))
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
