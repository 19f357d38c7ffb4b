import peers
import pytest
import torch
from kit.record import Record
from kit.start import Start
from kit.timing import OURS, Case

from darswin.ops import _module, cpu_capability


def case(mode="forward"):
    return Case("double", "of four", 4, torch.get_num_threads(), mode)


def double(x, y):
    return 2 * x + y


INPUTS = [torch.randn(4), torch.randn(4)]


@pytest.mark.parametrize("mode", ["forward", "forward+backward, all"])
def test_ours_is_timed_on_every_tier(mode):
    seen, best = set(), cpu_capability()

    def ours(x, y):
        seen.add(cpu_capability())
        return double(x, y)

    found = peers.compare(
        case(mode), {OURS: ours, "peer": double}, INPUTS, 1e-4, targets=dict(peer=3.0)
    )
    others = [f"{OURS} ({tier})" for tier in _module.tiers() if tier != best]
    assert [t.name for t in found] == [OURS, "peer", *others]
    assert [t.target for t in found[:2]] == [None, 3.0]
    assert seen == set(_module.tiers()) and cpu_capability() == best


@pytest.mark.parametrize("mode", ["forward", "forward+backward"])
def test_candidates_that_disagree_are_not_timed(mode):
    def compare(peer, **options):
        return peers.compare(case(mode), {OURS: double, "peer": peer}, INPUTS, 1e-4, **options)

    def wrong(x, y):
        return 2.01 * x + y

    with pytest.raises(AssertionError, match="peer disagrees with ours in double, of four"):
        compare(wrong)
    compare(wrong, tolerance=0.1)
    compare(wrong, tolerance=None)
    compare(lambda x, y: double(x, y)[None], view=lambda result: result.reshape(4))


def test_a_wrong_gradient_is_a_disagreement():
    runs = {OURS: double, "peer": lambda x, y: double(x, y.detach()) + 0 * y}
    peers.compare(case(), runs, INPUTS, 1e-4)
    with pytest.raises(AssertionError, match="disagrees"):
        peers.compare(case("forward+backward"), runs, INPUTS, 1e-4)


def test_a_candidate_gets_its_threads_before_the_first_frame():
    seen, before = [], torch.get_num_threads()
    on = peers.on_torch_threads(lambda: seen.append(torch.get_num_threads()))
    try:
        for threads in (2, 1, 2, 0):
            on(threads)()
    finally:
        torch.set_num_threads(before)
    assert seen == [2, 1, 2, max(peers.THREADS)]


def test_a_suite_prints_and_writes_what_it_found(tmp_path, capsys, camera, monkeypatch):
    monkeypatch.setattr(peers, "THREADS", [1, 2])
    before, starts = torch.get_num_threads(), [Start("nano", OURS, 0.2, 2**25)]

    def job():
        runs = {OURS: double, "peer": double}
        return peers.compare(case(), runs, INPUTS, 1e-4, targets=dict(peer=1e6))

    def paced():
        assert torch.get_num_threads() == 2
        torch.set_num_threads(1)
        return camera

    options = dict(paced=[paced], starts=[lambda: starts])
    found = peers.run_suite("suite", [job, job], 1.0, tmp_path, **options)
    assert [t for t in found if t.paced or t in camera] == camera
    ours = [t.threads for t in found if t not in camera and t.name == "peer"]
    assert ours == [1, 2] * 2 and torch.get_num_threads() == before
    (path,) = tmp_path.glob("suite--*.json")
    assert Record.load(path).timings == found and Record.load(path).starts == starts
    printed = capsys.readouterr().out
    assert "| `double` | ours (ms) | peer |" in printed and printed.count("MISSED") >= 4
    assert "p50 / p99 / CPU time, ms" in printed and "0.20 s, 32 MB" in printed
    assert printed.count("p50 over p99") == 4 and "MB 32.00 (target 60.00)" in printed
