import json

from kit.record import Record, write
from kit.start import Start


def test_a_record_and_its_plot(record, tmp_path, capsys):
    def draw(found, path):
        assert found is record
        path.write_text("a picture")

    record.publish(tmp_path / "new", "model", draw)
    path = tmp_path / "new" / "model--amd-epyc-25-17-avx512.json"
    assert Record.load(path) == record
    assert capsys.readouterr().out.splitlines() == [str(path), str(path.with_suffix(".png"))]

    def no_matplotlib(record, path):
        raise ImportError("No module named 'matplotlib'")

    record.publish(tmp_path, "model", no_matplotlib)
    assert (tmp_path / path.name).exists()
    assert "no plot: No module named 'matplotlib'" in capsys.readouterr().err


def test_a_record_has_a_line_for_each_row(tmp_path):
    path = tmp_path / "record.json"
    write(path, size=3, parts=dict(a=[1, 2], b=None), cells=[dict(x=0.1), dict(x=1e-9)])
    assert path.read_text().splitlines() == [
        "{", ' "size": 3,', ' "parts": {', '  "a": [1, 2],', '  "b": null', " },", ' "cells": [',
        '  {"x": 0.1},', '  {"x": 1e-09}', " ]", "}",
    ]  # fmt: skip


def test_records_of_frames_and_those_from_before_them_are_read(record, camera, tmp_path):
    path, starts = tmp_path / "record.json", [Start("nano", "darswin", 0.25, 2**25)]
    found = Record(record.machine, camera, starts=starts)
    found.save(path)
    assert Record.load(path) == found
    content = json.loads(path.read_text())
    del content["starts"]
    for row in content["timings"]:
        row.pop("cpu", None)
    path.write_text(json.dumps(content))
    old = Record.load(path)
    assert old.starts == [] and {t.cpu for t in old.timings} == {None}
    assert [t.median for t in old.timings] == [t.median for t in camera]
