"""The study's own code, on digits: a minute's version of `make study`."""

import json
import sys
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "studies"))

import quantized  # noqa: E402
import study  # noqa: E402
import tables  # noqa: E402
from cells import LEVELS, POLYNOMIAL, SWEEP, ablations, headline  # noqa: E402

from darswin.layers import onednn  # noqa: E402

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


@pytest.mark.skipif(onednn.missing(torch.int8) is not None, reason="no products of 8 bits")
def test_cells_of_8_bits(quick, monkeypatch):
    def in_this_process(work, jobs, *rest):
        return [work(*job) for job in jobs]

    monkeypatch.setattr(quantized, "run_all", in_this_process)
    where = ["--out", str(quick / "out"), "--results", str(quick)]
    how = [*where, "--seeds", "1", "--cell", "dat", "--test-images", "20", "--pictures", "8"]
    quantized.main([*how, *QUICK])
    (cell,) = json.loads((quick / "int8.json").read_text())["cells"]
    folder = quick / "out" / "nano" / "dat-low-0"
    trained = json.loads((folder / "cell.json").read_text())
    # The same pictures through the same lenses, which the study's own test has seen.
    assert cell["accuracy"]["float32"] == {xi: trained["accuracy"][xi] for xi in SWEEP}
    assert cell["layers"][0] >= 8 and cell["changed"].keys() == {*SWEEP}
    # What was found is read, not found again; of other pictures it says so.
    (folder / "int8.safetensors").unlink()
    quantized.main([*how, *QUICK])
    assert json.loads((quick / "int8.json").read_text())["cells"] == [cell]
    with pytest.raises(ValueError, match="remove it"):
        quantized.main([*how, "--pictures", "9", *QUICK])


def test_what_8_bits_lose():
    def cell(label: str, seed: int, after: list[float], changed: float) -> dict:
        accuracy = dict(float32=dict.fromkeys(SWEEP, 50.0), int8=dict.fromkeys(SWEEP, 50.0))
        accuracy["int8"] |= dict(zip(SWEEP, after, strict=False))
        changes = dict.fromkeys(SWEEP, changed)
        return dict(label=label, seed=seed, layers=[8, 9], accuracy=accuracy, changed=changes)

    cells = [cell("Swin", 0, [48.0, 50.4], 1.0), cell("Swin", 1, [50.0, 49.0], 2.0)]
    assert quantized.lost(cells[0])[:3] == pytest.approx([2.0, -0.4, 0.0])
    # 2.6 points of 42 tests in all; 1 of the first ξ on average, 2 with the first seed.
    *_, row = quantized.table(cells).splitlines()
    assert row == "| Swin | 8 of 9 | 50.00 | 49.94 | 0.06 | 1.00 | 2.0 | 1.5 |"
