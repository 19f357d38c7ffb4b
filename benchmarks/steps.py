"""A training step in float32, on images of 64×64: forward, backward and AdamW.

`make bench`, or `python benchmarks/steps.py [--quick] [--out FOLDER]`. It takes turns with the same
step with torch's matrix products, with the step of the PyTorch reference, eager and, for one model,
compiled, which takes minutes for the others, and with the forward pass of the optimized model.
Prints the ratios with their targets. With a folder, it writes a record there.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from kit import candidates, memory, tables, targets
from kit.machine import THREADS, machine, num_threads
from kit.record import Record
from kit.timing import BY_TORCH, COMPILED, FORWARD, OURS, REFERENCE, Case, Timing, measure

from darswin.utils.malloc import keep_freed_memory

SIZE, MODE = 64, "training, float32"
CASES = (
    ("darswin_a_micro", 32), ("darswin_a_small", 8), ("darswin_unet_ra_nano", 4),
    ("swin_micro", 32),
)  # fmt: skip


def steps(name: str, batch: int, seconds: float) -> list[Timing]:
    """Times one case on the current number of threads."""
    torch._dynamo.reset()
    case = Case(name, f"{SIZE}×{SIZE}", batch, torch.get_num_threads(), MODE)
    given = (name, SIZE, torch.float32, batch)
    network, images = candidates.network(name, SIZE).eval(), torch.randn(batch, 3, SIZE, SIZE)
    forward = candidates.optimized_run(network, candidates.lens_of(SIZE), torch.float32, images)
    runs = {
        OURS: candidates.training_step(*given),
        BY_TORCH: candidates.by_torch(candidates.training_step(*given)),
        REFERENCE: candidates.training_step(*given, is_reference=True),
        FORWARD: torch.no_grad()(forward),
    }
    if name == CASES[0][0]:
        runs[COMPILED] = candidates.training_step(*given, is_reference=True, compiled=True)
    losses = {}
    for peer in runs.keys() - {FORWARD}:
        torch.manual_seed(0)  # of jitter and drop path
        losses[peer] = runs[peer]().item()
    want = losses[REFERENCE]
    assert all(abs(loss - want) <= 1e-3 * abs(want) for loss in losses.values()), losses
    return measure(case, runs, seconds, targets=targets.STEP_TARGETS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    parser.add_argument("--out", type=Path, help="folder of the record")
    args = parser.parse_args()
    cases, seconds = ([("darswin_a_nano", 4)], 0.1) if args.quick else (CASES, 5.0)
    keep_freed_memory()
    record = Record(machine(), [])
    print(" ".join(f"{k}={v}" for k, v in record.machine.items()), flush=True)
    for name, batch in cases:
        for threads in THREADS[:1] if args.quick else THREADS:
            with num_threads(threads):
                record.timings += steps(name, batch, seconds)
        if memory.available():
            for kind in (OURS, BY_TORCH, REFERENCE):
                peak = memory.measure("training", name, SIZE, "float32", batch, kind, 1)
                record.memory.append(replace(peak, mode=name))
        print(tables.steps_table(record), flush=True)
    print(*targets.lines(record.timings), sep="\n")
    if args.out:
        record.publish(args.out, "steps", None)


if __name__ == "__main__":
    main()
