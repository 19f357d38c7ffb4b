"""Pictures with matplotlib: what a lens does to the partition, and accuracy over distortion."""

import io
import math
import os
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from darswin.files import replace_file
from darswin.grid import PolarGrid


def save_figure(figure: Figure, path: str | os.PathLike) -> None:
    """Writes a figure as a PNG file, whole or not at all."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    replace_file(path, picture.getvalue())


def draw_grid(
    axes: Axes, image: np.ndarray, grid: PolarGrid, sectors: int, *, samples: bool = True
) -> None:
    """Draws an image with the borders of its polar patches and, over them, the sample points.

    Args:
        image: (H, W) or (H, W, 3). grid: of one lens. sectors: A.
    """
    border_radii, (cx, cy) = grid.borders[0].tolist(), grid.center[0].tolist()
    axes.imshow(image, cmap="gray")
    angle = np.linspace(0, 2 * math.pi, 181)
    for radius in border_radii:
        axes.plot(cx + radius * np.cos(angle), cy + radius * np.sin(angle), "c-", lw=0.6)
    ends = np.array([border_radii[0], border_radii[-1]])
    for sector in range(sectors):
        azimuth = 2 * math.pi * sector / sectors
        axes.plot(cx + ends * math.cos(azimuth), cy + ends * math.sin(azimuth), "c-", lw=0.3)
    if samples:
        radius, azimuth = np.meshgrid(grid.radii[0].numpy(), grid.azimuths.numpy())
        x, y = cx + radius * np.cos(azimuth), cy + radius * np.sin(azimuth)
        axes.plot(x.ravel(), y.ravel(), "r.", ms=0.6, alpha=0.5)
    axes.set_xlim(-0.5, image.shape[1] - 0.5)
    axes.set_ylim(image.shape[0] - 0.5, -0.5)
    axes.set_xticks([])
    axes.set_yticks([])


def draw_accuracy(
    axes: Axes,
    xi: Sequence[float],
    accuracy: Mapping[str, Sequence[float]],
    trained: tuple[float, float] | None,
) -> None:
    """Draws accuracy (%) against ξ, a line a model, with the range of training, if any, shaded."""
    if trained is not None:
        axes.axvspan(*trained, color="tab:pink", alpha=0.3, lw=0, label="seen in training")
    for name, values in accuracy.items():
        axes.plot(xi, values, "o-", ms=4, label=name, clip_on=False)
    axes.set_xlabel("distortion ξ")
    axes.set_ylabel("accuracy (%)")
    axes.set_xlim(min(xi), max(xi))
    axes.grid(alpha=0.3)
    axes.legend()
