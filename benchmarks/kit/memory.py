"""The peak memory of a batch, measured in its own process, which runs this module."""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from darswin.utils.malloc import give_back_memory
from kit import candidates
from kit.timing import BY_TORCH, OURS, REFERENCE

BENCHMARKS = Path(__file__).parents[1]
_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass
class Memory:
    """The resident memory of a process for one measurement, in bytes."""

    mode: str  # such as "training, float32"
    batch: int
    name: str
    before: int  # with Python, torch and darswin, but without a model
    between: int  # between two batches
    peak: int  # during a batch

    @property
    def whole(self) -> int:
        """The bytes for the model, its optimizer and a batch."""
        return self.peak - self.before

    @property
    def own(self) -> int:
        """The bytes for a batch alone."""
        return self.peak - self.between


def compared(memory: Sequence[Memory]) -> Iterator[tuple[str, int, int]]:
    """Yields a name for each measurement, our bytes and the reference's."""
    found = {(m.mode, m.batch, m.name): m for m in memory}
    for ours in memory:
        if ours.name == OURS:
            theirs = found[ours.mode, ours.batch, REFERENCE]
            what = f"{ours.mode}, batch {ours.batch}"
            yield f"{what}, in all", ours.whole, theirs.whole
            yield f"{what}, of the batch itself", ours.own, theirs.own


def available() -> bool:
    """True if a process can read and reset its peak memory on this system."""
    return _STATUS.exists() and _RESET.exists()


def measure(
    mode: str, model: str, size: int, dtype: str, batch: int, name: str, threads: int
) -> Memory:
    """Measures `OURS`, `REFERENCE` or, in training, `BY_TORCH` in a new process."""
    arguments = map(str, (mode, model, size, dtype, batch, name, threads))
    command = [sys.executable, "-m", "kit.memory", *arguments]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"the peak memory of {name} cannot be measured: {done.stderr.strip()}")
    return Memory(**json.loads(done.stdout.splitlines()[-1]))


def _resident(kind: str) -> int:
    lines = _STATUS.read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(f"{kind}:"))


def _measure_here(
    mode: str, model: str, size: str, dtype: str, batch: str, name: str, threads: str
) -> Memory:
    torch.set_num_threads(int(threads))
    before = _resident("VmRSS")
    pixels, kind, reference = int(size), getattr(torch, dtype), name == REFERENCE
    if mode == "training":
        run = candidates.training_step(model, pixels, kind, int(batch), is_reference=reference)
        run = candidates.by_torch(run) if name == BY_TORCH else run
    else:
        net, lens = candidates.network(model, pixels).eval(), candidates.lens_of(pixels)
        images = torch.randn(int(batch), 3, pixels, pixels)
        if reference:
            run = candidates.reference_run(net, lens, images)
        else:
            run = candidates.optimized_run(net, lens, kind, images)
        run = torch.no_grad()(run)
        del net  # the optimized model is a copy
    for _ in range(2):
        run()
    give_back_memory()
    between = _resident("VmRSS")
    _RESET.write_text("5")  # the peak starts from here
    run()
    return Memory(f"{mode}, {dtype}", int(batch), name, before, between, _resident("VmHWM"))


if __name__ == "__main__":
    print(json.dumps(asdict(_measure_here(*sys.argv[1:])), allow_nan=False))
