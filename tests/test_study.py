"""The study's own code, on digits: a minute's version of `make study`."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import dense_cells
import pytest
import quantized
import study
import tables
from cells import LEVELS, POLYNOMIAL, SWEEP, ablations, augmented, headline
from helpers import in_this_process

from darswin import create_model

QUICK = """
    --data.path digits --data.limit 96 --data.batch_size 16 --trainer.max_epochs 1 --data.render 32
    --model.learning_rate 0.001
""".split()  # noqa: SIM905


def test_cells_have_folders_of_their_own_and_make_models():
    cells = headline(3) + ablations(3) + augmented(3)
    assert cells[0].key == "darswin-a-very-low-0"
    assert len({cell.key for cell in cells}) == len({cell.identity for cell in cells}) == len(cells)
    for cell in ablations(1):
        create_model(f"{cell.family}_nano", num_classes=10, in_chans=1, **cell.options)
    dense = dense_cells.all_cells(3)
    expected = len(dense_cells.STUDIED_MODELS) * 3 + len(dense_cells.CONTROLLED)
    assert len({cell.key for cell in dense}) == len(dense) == len(dense_cells.STUDIED) * expected
    assert len(dense) == 104 and dense[0].key == "darswin-unet-ra-wide-segmentation-0"


JOBS = """
import os, sys, time
from pathlib import Path
from jobs import run_all

def work(file):
    Path(file).write_text(str(os.getpid()))
    time.sleep(300)

if __name__ == "__main__":
    run_all(work, [("first",), ("second",)], 1, "cell")
"""


@pytest.mark.slow
def test_the_jobs_of_a_killed_study_end(tmp_path):
    (tmp_path / "program.py").write_text(JOBS)
    path = os.pathsep.join(sys.path)
    program = subprocess.Popen(
        [sys.executable, "program.py"], cwd=tmp_path, env=os.environ | dict(PYTHONPATH=path)
    )
    first = tmp_path / "first"
    wait_until(lambda: first.exists() and first.read_text())
    program.kill()
    program.wait()
    job = Path(f"/proc/{first.read_text()}/status")
    wait_until(lambda: not job.exists() or "State:\tZ" in job.read_text())
    assert not (tmp_path / "second").exists()


def wait_until(happened, seconds=60):
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.fixture(scope="module")
def quick(tmp_path_factory) -> Path:
    """One cell of each model, an ablation and a cell with lens augmentation, in the processes that
    `make study` uses."""
    folder = tmp_path_factory.mktemp("study")
    where = ["--out", str(folder / "out"), "--results", str(folder)]
    cells = [cell for cell in headline(1) if cell.level == "low"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "headline", lambda seeds: cells)
        patch.setattr(study, "ablations", lambda seeds: ablations(seeds)[-1:])
        patch.setattr(study, "augmented", lambda seeds: augmented(1)[-1:])
        study.main([*where, "--seeds", "1", "--test-images", "20", *QUICK])
    return folder


@pytest.fixture
def here(monkeypatch, threads):
    """Jobs run one after the other in this process, as `make study` runs them in others."""
    threads(1)
    for program in (study, quantized):
        monkeypatch.setattr(program, "run_all", in_this_process)


@pytest.mark.slow
def test_cells_are_trained_and_tested_once(quick, here, capsys):
    cells = {p.parent.name: json.loads(p.read_text()) for p in quick.glob("out/nano/*/cell.json")}
    names = {"darswin-a", "dat", "swin", "swin--undis-", "spacing-g"}
    names.add("swin--lens-augmentation-very")
    assert cells.keys() == {f"{name}-low-0" for name in names}
    for cell in cells.values():
        assert cell["accuracy"].keys() == {*SWEEP, POLYNOMIAL, *LEVELS}
        assert all(0 <= value <= 100 for value in cell["accuracy"].values())
    # A study that was stopped reads what it has; a cell that is run again finds the same.
    shutil.rmtree(quick / "out" / "nano" / "swin-low-0")
    capsys.readouterr()
    where = ["--out", str(quick / "out"), "--results", str(quick)]
    study.main([*where, "--seeds", "1", "--cell", "swin-low-0", "--test-images", "20", *QUICK])
    (again,) = json.loads(capsys.readouterr().out.split("\n", 1)[1])
    assert again["accuracy"] == cells["swin-low-0"]["accuracy"]


@pytest.mark.slow
def test_cells_of_a_record_are_not_run_again(here, tmp_path, monkeypatch):
    ran = []

    def run_cell(cell, out, size, test_images, options):
        ran.append(cell)
        given = study.given_to(cell, test_images, options)
        accuracy = dict.fromkeys([*SWEEP, POLYNOMIAL, *LEVELS], 50.0)
        return dict(
            label=cell.label, level=cell.level, seed=cell.seed, given=given, accuracy=accuracy
        )

    monkeypatch.setattr(study, "run_cell", run_cell)
    record = tmp_path / "study--nano.json"
    where = ["--results", str(tmp_path), "--known", str(record)]
    study.main(["--results", str(tmp_path), "--seeds", "1", "--only", "ablations"])
    old = json.loads(record.read_text())["cells"]
    assert len(ran) == len(old) == len(ablations(1))
    study.main([*where, "--seeds", "2", "--only", "augmented"])
    assert ran[len(old) :] == sorted(augmented(2), key=lambda cell: cell.seed)
    cells = json.loads(record.read_text())["cells"]
    assert len(cells) == len(ran) and all(cell in cells for cell in old)
    study.main([*where, "--seeds", "2", "--only", "augmented"])
    assert len(cells) == len(ran)  # nothing is missing
    with pytest.raises(ValueError, match="was made with"):
        study.main([*where, "--test-images", "7", "--only", "augmented"])
    with pytest.raises(ValueError, match="has models of the size nano, not tiny"):
        study.main([*where, "--size", "tiny", "--only", "augmented"])


@pytest.mark.slow
def test_tables_and_picture(quick):
    cells = json.loads((quick / "study--nano.json").read_text())["cells"]
    assert len(cells) == 6 and (quick / "study--nano.png").read_bytes().startswith(b"\x89PNG")
    made = tables.tables(cells)
    assert "| Swin | not run (33.9) |" in made["xi-0.4"] and "(87.9)" in made["xi-0.4"]
    assert made["ablations"].count("not run") == 4 * (len(ablations(1)) - 1)
    assert made["augmented"].count("not run") == 5 * 8
    others = [cells[0] | dict(label=cell.label) for cell in ablations(1)[:-1]]
    assert "not run" not in tables.tables(cells + others)["ablations"]


@pytest.mark.slow
def test_cells_of_8_bits(quick, here):
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


@pytest.mark.slow
def test_what_8_bits_lose():
    def cell(label: str, seed: int, after: list[float], changed: float) -> dict:
        accuracy = dict(float32=dict.fromkeys(SWEEP, 50.0), int8=dict.fromkeys(SWEEP, 50.0))
        accuracy["int8"] |= dict(zip(SWEEP, after, strict=False))
        changes = dict.fromkeys(SWEEP, changed)
        return dict(label=label, seed=seed, layers=[8, 9], accuracy=accuracy, changed=changes)

    cells = [cell("Swin", 0, [48.0, 50.4], 1.0), cell("Swin", 1, [50.0, 49.0], 2.0)]
    assert tables.points_lost(cells[0])[:3] == pytest.approx([2.0, -0.4, 0.0])
    # 2.6 points of 42 tests in all; 1 of the first ξ on average, 2 with the first seed.
    *others, row = tables.int8_table(cells).splitlines()
    assert others[2].startswith("| DarSwin-A | not run |")
    assert row == "| Swin | 8 of 9 | 50.00 | 49.94 | 0.06 | 1.00 | 2.0 | 1.5 |"
