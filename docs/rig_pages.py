"""Draws docs/tutorials/simulator.png and surround.jpg from what the code of these pages makes.

Run it with `.venv/bin/python docs/rig_pages.py`.
"""

import os
import re
import tempfile
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from darswin.views import CameraView
from darswin.viz.plot import TEXT, page_figure, save_figure

DOCS = Path(__file__).parent
TUTORIALS = DOCS / "tutorials"
PLACE = np.array([-0.2, -0.1, -0.8])  # of frame 4 of the simulator


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


def rays_of(scope: dict, along: int) -> np.ndarray:
    """along × along rays in each pixel of the fisheye of the page "simulator", in the places of a
    larger picture, (H · along, W · along, 3); NaN outside the image circle."""
    height, width = scope["remap"].view_size
    points = (np.mgrid[: height * along, : width * along][::-1] + 0.5) / along - 0.5
    lens = scope["camera"].to(torch.float64)
    return lens.unproject_points(torch.from_numpy(points).movedim(0, -1)[None])[0].numpy()


def rendered(scope: dict, place: np.ndarray, along: int) -> tuple[np.ndarray, np.ndarray]:
    """The mean colours of these rays for each pixel, (H, W, 3), and the pixels that lie inside the
    image circle, (H, W)."""
    height, width = scope["remap"].view_size
    rays = rays_of(scope, along)
    inside = np.isfinite(rays).all(-1).reshape(height, along, width, along).all((1, 3))
    rows = (scope["trace"](np.nan_to_num(row, nan=1.0), place)[0] for row in np.split(rays, height))
    means = [row.reshape(-1, along, width, along, 3).mean((1, 3)) for row in rows]
    return np.concatenate(means), inside


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


def draw_simulator() -> Figure:
    """The six faces; the fisheye picture, its labels and distances; and a part of the picture as
    others make it."""
    scope = run_page("simulator")
    faces = {name: scope["render"](face, PLACE)[0] for name, face in scope["rig"].cameras.items()}
    figure = page_figure(5.0)
    grid = figure.add_gridspec(3, 12, height_ratios=(1, 1.75, 1.6))
    for k, (name, face) in enumerate(faces.items()):
        draw_panel(figure, grid[0, 2 * k : 2 * k + 2], face[..., ::-1], name)
    labels = np.where(scope["labels"] == 255, np.nan, scope["labels"])
    panels = (("picture", scope["picture"][..., ::-1], {}), ("labels", labels, {"cmap": "viridis"}),
              ("distances", scope["distance"], {"cmap": "magma"}))  # fmt: skip
    for k, (name, picture, how) in enumerate(panels):
        draw_panel(figure, grid[1, 4 * k : 4 * k + 4], picture, name, **how)
    one = CameraView(scope["camera"], supersampling=1).at(scope["rig"])(faces)
    pictures = (("one point a pixel", one), ("remap", scope["picture"]),
                ("fisheye renderer, 8×8 rays", rendered(scope, PLACE, 8)[0]))  # fmt: skip
    for k, (name, picture) in enumerate(pictures):
        part = picture[60:120, 40:140, ::-1].astype(np.uint8)
        draw_panel(figure, grid[2, 4 * k : 4 * k + 4], part, name, interpolation="nearest")
    return figure


if __name__ == "__main__":
    save_figure(draw_simulator(), TUTORIALS / "simulator.png", colors=256)
    save_figure(draw_surround(), TUTORIALS / "surround.jpg")
