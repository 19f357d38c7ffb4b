"""The notebook runs from its first cell to its last, and shows on a code host what it draws."""

import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOUR = ROOT / "examples" / "tour.ipynb"


def kinds(tour: dict) -> list[list[str]]:
    """The kinds of the outputs of each cell."""
    return [[output["output_type"] for output in c.get("outputs", ())] for c in tour["cells"]]


def test_it_is_a_notebook_with_pictures():
    assert TOUR.stat().st_size < 2**20
    tour = json.loads(TOUR.read_text())
    assert (tour["nbformat"], tour["nbformat_minor"]) == (4, 5)
    cells = tour["cells"]
    assert len({cell["id"] for cell in cells}) == len(cells)
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    pictures = [o for cell in code for o in cell["outputs"] if o["output_type"] == "display_data"]
    assert len(pictures) >= 3 and all("image/png" in picture["data"] for picture in pictures)


@pytest.mark.slow
def test_every_cell_runs_and_the_tour_shows_its_point(tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    monkeypatch.syspath_prepend(ROOT / "docs")
    from notebook import run

    tour = json.loads(TOUR.read_text())
    stored = kinds(tour)
    scope = run(tour)
    assert kinds(tour) == stored
    # With its lens, the model keeps its accuracy; with another lens it does not.
    right, wrong = scope["right_lens"], scope["wrong_lens"]
    assert min(right) > 88 and wrong[-1] < 75 and right[0] == wrong[0]
    assert scope["correct"] > 0.7 * len(scope["strong"])
