"""Draws docs/tutorials/simulator.png and surround.jpg from what the code of these pages makes.

Run it with `.venv/bin/python docs/rigs.py`.
"""

import os
import re
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from darswin.viz.plot import TEXT, page_figure, save_figure

DOCS = Path(__file__).parent
TUTORIALS = DOCS / "tutorials"


def run_page(name: str) -> dict:
    """What the Python blocks of a tutorial leave, run in an empty folder beside the examples."""
    text = (TUTORIALS / f"{name}.md").read_text()
    scope: dict = {}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "examples").symlink_to(DOCS.parent / "examples")
        os.chdir(folder)
        for block in re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S):
            exec(compile(block, f"<{name}>", "exec"), scope)
    os.chdir(DOCS)
    return scope


def draw_panel(figure: Figure, place: object, picture: np.ndarray, title: str, **how) -> None:
    axes = figure.add_subplot(place)
    axes.imshow(picture, **how)
    axes.set_title(title, fontsize=TEXT)
    axes.axis("off")


def draw_surround() -> Figure:
    """The four pictures; the ground, the bowl and the differences."""
    scope = run_page("surround")
    figure = page_figure(3.6)
    grid = figure.add_gridspec(2, 12, height_ratios=(1, 2))
    for k, (name, frame) in enumerate(scope["frames"].items()):
        draw_panel(figure, grid[0, 3 * k : 3 * k + 3], frame[..., ::-1], name)
    for k, name in enumerate(("ground", "bowl")):
        picture = scope[name](scope["frames"])[..., ::-1]
        draw_panel(figure, grid[1, 4 * k : 4 * k + 4], picture, f"the {name}")
    how = dict(vmin=0, vmax=128, cmap="magma")
    draw_panel(figure, grid[1, 8:], np.nan_to_num(scope["picture"]), "disagreement", **how)
    return figure


if __name__ == "__main__":
    save_figure(draw_surround(), TUTORIALS / "surround.jpg")
