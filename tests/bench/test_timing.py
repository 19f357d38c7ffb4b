import pytest

from darswin.bench import timing
from darswin.bench.timing import OURS, Case, in_turns, measure, summary


@pytest.fixture
def taking(monkeypatch):
    """Makes candidates that take so many seconds, by a clock of the test's own."""
    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])

    def candidate(seconds, called=lambda: None):
        def run():
            called()
            now[0] += seconds

        return run

    return candidate


def test_each_candidate_runs_long_enough(taking):
    turns = in_turns({"slow": taking(0.03), "fast": taking(0.001)}, 2.0, least=5)
    assert [len(turn) for turn in turns["slow"]] == [7] * 10
    assert [len(turn) for turn in turns["fast"]] == [200] * 10
    assert turns["slow"][1] == pytest.approx([0.03] * 7)
    assert len(in_turns({"slow": taking(0.03)}, 0.01, least=9)["slow"]) == 9


def test_short_timings_have_seven_turns_too(taking):
    turns = in_turns({"slow": taking(0.1), "fast": taking(0.001)}, 0.07)
    assert [len(turn) for turn in turns["slow"]] == [1] * 7
    assert [len(turn) for turn in turns["fast"]] == [10] * 7


def test_candidates_take_turns(taking):
    order = []
    candidates = {name: taking(0.15, lambda name=name: order.append(name)) for name in "ab"}
    in_turns(candidates, 0.0, least=3)
    assert order == ["a", "b"] * 4  # the first time for their lengths


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
    found = summary(case, "reference", {OURS: ours, "reference": turns})
    assert found.label == case.label and found.runs == 201
    assert (found.median, found.p99) == (100.0, 198.0)
    assert found.iqr == 99.0
    assert found.ratio == 25.25  # of 150.5, 25.25 and 22
