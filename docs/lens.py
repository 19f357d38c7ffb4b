"""Draws docs/lens.png and docs/polar.png, and writes examples/room.jpg and its calibration
examples/room.json. The picture is a computed room through a lens of our own, which sees 190° from
left to right.

Run it with `.venv/bin/python docs/lens.py`. The room is a box with a checkerboard on its walls, so
that its lines are straight in the perspective view and nowhere else.
"""

import io
import json
import math
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

from darswin import PolarView
from darswin.lens import Polynomial
from darswin.utils.files import replace_file
from darswin.views import PerspectiveView
from darswin.viz.plot import TEXT, draw_grid, draw_lens, draw_polar, page_figure, save_figure

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
SIZE = (966, 1280)
# They belong to no camera: they are chosen such that the image's sides are 190° apart.
COEFFICIENTS = [350.4, -17.5, 27.5, -2.4]
OFFSETS = dict(
    cx_offset=1.8, cy_offset=3.6, aspect_ratio=1.0, width=1280.0, height=966.0,
    model="radial_poly", poly_order=4,
)  # fmt: skip
HALF = np.array([2.0, 1.2, 2.5])  # the box around the camera, m
SQUARE = 0.4  # m
# Left and right, above and below, behind and before.
COLOURS = np.array([
    [(200, 90, 80), (235, 160, 120)], [(225, 225, 230), (150, 120, 90)],
    [(90, 120, 90), (110, 160, 220)],
])  # fmt: skip


def front_lens() -> Polynomial:
    """The lens of examples/room.json, used as far as the image's sides."""
    lens = Polynomial(COEFFICIENTS, center=[641.3, 486.1], image_size=SIZE).to(torch.float64)
    return lens.with_theta_max(lens.side_angles().amax())


def room(rays: np.ndarray) -> np.ndarray:
    """What the walls look like along rays (..., 3): (..., 3) uint8."""
    far = HALF / np.abs(rays).clip(1e-9)
    wall = far.argmin(-1)
    hit = rays * far.min(-1, keepdims=True) / SQUARE
    side = np.take_along_axis(rays, wall[..., None], -1)[..., 0] > 0
    on_wall = np.arange(3) != wall[..., None]  # the two coordinates along it
    dark = (np.floor(hit).astype(int) * on_wall).sum(-1) % 2
    line = ((np.abs(hit - np.round(hit)) < 0.04) & on_wall).any(-1)
    colour = COLOURS[wall, side.astype(int)] * np.where(dark, 0.82, 1.0)[..., None]
    return np.where(line[..., None], 30, colour).astype(np.uint8)


def photograph(lens: Polynomial) -> np.ndarray:
    """The room through a lens, four rays a pixel: (H, W, 3) uint8."""
    height, width = SIZE
    return np.concatenate([row(lens, y, width) for y in range(height)])


def row(lens: Polynomial, y: int, width: int) -> np.ndarray:
    y, x = np.mgrid[2 * y : 2 * y + 2, : 2 * width] / 2 - 0.25
    rays = lens.unproject_points(torch.from_numpy(np.stack((x, y), -1))[None])[0].numpy()
    return room(rays).reshape(1, 2, width, 2, 3).mean((1, 3)).round().astype(np.uint8)


def draw_polar_image(image: np.ndarray, lens: Polynomial) -> Figure:
    """The first picture of the README: the rings of the lens, and the polar image."""
    sampler = PolarView(rings=8, sectors=32, samples=(20, 20))
    figure = page_figure(2.9)
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.1))
    draw_grid(image, lens, sampler, samples=False, axes=left)
    left.set_title("fisheye picture, cut into polar\npatches that follow the lens", fontsize=TEXT)
    draw_polar(image, lens, sampler, axes=right)
    right.set_title("polar image:\nwhat the network sees", fontsize=TEXT)
    return figure


def main() -> None:
    lens = front_lens().with_theta_max(None)
    image = photograph(lens)
    picture = io.BytesIO()
    Image.fromarray(image).save(picture, format="jpeg", quality=80, optimize=True)
    replace_file(EXAMPLES / "room.jpg", picture.getvalue())
    calibration = dict(zip(("k1", "k2", "k3", "k4"), COEFFICIENTS, strict=True)) | OFFSETS
    replace_file(EXAMPLES / "room.json", json.dumps({"intrinsic": calibration}, indent=2) + "\n")
    view = PerspectiveView((604, 800), fov=math.radians(110))
    sampler = PolarView(rings=16, sectors=64, samples=(10, 10))
    figure = draw_lens(image, front_lens(), sampler, view, "perspective view, 110° across")
    save_figure(figure, DOCS / "lens.png", colors=256)
    save_figure(draw_polar_image(image, front_lens()), DOCS / "polar.png", colors=256)


if __name__ == "__main__":
    main()
