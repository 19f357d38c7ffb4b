"""A whole model, compared with the PyTorch reference and with the matrix products alone.

`make bench`, or `python benchmarks/model.py [OPTIONS]`, whose `--help` lists the options.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from kit import candidates, memory, plot, tables, targets
from kit.machine import THREADS, machine, num_threads
from kit.record import Record
from kit.timing import MATMULS, OURS, REFERENCE, TURNS, Case, Timing, measure
from torch import Tensor

from darswin.cli.arguments import run_command
from darswin.models.registry import model_class
from darswin.utils.malloc import keep_freed_memory
from darswin.utils.parameters import check

DTYPES = {
    "inference": {"float32": torch.float32, "int8": torch.int8},
    "training": {"float32": torch.float32, "bfloat16": torch.bfloat16},
}
MOST = 65536  # px, and images at once
LATENCY_RUNS = 100  # at batch 1, for a 99th percentile
# The largest relative difference of two candidates' results.
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
    """Measures the speed of inference and training of a model on this machine.

    With the default options this takes a quarter of an hour. The program prints tables, and writes
    a record and a plot.

    Args:
        model: the name of the model; `darswin models` lists them.
        size: the side of the square images, px.
        batches: the batch sizes.
        compiled: the batch sizes at which torch.compile is measured too, which takes about a minute
            each. Without a value, it is not measured.
        seconds: the approximate time for each timing.
        out: the folder for the record, `model--<CPU>-<tier>.json`, and its plot.
    """
    model_class(model)  # check everything before the work
    for name, count in (("size", size), *(("batches", b) for b in (*batches, *compiled))):
        check(name, count, 1 <= count <= MOST, f"from 1 to {MOST}")
    if not batches:
        raise ValueError("--batches must have at least one number")
    check("seconds", seconds, 0 < seconds < float("inf"), "above 0")
    keep_freed_memory()
    out.mkdir(parents=True, exist_ok=True)
    head = machine()
    print(" ".join(f"{k}={v}" for k, v in head.items()), flush=True)
    timings: list[Timing] = []
    for mode in ("inference", "training"):
        for dtype in DTYPES[mode]:
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
    )
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
    kind = DTYPES[mode][dtype]
    if mode == "inference":
        runs = candidates.inference(model, size, kind, batch, compiled=compiled)
    else:
        runs = candidates.training(
            model, size, kind, batch, compiled=compiled and dtype == "float32"
        )
    _check(runs, TOLERANCES[dtype])
    least = LATENCY_RUNS if mode == "inference" and batch == 1 else TURNS
    wanted = targets.of_model(case) if threads == max(THREADS) else None
    found = measure(case, runs, seconds, least=least, targets=wanted)
    times = ", ".join(f"{t.name} {1e3 * t.median:.1f} ms" for t in found)
    print(f"{mode}, {dtype}, batch {batch}, {threads} threads: {times}", flush=True)
    return found


def _check(runs: dict[str, candidates.Run], tolerance: float) -> None:
    """RuntimeError unless all candidates find the same; in training, at their first step."""
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
            raise RuntimeError(f"{name} differs from the reference by {error:.1e} of its norm")


def _memory(model: str, size: int, batch: int) -> list[memory.Memory]:
    return [
        memory.measure(mode, model, size, dtype, batch, name, max(THREADS))
        for mode, dtypes in DTYPES.items()
        for dtype in dtypes
        if dtype != "int8"
        for name in (OURS, REFERENCE)
    ]


if __name__ == "__main__":
    run_command(bench, sys.argv[1:], "python benchmarks/model.py")
