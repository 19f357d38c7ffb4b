"""Records that the tests of the kit share."""

import pytest
from kit.memory import Memory
from kit.record import Record
from kit.timing import COMPILED, MATMULS, OURS, REFERENCE, Timing


def timing(name, milliseconds, ratio=1.0, target=None, *, mode="inference", batch=8, threads=2):
    seconds = 1e-3 * milliseconds
    case = ("darswin_a_small", "64×64", batch, threads, f"{mode}, float32")
    return Timing(*case, name, seconds, 1e-3, ratio, target, 10, 2 * seconds)


@pytest.fixture
def record() -> Record:
    """Of a model."""
    timings = [
        *(timing(OURS, t, threads=n) for n, t in ((1, 200.0), (2, 100.0))),
        *(timing(REFERENCE, t, r, threads=n) for n, t, r in ((1, 480.0, 2.5), (2, 310.0, 3.0))),
        timing(COMPILED, 200.0, 2.1, 2.2),
        timing(MATMULS, 90.0, 0.9, 0.8),
        timing(OURS, 20.0, batch=1),
        timing(OURS, 300.0, mode="training"),
    ]
    memory = [
        Memory("training, float32", 8, OURS, 100 * 2**20, 300 * 2**20, 500 * 2**20),
        Memory("training, float32", 8, REFERENCE, 100 * 2**20, 300 * 2**20, 600 * 2**20),
    ]
    return Record(
        dict(cpu="AMD EPYC (family 25, model 17)", tier="avx512"),
        timings,
        memory,
        operations=4_500_000_000,
    )


def paced(name, threads, p50, p99, *, ratio=1.0, target=None, frame="float32, fixed lens"):
    case = ("darswin_a_nano", "64×64", 1, threads, f"paced, {frame}")
    seconds = (1e-3 * p50, 0.0, ratio, target, 100, 1e-3 * p99, 2e-3 * p50)
    return Timing(*case, name, *seconds)


@pytest.fixture
def camera() -> list[Timing]:
    """Single frames, in a loop and at the pace of a camera."""
    loop = [
        timing(OURS, 0.4, mode="forward", batch=1),
        timing("peer", 0.5, mode="forward", batch=1),
    ]
    for t in loop:
        t.mode = "forward, float32, fixed lens"
    return [
        *loop,
        *(
            paced(OURS, n, p50, p99)
            for n, p50, p99 in ((1, 1.0, 1.4), (2, 0.9, 2.0), (0, 1.5, 1.3))
        ),
        *(paced("peer", n, 2.0, 2500.0, ratio=2.0) for n in (1, 2, 0)),
        paced(OURS, 1, 3.0, 4.0, frame="float32, from an uint8 frame"),
    ]


def operator(name, threads, milliseconds, ratio=1.0, target=None, subject="polar_sample"):
    case = (subject, "64×64", 8, threads, "forward")
    return Timing(*case, name, 1e-3 * milliseconds, 0.0, ratio, target)


@pytest.fixture
def operators() -> list[Timing]:
    """Two operators and their peers."""
    return [
        operator(OURS, 1, 2.0),
        operator("slow", 1, 10.0, 5.0, 4.0),
        operator("fast", 1, 3.0, 1.5, 2.0),
        operator(f"{OURS} (avx2)", 1, 5.0, 2.5),
        operator(OURS, 2, 1.0),
        operator("slow", 2, 6.0, 6.0),
        operator(OURS, 1, 1.0, subject="another"),
        operator("peer", 1, 1.0, subject="another"),
    ]
