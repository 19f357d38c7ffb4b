"""Draws the worlds through a few lenses: picture, labels and distance side by side."""

import math
from pathlib import Path

import numpy as np
from matplotlib.patches import Patch

from darswin.viz.pixels import distance_image, label_image
from darswin.viz.plot import TEXT, add_legend, page_figure, save_figure
from worlds.geometry import CLASSES, COLORS
from worlds.lenses import draw_lens
from worlds.poses import poses_of
from worlds.render import rays_of, render
from worlds.scene import Scene
from worlds.textures import Textures
from worlds.wad import load_map

FOV, SIZE = math.radians(165), 128
NEAR, FAR = 0.5, 40.0  # m, the range of the colours
# Maps with the number of a pose; names of `draw_lens` by their headings.
PLACES = (
    ("freedoom2-MAP01", 1),
    ("freedoom2-MAP01", 3),
    ("freedoom1-E1M1", 1),
    ("freedoom1-E3M4", 1),
)
FRONT = Path(__file__).parents[2] / "examples" / "room.json"
LENSES = {"perspective": "wide", "spherical, ξ = 0.3, 165°": "0.3", "a fisheye of 190°": str(FRONT)}


def draw_sheet(path: Path) -> None:
    """Writes a PNG: a row for each of `PLACES`, three columns for each of `LENSES`."""
    across = 3 * len(LENSES)
    figure = page_figure(0.7 * len(PLACES) + 0.3)
    panels = figure.subplots(len(PLACES), across, squeeze=False)
    for row, (name, number) in zip(panels, PLACES, strict=True):
        wad, world = load_map(name)
        scene = Scene(world, Textures(wad))
        pose = poses_of(scene, name, number + 1, seed=0)[number]
        for k, lens_name in enumerate(LENSES.values()):
            lens = draw_lens(lens_name, SIZE, FOV, np.random.default_rng(0))
            view = render(scene, pose, rays_of(lens))
            seen = (
                view.image,
                label_image(view.labels, COLORS),
                distance_image(view.distance, NEAR, FAR),
            )
            for axes, picture in zip(row[3 * k : 3 * k + 3], seen, strict=True):
                axes.imshow(picture)
                axes.axis("off")
    for k, title in enumerate(LENSES):
        panels[0][3 * k + 1].set_title(title, fontsize=TEXT)
    entries = [
        Patch(color=np.array(c) / 255, label=n) for n, c in zip(CLASSES, COLORS, strict=True)
    ]
    add_legend(figure, entries)
    save_figure(figure, path, colors=256)  # a third of the size
