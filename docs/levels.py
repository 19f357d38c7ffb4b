"""Draws docs/levels.png, a checkerboard through a lens of each of the paper's levels of distortion.

Run it with `.venv/bin/python docs/levels.py`. The board is a perspective picture, as the pictures
of the study are, with the paper's field of view.
"""

import statistics
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from darswin.data import LEVELS, SphericalLenses, WideAngle
from darswin.data.pictures import Arrays
from darswin.data.samples import Draw
from darswin.viz.plot import TEXT, page_figure, save_figure

SIDE, SQUARE = 1536, 64  # px


def board() -> np.ndarray:
    """A checkerboard with a red square in its middle: (SIDE, SIDE, 3) uint8."""
    place = np.abs(np.arange(SIDE) - (SIDE - 1) / 2) // (SQUARE / 2)  # 0 is the middle square
    number = (place + 1) // 2
    dark = (number[:, None] + number) % 2
    colour = np.where(dark[..., None], (30, 60, 110), (235, 235, 225))
    colour[(number[:, None] == 0) & (number == 0)] = (213, 0, 50)
    return colour.astype(np.uint8)


def draw_levels() -> Figure:
    """A panel for each level, through the lens in the middle of its range of ξ."""
    source = Arrays(board()[None], np.zeros(1, np.int64), ["board"])
    size = 256
    figure = page_figure(1.95)
    for axes, (level, (low, high)) in zip(figure.subplots(1, 4), LEVELS.items(), strict=True):
        xi = statistics.mean((low, high))
        pictures = WideAngle(
            source, SphericalLenses(xi, xi), size=size, render=4 * size, picture_size=SIDE
        )
        axes.imshow(pictures.shown(Draw(0, 0, 0)).image)
        axes.set_title(f'"{level}"\nξ = {xi:.3g}', fontsize=TEXT)
        axes.axis("off")
    return figure


if __name__ == "__main__":
    save_figure(draw_levels(), Path(__file__).parent / "levels.png", colors=256)
