"""The study's own code, on digits: a minute's version of `make study`."""

import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "studies"))

import study  # noqa: E402
import tables  # noqa: E402
from cells import LEVELS, POLYNOMIAL, SWEEP, ablations, headline  # noqa: E402

QUICK = """
    --data.path digits --data.limit 96 --data.batch_size 16 --trainer.max_epochs 1 --data.render 32
    --model.learning_rate 0.001
""".split()  # noqa: SIM905


def test_cells_have_folders_of_their_own():
    cells = headline(3) + ablations()
    assert cells[0].key == "darswin-a-very-low-0"
    assert len({cell.key for cell in cells}) == len(cells)


@pytest.fixture(scope="module")
def quick(tmp_path_factory) -> Path:
    """One cell of each family, in the processes that `make study` uses."""
    folder = tmp_path_factory.mktemp("study")
    where = ["--out", str(folder / "out"), "--results", str(folder)]
    study.main([*where, "--seeds", "1", "--cell=-low-0", "--test-images", "20", *QUICK])
    return folder


def test_cells_are_trained_and_tested_once(quick, capsys):
    cells = {p.parent.name: json.loads(p.read_text()) for p in quick.glob("out/nano/*/cell.json")}
    assert {"darswin-a-low-0", "swin-very-low-0", "dat-low-0", "spacing-g-low-0"} <= cells.keys()
    for cell in cells.values():
        assert cell["accuracy"].keys() == {*SWEEP, POLYNOMIAL, *LEVELS}
        assert all(0 <= value <= 100 for value in cell["accuracy"].values())
    # A study that was stopped reads what it has; a cell that is run again finds the same.
    (quick / "out" / "nano" / "swin-low-0" / "cell.json").unlink()
    for file in (quick / "out" / "nano" / "swin-low-0").rglob("*"):
        if file.is_file():
            file.unlink()
    capsys.readouterr()
    where = ["--out", str(quick / "out"), "--results", str(quick), "--processes", "1"]
    study.main([*where, "--seeds", "1", "--cell", "swin-low-0", "--test-images", "20", *QUICK])
    (again,) = json.loads(capsys.readouterr().out.split("\n", 1)[1])
    assert again["accuracy"] == cells["swin-low-0"]["accuracy"]


def test_tables_and_picture(quick):
    cells = [json.loads(p.read_text()) for p in quick.glob("out/nano/*/cell.json")]
    tables.collect(cells, quick, "nano")
    assert (quick / "study--nano.png").read_bytes().startswith(b"\x89PNG")
    made = tables.tables(cells)
    assert "| Swin |" in made["xi-0.4"] and "(33.9)" in made["xi-0.4"]
    assert "not run" not in made["ablations"]
