import pytest

from darswin.bench import timing
from darswin.bench.timing import in_turns, summary


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
    turns = in_turns({"slow": taking(0.03), "fast": taking(0.001)}, 0.5, least=5)
    assert [len(turn) for turn in turns["slow"]] == [7] * 2
    assert [len(turn) for turn in turns["fast"]] == [200] * 2
    assert turns["slow"][1] == pytest.approx([0.03] * 7)
    assert len(in_turns({"slow": taking(0.03)}, 0.0, least=9)["slow"]) == 2


def test_candidates_take_turns(taking):
    order = []
    candidates = {name: taking(0.15, lambda name=name: order.append(name)) for name in "ab"}
    in_turns(candidates, 0.0, least=3)
    assert order == ["a", "b"] * 4  # the first time for their lengths


def test_summary():
    case = ("inference", "float32", 1, 2)
    ours = [[1.0] * 100, [2.0] * 100, [4.0]]
    turns = [[float(n) for n in range(200, 100, -1)], [float(n) for n in range(100, 0, -1)], [88.0]]
    found = summary(case, "reference", turns, ours)
    assert found.case == case and found.runs == 201
    assert (found.median, found.p99) == (100.0, 198.0)
    assert found.iqr == 99.0
    assert found.ratio == 25.25  # of 150.5, 25.25 and 22
