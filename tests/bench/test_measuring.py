"""What is timed, how candidates take turns, and what is measured in processes of their own."""

import itertools
import sys

import model
import peers
import pytest
import torch
from helpers import refused
from kit import candidates, memory, start, tables, timing
from kit.record import Record
from kit.start import Start
from kit.timing import (
    DEFAULT,
    FIXED_LENS,
    MATMULS,
    OURS,
    OURS_FLOAT32,
    PACE,
    REFERENCE,
    Case,
    Turn,
    in_turns,
    measure,
    measure_paced,
)  # fmt: skip

from darswin.cli.arguments import run_command
from darswin.ops import _module, cpu_capability

MB = 2**20
CASE = Case("model", "64×64", 1, 2, "inference, float32")

# -- turns, by a clock of the test's own --------------------------------------------------------


@pytest.fixture
def now(monkeypatch):
    """The time. The process is busy for a fifth of it."""
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


def test_each_candidate_runs_long_enough_and_in_turns(taking):
    turns = in_turns({"slow": taking(0.03), "fast": taking(0.001)}, 2.0, least=5)
    assert [len(turn.seconds) for turn in turns["slow"]] == [7] * 10
    assert [len(turn.seconds) for turn in turns["fast"]] == [200] * 10
    assert turns["slow"][1].seconds == pytest.approx([0.03] * 7)
    assert turns["slow"][1].cpu == pytest.approx(0.006)
    # Short timings have seven turns too.
    turns = in_turns({"slow": taking(0.1), "fast": taking(0.001)}, 0.07)
    assert [len(turn.seconds) for turn in turns["fast"]] == [10] * 7
    order = []
    runs = {name: taking(0.15, lambda name=name: order.append(name)) for name in "ab"}
    in_turns(runs, 0.0, least=3)
    assert order == ["a", "b"] * 4  # the first time for their lengths
    ours, reference = measure(
        CASE, {OURS: taking(0.02), "reference": taking(0.05)}, 0.1, targets=dict(reference=3.0)
    )
    assert (ours.name, ours.ratio, ours.target, ours.missed) == (OURS, 1, None, False)
    assert reference.ratio == pytest.approx(2.5) and reference.missed


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


def test_all_numbers_of_threads_take_the_same_turns(taking):
    order = []

    def candidate(name, seconds):
        return lambda threads: taking(
            seconds / (threads or 4), lambda: order.append((name, threads))
        )

    runs = {OURS: candidate(OURS, 0.02), "peer": candidate("peer", 0.01)}
    turn = [(name, threads) for threads in (1, 2, DEFAULT) for name in runs]
    found = measure_paced(CASE, runs, 7 * PACE, targets=dict(peer=1.5))
    assert [(t.name, t.threads) for t in found] == turn
    assert all(t.paced for t in found) and not CASE.paced
    assert [t.median for t in found] == pytest.approx([0.02, 0.01, 0.01, 0.005, 0.005, 0.0025])
    assert [t.ratio for t in found] == pytest.approx([1, 0.5] * 3)
    assert [t.target for t in found] == [None, 1.5] + [None] * 4  # on one thread
    assert order[:6] == turn and order[6:] == [key for key in turn for _ in range(2)] * 7


def test_summary():
    ours = [[1.0] * 100, [2.0] * 100, [4.0]]
    turns = [[float(n) for n in range(200, 100, -1)], [float(n) for n in range(100, 0, -1)], [88.0]]
    both = {
        name: [Turn(*turn) for turn in zip(of, [3.0, 50.0, 4.0], strict=True)]
        for name, of in ((OURS, ours), ("reference", turns))
    }
    found = timing.summary(CASE, "reference", both)
    assert found.label == CASE.label and found.runs == 201
    assert (found.median, found.p99, found.iqr, found.cpu) == (100.0, 198.0, 99.0, 4.0)
    assert found.ratio == 25.25  # of 150.5, 25.25 and 22


# -- candidates ---------------------------------------------------------------------------------


def double(x, y):
    return 2 * x + y


def compare(peer, mode="forward", **options):
    case = Case("double", "of four", 4, torch.get_num_threads(), mode)
    inputs = [torch.randn(4), torch.randn(4)]
    return peers.compare(case, {OURS: double, "peer": peer}, inputs, 1e-4, **options)


def test_ours_is_timed_on_every_tier():
    best = cpu_capability()
    found = compare(double, "forward+backward, all", targets=dict(peer=3.0))
    others = [f"{OURS} ({tier})" for tier in _module.tiers() if tier != best]
    assert [t.name for t in found] == [OURS, "peer", *others] and cpu_capability() == best
    assert [t.target for t in found[:2]] == [None, 3.0]


def test_candidates_that_disagree_are_not_timed():
    def no_gradient(x, y):
        return double(x, y.detach()) + 0 * y

    for peer, mode in ((lambda x, y: 2.01 * x + y, "forward"), (no_gradient, "forward+backward")):
        with pytest.raises(AssertionError, match="peer disagrees with ours in double, of four"):
            compare(peer, mode)
        compare(peer, mode, tolerance=None)
    compare(no_gradient)
    compare(lambda x, y: double(x, y)[None], view=lambda result: result.reshape(4))
    runs = {OURS: lambda: torch.ones(3), REFERENCE: lambda: torch.ones(3) + 1e-3}
    model._check(runs | {MATMULS: lambda: torch.zeros(1)}, 1e-2)
    refused("darswin differs from the reference", model._check, runs, 1e-4, error=RuntimeError)


def test_a_suite_prints_and_writes_what_it_found(tmp_path, capsys, camera, monkeypatch):
    monkeypatch.setattr(peers, "THREADS", [1, 2])
    before, starts = torch.get_num_threads(), [Start("nano", OURS, 0.2, 2**25)]
    jobs = [lambda: compare(double, targets=dict(peer=1e6))]
    options = dict(paced=[lambda: camera], starts=[lambda: starts])
    found = peers.run_suite("suite", jobs, 1.0, tmp_path, **options)
    assert [t for t in found if t in camera] == camera and torch.get_num_threads() == before
    assert [t.threads for t in found if t not in camera and t.name == "peer"] == [1, 2]
    (path,) = tmp_path.glob("suite--*.json")
    assert Record.load(path).timings == found and Record.load(path).starts == starts
    printed = capsys.readouterr().out
    assert "| `double` | ours (ms) | peer |" in printed and "0.20 s, 32 MB" in printed


@pytest.mark.slow
def test_the_benchmark_of_models(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(model, "THREADS", [1])
    monkeypatch.setattr(
        memory, "measure", lambda mode, *rest: memory.Memory(mode, 2, rest[4], 1, 2, 3)
    )
    options = "--model darswin_a_nano --size 32 --batches 1 2 --seconds 0.01 --out"
    run_command(model.bench, [*options.split(), str(tmp_path)], "model.py")
    (path,) = tmp_path.glob("model--*.json")
    record, names = Record.load(path), {}
    for t in record.timings:
        assert (t.subject, t.setting, t.threads, t.target) == ("darswin_a_nano", "32×32", 1, None)
        names.setdefault((t.mode, t.batch), set()).add(t.name)
    assert len(names) == 2 * 4  # batches, and modes with their numbers
    for (mode, _), found in names.items():
        fixed = {FIXED_LENS} if mode.startswith("inference") else set()
        assert found >= {OURS, REFERENCE, MATMULS} | fixed, mode
    assert OURS_FLOAT32 in names["inference, int8", 1]
    assert tables.models_table(record.timings) in capsys.readouterr().out
    refused("`batches` must be from 1 to 65536, got -1", model.bench, batches=[-1], out=tmp_path)


def test_the_fastest_has_the_shortest_call_but_the_first_of_each(monkeypatch):
    # Seconds: 1 and 0, 3 and 4, 2 and 7.
    times = iter([0, 1, 1, 1, 1, 4, 4, 8, 8, 10, 10, 17])
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(times))
    calls = []
    runs = dict(a=lambda: calls.append("a"), b=lambda: calls.append("b"))
    assert timing.fastest(runs, turns=3) == "a"
    assert calls == ["a", "b"] * 3


def test_the_matrix_products_are_all_of_the_model():
    net, lens = candidates.network("darswin_a_nano", 32).eval(), candidates.lens_of(32)
    products = candidates.matmuls_of(net, torch.randn(2, 3, 32, 32), lens)
    layers = [m for m in net.modules() if isinstance(m, torch.nn.Linear)]
    sizes = sorted((m.in_features, m.out_features) for m in layers)
    assert sorted((x.shape[-1], product(x).shape[-1]) for product, x in products) == sizes
    # Tokens of the embedding, of three stages' blocks with twelve squares of their width each.
    tokens, widths, depths = (256, 64, 16), (24, 48, 96), (1, 2, 1)
    expected = 256 * 4 * 4 * 3 * 24 + 96 * 200
    expected += sum(12 * t * w * w * d for t, w, d in zip(tokens, widths, depths, strict=True))
    expected += sum(t * 4 * w * 2 * w for t, w in ((64, 24), (16, 48)))
    assert candidates.operations_of("darswin_a_nano", 32) == 2 * expected


# -- processes ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(not memory.available(), reason="this system does not tell a process its peak")
def test_a_training_step_tells_its_peak():
    found = memory.measure("training", "darswin_a_nano", 32, "float32", 64, OURS, 1)
    assert 100 * MB < found.before < found.between < found.peak
    # Activations of 64 images, most of all those of the first map: 16 of 256 × 24 floats a block.
    assert 64 * 256 * 24 * 4 * 8 < found.own < found.whole < 1000 * MB


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the memory in /proc")
def test_a_program_tells_its_time_and_memory():
    small, large = (
        start.measure("nothing", "python", code, processes=1)
        for code in ("import time; time.sleep(0.05)", "block = bytearray(range(250)) * 400_000")
    )
    assert small.seconds >= 0.05 and 90e6 < large.resident - small.resident < 110e6
    with pytest.raises(
        RuntimeError, match=r"start of a runtime cannot be measured(.|\n)*no_module"
    ):
        start.measure("model", "a runtime", "import no_module")
