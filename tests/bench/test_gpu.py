"""`make gpu` without a GPU: on an imitation of one, and with parts of the test's own."""

import json
import sys

import gpu
import pytest
from helpers import output, refused


def found(folder):
    (path,) = folder.glob("gpu--*.json")
    return json.loads(path.read_text())


def test_a_device_that_does_not_compute_is_refused():
    refused("torch .* cannot compute on 'meta': ", gpu.main, ["--device=meta"], error=SystemExit)


def test_failures_and_what_is_left_out_are_told(tmp_path, monkeypatch, capsys):
    def steps(session):
        yield gpu.Check("first", lambda: "fine")
        yield gpu.Check("second", lambda: 1 // 0)
        yield gpu.Check("third", lambda: "fine", seconds=60.0)

    def digits(session):
        import a_package_that_nobody_has  # noqa: F401

    monkeypatch.setattr(gpu, "PARTS", gpu.PARTS | dict(steps=steps, digits=digits))
    options = ["--device=cpu", "--minutes=0.01", f"--out={tmp_path}", "--parts"]
    assert gpu.main([*options, "steps", "digits"]) == 1
    told = [(c["name"], c["state"]) for c in found(tmp_path)["checks"]]
    assert told == [
        ("first", "passed"), ("second", "FAILED"), ("third", "not run"), ("all", "not run"),
    ]  # fmt: skip
    said = capsys.readouterr().out
    assert "steps, second: FAILED, ZeroDivisionError" in said and "Failed: steps, second." in said
    assert "1 checks passed, 1 failed and 2 were left out" in said
    monkeypatch.undo()
    assert gpu.main(["--device=cpu", "--minutes=0", f"--out={tmp_path}", "--parts", "speed"]) == 0
    assert {c["state"] for c in found(tmp_path)["checks"]} == {"not run"}


@pytest.mark.slow
def test_every_part_on_another_device(tmp_path):
    output(sys.executable, gpu.__file__, "--device=other", "--quick", f"--out={tmp_path}")
    record = found(tmp_path)
    assert {c["part"] for c in record["checks"] if c["state"] == "passed"} == {*gpu.PARTS}
    assert len(record["timings"]) == 4 and min(record["accuracy"]["DarSwin-A"].values()) > 20
