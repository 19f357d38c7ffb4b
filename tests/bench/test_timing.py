import itertools

import pytest
from kit import timing
from kit.timing import DEFAULT, OURS, PACE, Case, Turn, in_turns, measure, measure_paced


@pytest.fixture
def now(monkeypatch):
    """A clock of the test's own. The process is busy for a fifth of all time."""
    now = [0.0]

    def sleep(seconds):
        assert seconds >= 0
        now[0] += seconds

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(timing.time, "process_time", lambda: now[0] / 5)
    monkeypatch.setattr(timing.time, "sleep", sleep)
    return now


@pytest.fixture
def taking(now):
    """Makes candidates that take so many seconds."""

    def candidate(seconds, called=lambda: None):
        def run():
            called()
            now[0] += seconds

        return run

    return candidate


def test_each_candidate_runs_long_enough(taking):
    turns = in_turns({"slow": taking(0.03), "fast": taking(0.001)}, 2.0, least=5)
    assert [len(turn.seconds) for turn in turns["slow"]] == [7] * 10
    assert [len(turn.seconds) for turn in turns["fast"]] == [200] * 10
    assert turns["slow"][1].seconds == pytest.approx([0.03] * 7)
    assert turns["slow"][1].cpu == pytest.approx(0.006)
    assert len(in_turns({"slow": taking(0.03)}, 0.01, least=9)["slow"]) == 9
    # Short timings have seven turns too.
    turns = in_turns({"slow": taking(0.1), "fast": taking(0.001)}, 0.07)
    assert [len(turn.seconds) for turn in turns["slow"]] == [1] * 7
    assert [len(turn.seconds) for turn in turns["fast"]] == [10] * 7


def test_candidates_take_turns(taking):
    order = []
    candidates = {name: taking(0.15, lambda name=name: order.append(name)) for name in "ab"}
    in_turns(candidates, 0.0, least=3)
    assert order == ["a", "b"] * 4  # the first time for their lengths


def test_a_frame_begins_when_the_camera_delivers_it(now, taking):
    """Who takes longer than the time between two frames misses some, and the first frame of a turn
    does not count, nor does its CPU time."""
    starts, woken = [], []

    def sleepy():
        starts.append(now[0])
        awake = len(starts) > 1 and starts[-1] - starts[-2] < 1.5 * PACE
        woken.append(not awake)
        now[0] += 0.001 if awake else 0.020

    turns = in_turns({"sleepy": sleepy, "slow": taking(1.2 * PACE)}, 1.4, pace=PACE)
    assert [len(turn.seconds) for turn in turns["sleepy"]] == [6] * 7
    assert [len(turn.seconds) for turn in turns["slow"]] == [3] * 7
    for turn in turns["sleepy"]:
        assert turn.seconds == pytest.approx([0.001] * 6)
        assert turn.cpu == pytest.approx(PACE / 5)  # that of the wait too
    assert turns["slow"][0].cpu == pytest.approx(2 * PACE / 5)
    assert sum(woken) == 1 + 7  # the first time for its length
    steps = [b - a for a, b in itertools.pairwise(starts[1:8])]
    assert steps == pytest.approx([PACE] * 6)


def test_threads_that_still_look_for_work_are_waited_for(now, monkeypatch):
    """Their CPU time is that of their own candidate, and they take no core from the next one."""
    busy, until = [0.0], [0.0]

    def sleep(seconds):
        busy[0] += max(0.0, min(until[0], now[0] + seconds) - now[0])
        now[0] += seconds

    def run(spins):
        now[0] += 0.001
        busy[0] += 0.001
        until[0] = max(until[0], now[0] + spins)

    monkeypatch.setattr(timing.time, "process_time", lambda: busy[0])
    monkeypatch.setattr(timing.time, "sleep", sleep)
    turns = in_turns({"a": lambda: run(0.0), "b": lambda: run(5.3 * PACE)}, 0.5, pace=PACE)
    assert {round(turn.cpu, 9) for turn in turns["a"]} == {0.001}
    assert {round(turn.cpu, 9) for turn in turns["b"]} == {round(PACE, 9)}
    start = now[0]
    in_turns({"a": lambda: run(1e9)}, PACE, least=1, pace=PACE)  # it never stops
    assert now[0] - start < 50 * PACE


def test_all_numbers_of_threads_take_the_same_turns(taking):
    order = []

    def candidate(name, seconds):
        return lambda threads: taking(
            seconds / (threads or 4), lambda: order.append((name, threads))
        )

    runs = {OURS: candidate(OURS, 0.02), "peer": candidate("peer", 0.01)}
    case = Case("model", "64×64", 1, DEFAULT, "float32")
    found = measure_paced(case, runs, 7 * PACE, targets=dict(peer=1.5))
    assert [(t.name, t.threads) for t in found] == [
        (name, threads) for threads in (1, 2, DEFAULT) for name in (OURS, "peer")
    ]
    assert all(t.paced and t.mode == "paced, float32" for t in found) and not case.paced
    assert [t.median for t in found] == pytest.approx([0.02, 0.01, 0.01, 0.005, 0.005, 0.0025])
    assert [t.ratio for t in found] == pytest.approx([1, 0.5] * 3)
    assert [t.target for t in found] == [None, 1.5] + [None] * 4  # on one thread
    labels = [t.label.rpartition(", ")[2] for t in found[::2]]
    assert labels == ["1 thread", "2 threads", "default threads"]
    turn = [(name, threads) for threads in (1, 2, DEFAULT) for name in (OURS, "peer")]
    assert order[:6] == turn and order[6:] == [key for key in turn for _ in range(2)] * 7


def test_measurement(taking):
    case = Case("model", "64×64", 1, 2, "inference, float32")
    runs = {OURS: taking(0.02), "reference": taking(0.05)}
    ours, reference = measure(case, runs, 0.1, targets=dict(reference=3.0))
    assert (ours.name, ours.ratio, ours.target, ours.missed) == (OURS, 1, None, False)
    assert reference.ratio == pytest.approx(2.5) and reference.missed


def test_summary():
    case = Case("model", "64×64", 1, 2, "inference, float32")
    ours = [[1.0] * 100, [2.0] * 100, [4.0]]
    turns = [[float(n) for n in range(200, 100, -1)], [float(n) for n in range(100, 0, -1)], [88.0]]
    cpu = [3.0, 50.0, 4.0]
    both = {OURS: ours, "reference": turns}
    both = {name: [Turn(*turn) for turn in zip(of, cpu, strict=True)] for name, of in both.items()}
    found = timing.summary(case, "reference", both)
    assert found.label == case.label and found.runs == 201
    assert (found.median, found.p99) == (100.0, 198.0)
    assert found.iqr == 99.0 and found.cpu == 4.0
    assert found.ratio == 25.25  # of 150.5, 25.25 and 22
