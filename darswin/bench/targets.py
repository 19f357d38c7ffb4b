"""The targets of the measured ratios."""

from collections.abc import Sequence

from darswin.bench.memory import Memory, compared
from darswin.bench.timing import (
    COMPILED,
    COMPILED_BFLOAT16,
    MATMULS,
    OURS,
    OURS_BFLOAT16,
    OURS_FLOAT32,
    REFERENCE,
    Case,
    Timing,
)

MODEL, SETTING = "darswin_a_small", "64×64"
# By mode and batch: the smallest ratios of peers' times over ours, at all threads.
MODEL_TARGETS = {
    ("inference, float32", 8): {REFERENCE: 2.6, COMPILED: 2.2, MATMULS: 0.8},
    ("inference, float32", 1): {REFERENCE: 2.2},
    ("inference, bfloat16", 8): {REFERENCE: 1.35, COMPILED: 1.1},
    ("inference, int8", 8): {
        OURS_FLOAT32: 2.3,
        OURS_BFLOAT16: 1.6,
        COMPILED: 1.6,
        COMPILED_BFLOAT16: 1.6,
        MATMULS: 0.7,
    },
    ("inference, int8", 1): {OURS_FLOAT32: 1.8},
    ("training, float32", 8): {REFERENCE: 2.0},
    ("training, bfloat16", 8): {REFERENCE: 1.15},
}
MEMORY_TARGET = 0.8  # the largest ratio of the peak of a training step over the reference's


def of_model(case: Case) -> dict[str, float]:
    """The targets of a model's case at all threads."""
    if (case.subject, case.setting) != (MODEL, SETTING):
        return {}
    return MODEL_TARGETS.get((case.mode, case.batch), {})


def lines(timings: Sequence[Timing], avx2_share: float = 1.0) -> list[str]:
    """Compares ratios with their targets; on the AVX2 tier, the target is `avx2_share` of it."""
    avx2 = {t.label: t for t in timings if t.name == f"{OURS} (avx2)"}
    found = []
    for t in timings:
        if t.target is None:
            continue
        line = _against(t.ratio, t.target, t.missed)
        if t.label in avx2:
            ratio, target = t.median / avx2[t.label].median, t.target * avx2_share
            line += f"; avx2 {_against(ratio, target, ratio < target)}"
        found.append(f"{t.label}: {t.name} {line}")
    return found


def memory_lines(memory: Sequence[Memory]) -> list[str]:
    """Compares the peaks of training steps of `MODEL` with their target."""
    return [
        f"peak memory, {what}: {_against(a / b, MEMORY_TARGET, a / b > MEMORY_TARGET)}"
        for what, a, b in compared(memory)
        if what.startswith("training")
    ]


def _against(ratio: float, target: float, missed: bool) -> str:
    return f"{ratio:.2f} (target {target:.2f}){' MISSED' if missed else ''}"
