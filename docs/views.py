"""Draws docs/views.png, one fisheye picture in the views that a network may see.

Run it with `.venv/bin/python docs/views.py`.
"""

from pathlib import Path

import torch
from matplotlib.figure import Figure

from darswin.lens import load
from darswin.utils.image import read_oriented
from darswin.views import make_view
from darswin.viz.plot import TEXT, page_figure, save_figure

ROOT = Path(__file__).parent.parent
SIDE = 240  # px
SINGLE = ("square", "perspective", "stereographic", "equirectangular", "cylindrical", "mercator",
          "panorama")  # fmt: skip


def draw_views() -> Figure:
    """The picture, single views of it, and its five tiles."""
    image, _ = read_oriented(ROOT / "examples" / "room.jpg", 3)
    camera = load(ROOT / "examples" / "room.json")
    images = torch.from_numpy(image)[None]
    figure = page_figure(4.6)
    grid = figure.add_gridspec(3, 20)
    panels = [("the picture", image)]
    for name in SINGLE:
        seen = make_view(name, (SIDE, SIDE))(images, camera)
        panels.append((name, seen[0].permute(1, 2, 0).clamp(0, 1)))
    for k, (title, picture) in enumerate(panels):
        row, column = divmod(k, 4)
        place = slice(5 * column, 5 * column + 5)
        axes = figure.add_subplot(grid[row, place])
        axes.imshow(picture)
        axes.set_title(title, fontsize=TEXT)
        axes.axis("off")
    tiles = make_view("tiles", (SIDE, SIDE))(images, camera)
    for k, tile in enumerate(tiles):
        axes = figure.add_subplot(grid[2, 4 * k : 4 * k + 4])
        axes.imshow(tile.permute(1, 2, 0).clamp(0, 1))
        axes.set_title(f"tile {k}", fontsize=TEXT)
        axes.axis("off")
    return figure


if __name__ == "__main__":
    save_figure(draw_views(), Path(__file__).parent / "views.png", colors=256)
