"""The targets of the measured ratios."""

from collections.abc import Sequence

from kit.memory import Memory, compared
from kit.start import Start
from kit.timing import (
    BY_TORCH,
    COMPILED,
    COMPILED_BFLOAT16,
    FORWARD,
    MATMULS,
    OURS,
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
    ("inference, int8", 8): {
        OURS_FLOAT32: 2.3,
        COMPILED: 1.6,
        COMPILED_BFLOAT16: 1.6,
        MATMULS: 0.7,
    },
    ("inference, int8", 1): {OURS_FLOAT32: 1.8},
    ("training, float32", 8): {REFERENCE: 2.0},
    ("training, bfloat16", 8): {REFERENCE: 1.15},
}
# Of training steps of all models, at any number of threads. On CPUs whose MKL is fast, our step
# and that with torch's products are one.
STEP_TARGETS = {BY_TORCH: 0.97, REFERENCE: 1.2, COMPILED: 1.0, FORWARD: 0.2}
# Of the ground from four cameras, by seam: the smallest ratios of peers' times over ours on one
# thread, and of our time on one thread over that on all.
RIG_TARGETS = {
    "hard": {"OpenCV in rectangles": 1 / 0.28, "four cv2.remap + NumPy": 1 / 0.15,
             f"{OURS}, 1 thread": 1.7},
    "narrow": {"OpenCV in rectangles": 1 / 0.32, "four cv2.remap + NumPy": 1 / 0.15,
               f"{OURS}, 1 thread": 1.7},
}  # fmt: skip
MEMORY_TARGET = 0.8  # the largest ratio of the peak of a training step over the reference's
# For frames at the pace of a camera: the least ratio of our median over our p99, and of our times
# on one thread over those on more.
STEADY, MORE_THREADS = 1 / 1.5, 1 / 1.05
START_SECONDS, START_MEGABYTES = 0.3, 60  # the most for a program's first answer


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
        line = _at_least(t.ratio, t.target)
        if t.label in avx2:
            ratio, target = t.median / avx2[t.label].median, t.target * avx2_share
            line += f"; avx2 {_at_least(ratio, target)}"
        found.append(f"{t.label}: {t.name} {line}")
    return found


def memory_lines(memory: Sequence[Memory]) -> list[str]:
    """Compares the peaks of training steps of `MODEL` with their target."""
    return [
        f"peak memory, {what}: {_at_most(a / b, MEMORY_TARGET)}"
        for what, a, b in compared(memory)
        if what.startswith("training")
    ]


def paced_lines(timings: Sequence[Timing]) -> list[str]:
    """Compares our times at the pace of a camera with each other: p99 with the median, and both on
    one thread with those on more."""
    ours = [t for t in timings if t.paced and t.name == OURS]
    alone = {(t.subject, t.setting, t.batch, t.mode): t for t in ours if t.threads == 1}
    found = []
    for t in ours:
        ratios = {"p50 over p99": (t.median / _p99(t), STEADY)}
        if t.threads != 1:
            one = alone[t.subject, t.setting, t.batch, t.mode]
            ratios["p50 on one thread"] = (one.median / t.median, MORE_THREADS)
            ratios["p99 on one thread"] = (_p99(one) / _p99(t), MORE_THREADS)
        found += [f"{t.label}: {what} {_at_least(*ratio)}" for what, ratio in ratios.items()]
    return found


def _p99(t: Timing) -> float:
    assert t.p99 is not None
    return t.p99


def start_lines(starts: Sequence[Start]) -> list[str]:
    """Compares the seconds and the megabytes of our first answers with their targets."""
    return [
        f"first answer, {start.subject}: {start.name} {what} {_at_most(value, most)}"
        for start in starts
        if start.name.startswith(OURS)
        for what, value, most in (
            ("s", start.seconds, START_SECONDS), ("MB", start.resident / 2**20, START_MEGABYTES),
        )
    ]  # fmt: skip


def _at_least(value: float, target: float) -> str:
    return f"{value:.2f} (target {target:.2f}){' MISSED' * (value < target)}"


def _at_most(value: float, target: float) -> str:
    return f"{value:.2f} (target {target:.2f}){' MISSED' * (value > target)}"
