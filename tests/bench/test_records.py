"""Records of benchmarks, and the targets and pictures that are made of them. Most of their tables
are held by those of the pages: see docs/test_claims.py."""

import json
from pathlib import Path

import peers
import pytest
from figures import on_a_phone
from kit import plot, tables, targets
from kit.record import Record, write
from kit.start import Start
from kit.tables import BOTH
from kit.timing import OURS, REFERENCE

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
STARTS = [Start("nano", "darswin", 0.31, 50 * 2**20), Start("nano", "peer", 9.0, 2**30)]


def test_a_record_and_its_plot(record, tmp_path, capsys):
    record.publish(tmp_path, "model", lambda _, path: path.write_text("a picture"))
    path = tmp_path / "model--amd-epyc-25-17-avx512.json"
    assert Record.load(path) == record
    assert capsys.readouterr().out.splitlines() == [str(path), str(path.with_suffix(".png"))]
    write(path, size=3, parts=dict(a=[1, 2], b=None), cells=[dict(x=0.1), dict(x=1e-9)])
    assert path.read_text().splitlines() == [
        "{", ' "size": 3,', ' "parts": {', '  "a": [1, 2],', '  "b": null', " },", ' "cells": [',
        '  {"x": 0.1},', '  {"x": 1e-09}', " ]", "}",
    ]  # fmt: skip


def test_records_of_frames_and_those_from_before_them_are_read(record, camera, tmp_path):
    path, frames = tmp_path / "record.json", Record(record.machine, camera, starts=STARTS)
    frames.save(path)
    assert Record.load(path) == frames
    content = json.loads(path.read_text())
    del content["starts"]
    for row in content["timings"]:
        row.pop("cpu", None)
    path.write_text(json.dumps(content))
    old = Record.load(path)
    assert old.starts == [] and {t.cpu for t in old.timings} == {None}
    assert [t.median for t in old.timings] == [t.median for t in camera]


def rows(table: str) -> list[str]:
    return table.splitlines()[2:]


def test_tables_and_targets_of_a_model(record):
    case = "darswin_a_small, 64×64, batch 8, inference, float32, 2 threads"
    throughput, *others = rows(tables.models_table(record.timings))
    assert throughput == (
        f"| inference, float32, batch 8 | 40{BOTH}80 |  | 2.50×{BOTH}3.00× | 2.10× | 90% |  |  |"
    )
    (latency,) = (line for line in others if "batch 1 " in line)
    assert latency.endswith("| 20.0 | 40.0 |")
    assert rows(tables.memory_table(record.memory)) == [
        "| training, float32, batch 8, in all | 400 | 500 | 0.80 |",
        "| training, float32, batch 8, of the batch itself | 200 | 300 | 0.67 |",
    ]
    assert tables.roofline_lines(record) == [
        f"{case}: matrix products alone 400 GFLOP/s, the model 360 (90%)"
    ]
    assert targets.lines(record.timings) == [
        f"{case}: compiled reference 2.10 (target 2.20) MISSED",
        f"{case}: matrix products alone 0.90 (target 0.80)",
    ]
    assert targets.memory_lines(record.memory) == [
        "peak memory, training, float32, batch 8, in all: 0.80 (target 0.80)",
        "peak memory, training, float32, batch 8, of the batch itself: 0.67 (target 0.80)",
    ]


def test_table_of_training():
    test = dict(images_per_second=300.0, outside=0.5)
    train = dict(images_per_second=80.0, outside=0.25, bare_images_per_second=100.0)
    modes = {OURS: train, REFERENCE: train | dict(images_per_second=40.0)}
    found = peers.training_table({"nano": dict(train=modes, test={OURS: test, REFERENCE: test})})
    assert found.splitlines()[-1] == "| `nano` | 80 | 2.00× | 25.0% | 0.80 | 300 | 1.00× |"


def test_targets_of_operators_and_frames(operators, camera):
    case = "polar_sample, 64×64, batch 8, forward"
    assert targets.lines(operators, avx2_share=0.5) == [
        f"{case}, 1 thread: slow 5.00 (target 4.00); avx2 2.00 (target 2.00)",
        f"{case}, 1 thread: fast 1.50 (target 2.00) MISSED; avx2 0.60 (target 1.00) MISSED",
    ]
    frame = "darswin_a_nano, 64×64, batch 1, paced, float32, "
    assert targets.paced_lines(camera) == [
        f"{frame}fixed lens, 1 thread: p50 over p99 0.71 (target 0.67)",
        f"{frame}fixed lens, 2 threads: p50 over p99 0.45 (target 0.67) MISSED",
        f"{frame}fixed lens, 2 threads: p50 on one thread 1.11 (target 0.95)",
        f"{frame}fixed lens, 2 threads: p99 on one thread 0.70 (target 0.95) MISSED",
        f"{frame}fixed lens, default threads: p50 over p99 1.15 (target 0.67)",
        f"{frame}fixed lens, default threads: p50 on one thread 0.67 (target 0.95) MISSED",
        f"{frame}fixed lens, default threads: p99 on one thread 1.08 (target 0.95)",
        f"{frame}from an uint8 frame, 1 thread: p50 over p99 0.75 (target 0.67)",
    ]
    assert targets.start_lines(STARTS) == [
        "first answer, nano: darswin s 0.31 (target 0.30) MISSED",
        "first answer, nano: darswin MB 50.00 (target 60.00)",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("picture", sorted(RESULTS.glob("*.png")), ids=lambda path: path.stem)
def test_the_pictures_of_the_records_can_be_read(picture, monkeypatch):
    """The text is large enough, the page is not endless, and the text lies inside."""
    figures = []
    monkeypatch.setattr("darswin.viz.plot.save_figure", lambda figure, path: figures.append(figure))
    draw = plot.draw_models if picture.stem.startswith("model") else peers.draw_peers
    draw(Record.load(picture.with_suffix(".json")), picture)
    (figure,) = figures
    width, height = figure.get_size_inches()
    assert on_a_phone(figure) >= 9 and height <= 2.5 * width
    names = [name for axes in figure.axes for name in (axes.title, *axes.get_yticklabels())]
    for part in [*names, *figure.legends]:
        box = part.get_window_extent()
        assert box.x0 >= -2 and box.x1 <= figure.bbox.width + 2, part
