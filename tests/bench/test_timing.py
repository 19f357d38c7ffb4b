import time

from darswin.bench.timing import in_turns, summary


def test_each_candidate_runs_long_enough():
    seconds = in_turns(
        {"slow": lambda: time.sleep(0.03), "fast": lambda: time.sleep(0.001)}, 0.1, least=5
    )
    assert 5 <= len(seconds["slow"]) <= 14 < len(seconds["fast"])
    assert all(t >= 0.03 for t in seconds["slow"])
    assert len(in_turns({"slow": lambda: time.sleep(0.03)}, 0.0, least=7)["slow"]) >= 7


def test_candidates_take_turns():
    order = []

    def candidate(name):
        def run():
            order.append(name)
            time.sleep(0.15)

        return run

    in_turns({"a": candidate("a"), "b": candidate("b")}, 0.0, least=3)
    assert order == ["a", "b"] * 3


def test_summary():
    case = ("inference", "float32", 1, 2)
    timing = summary(case, "darswin", [float(n) for n in range(200, 0, -1)])
    assert timing.case == case and timing.runs == 200
    assert (timing.median, timing.p99) == (100.5, 199.0)
    assert timing.iqr == 99.5
