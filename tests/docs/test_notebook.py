"""The notebook runs from its first cell to its last, and shows on a code host what it draws."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TOUR = ROOT / "examples" / "tour.ipynb"

RUN = """
import json, sys
sys.path.insert(0, sys.argv[1])
from notebook import run

tour = json.load(open(sys.argv[2]))
scope = run(tour)
names = ("right_lens", "wrong_lens", "correct")
found = {name: scope[name] for name in names} | {"pictures": len(scope["strong"])}
json.dump({"outputs": [cell.get("outputs") for cell in tour["cells"]], **found}, sys.stderr)
"""


def kinds(outputs: list[list[dict] | None]) -> list[list[str] | None]:
    """The kinds of the outputs of each cell; None for text."""
    return [None if of is None else [output["output_type"] for output in of] for of in outputs]


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
def test_every_cell_runs_and_the_tour_shows_its_point(tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "notebooks").mkdir()
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", RUN, ROOT / "docs", TOUR],
        cwd=tmp_path / "notebooks", capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stderr.splitlines()[-1])
    stored = [cell.get("outputs") for cell in json.loads(TOUR.read_text())["cells"]]
    assert kinds(found["outputs"]) == kinds(stored)
    # With its lens, the model keeps its accuracy; with another lens it does not.
    assert min(found["right_lens"]) > 88 and found["wrong_lens"][-1] < 75
    assert found["right_lens"][0] == found["wrong_lens"][0]
    assert found["correct"] > 0.7 * found["pictures"]
