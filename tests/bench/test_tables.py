import pytest

from darswin.bench import plot, tables, targets
from darswin.bench.memory import Memory
from darswin.bench.record import Record, write
from darswin.bench.timing import COMPILED, MATMULS, OURS, REFERENCE, Timing


def timing(name, milliseconds, ratio=1.0, target=None, *, mode="inference", batch=8, threads=2):
    seconds = 1e-3 * milliseconds
    case = ("darswin_a_small", "64×64", batch, threads, f"{mode}, float32")
    return Timing(*case, name, seconds, 1e-3, ratio, target, 10, 2 * seconds)


@pytest.fixture
def record():
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
    return Record(dict(tier="avx512"), timings, memory, operations=4_500_000_000)


def test_models(record):
    lines = tables.models_table(record.timings).splitlines()
    assert len(lines) == 2 + 3
    assert (
        "| inference, float32, batch 8 | 40 / 80 |  | 2.50× / 3.00× | 2.10× | 90% |  |  |"
    ) in lines
    (latency,) = (line for line in lines if "batch 1 " in line)
    assert latency.endswith("| 20.0 | 40.0 |")
    assert tables.memory_table(record.memory).splitlines()[2:] == [
        "| training, float32, batch 8, in all | 400 | 500 | 0.80 |",
        "| training, float32, batch 8, of the batch itself | 200 | 300 | 0.67 |",
    ]
    assert tables.roofline_lines(record) == [
        "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads: matrix products alone "
        "400 GFLOP/s, the model 360 (90%)"
    ]


def test_autotune():
    row = dict(product="forward", rows=512, in_features=384, out_features=96, threads=2)
    assert tables.autotune_lines([row | dict(seconds=dict(onednn=0.002, torch=0.005))]) == [
        "forward, 512 rows, 384 → 96, 2 threads: onednn 2.00 ms; torch 2.50×"
    ]


def operator(name, threads, milliseconds, ratio=1.0, target=None, subject="polar_sample"):
    case = (subject, "64×64", 8, threads, "forward")
    return Timing(*case, name, 1e-3 * milliseconds, 0.0, ratio, target)


OPERATORS = [
    operator(OURS, 1, 2.0),
    operator("slow", 1, 10.0, 5.0, 4.0),
    operator("fast", 1, 3.0, 1.5, 2.0),
    operator(f"{OURS} (avx2)", 1, 5.0, 2.5),
    operator(OURS, 2, 1.0),
    operator("slow", 2, 6.0, 6.0),
    operator(OURS, 1, 1.0, subject="another"),
    operator("peer", 1, 1.0, subject="another"),
]


def test_peers():
    assert tables.peers_table(OPERATORS, "polar_sample").splitlines() == [
        "| `polar_sample` | ours (ms) | slow | fast | darswin (avx2) |",
        "|---|---|---|---|---|",
        "| 64×64, batch 8, forward | 2.00 / 1.00 | 5.0× / 6.0× | 1.5× | 2.5× |",
    ]
    assert tables.peers_table(OPERATORS, "polar_sample", ["fast"]).count("\n") == 2
    assert tables.peers_table(OPERATORS, "polar_sample", ["peer"]).count("\n") == 1


def test_targets(record):
    assert targets.lines(record.timings) == [
        "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads: compiled reference "
        "2.10 (target 2.20) MISSED",
        "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads: matrix products alone "
        "0.90 (target 0.80)",
    ]
    assert targets.lines(OPERATORS, avx2_share=0.5) == [
        "polar_sample, 64×64, batch 8, forward, 1 thread: slow 5.00 (target 4.00); "
        "avx2 2.00 (target 2.00)",
        "polar_sample, 64×64, batch 8, forward, 1 thread: fast 1.50 (target 2.00) MISSED; "
        "avx2 0.60 (target 1.00) MISSED",
    ]
    assert tables.missed_table(OPERATORS).splitlines()[2:] == [
        "| polar_sample, 64×64, batch 8, forward, 1 thread: fast | 1.50 | 2.00 |"
    ]
    assert targets.memory_lines(record.memory) == [
        "peak memory, training, float32, batch 8, in all: 0.80 (target 0.80)",
        "peak memory, training, float32, batch 8, of the batch itself: 0.67 (target 0.80)",
    ]


def test_files(record, tmp_path, capsys):
    record.publish(tmp_path / "new", "model", plot.draw_models)
    path = tmp_path / "new" / "model--avx512.json"
    assert Record.load(path) == record
    picture = path.with_suffix(".png")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.split() == [str(path), str(picture)]
    operators = Record(dict(tier="avx2"), OPERATORS)
    operators.publish(tmp_path, "operators", plot.draw_peers)
    assert Record.load(tmp_path / "operators--avx2.json") == operators
    assert (tmp_path / "operators--avx2.png").exists()


def test_a_plot_needs_matplotlib(record, tmp_path, capsys):
    def draw(record, path):
        raise ImportError("No module named 'matplotlib'")

    record.publish(tmp_path, "model", draw)
    assert (tmp_path / "model--avx512.json").exists()
    assert "no plot: No module named 'matplotlib'" in capsys.readouterr().err


def test_a_record_has_a_line_for_each_row(tmp_path):
    path = tmp_path / "record.json"
    write(path, size=3, parts=dict(a=[1, 2], b=None), cells=[dict(x=0.1), dict(x=1e-9)])
    assert path.read_text().splitlines() == [
        "{", ' "size": 3,', ' "parts": {', '  "a": [1, 2],', '  "b": null', " },", ' "cells": [',
        '  {"x": 0.1},', '  {"x": 1e-09}', " ]", "}",
    ]  # fmt: skip
