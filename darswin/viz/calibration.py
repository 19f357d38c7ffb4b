"""The figure of a calibration: its corners, how far they are off, and how sure the lens is."""

import math
import os
from collections.abc import Callable

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Rectangle

from darswin.calibrate import CalibratedLens
from darswin.lens import Lens
from darswin.viz.plot import HATCH, TEXT, page_figure

STEPS = 60  # of the map, along the image's longer side
LONGEST = 0.08  # of the image's width: the arrow of a residual that 95 % do not exceed
WORST = 3  # pictures that are drawn themselves
AROUND = 10.0, 2.5  # px, and by its residual: what is drawn around a corner, at least
LETTERS = 20  # of a name


def draw_calibration(
    found: CalibratedLens, lens: Lens, read: Callable[[str], np.ndarray] | None = None
) -> Figure:
    """Draws the corners coloured by θ, their residuals, the standard deviation of the projection
    over the picture, r(θ) with twice its standard deviation, and the pictures whose corners are
    farthest off.

    Args:
        lens: `found.lens`, perhaps with another θ_max.
        read: returns the picture of a name, (H, W, 3) uint8. None leaves the pictures out.
    """
    height, width = lens.image_size[0].tolist()
    upper = 2 * (1.15 + 2.05 * min(height / width, 1.2))  # inches: titles, scales and two panels
    figure = page_figure(upper if read is None else upper + 5.0)
    top: FigureBase = figure
    if read is not None:
        top, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(upper, 5.0)).flat
        _draw_worst(below, found, read)
    panels = top.subplot_mosaic([["corners", "residuals"], ["map", "curve"]])
    seen = ~torch.isnan(found.theta).numpy()
    points, misses = found.corners.numpy()[seen], found.residuals.numpy()[seen]
    theta, counts = torch.rad2deg(found.theta).numpy()[seen], found.weights.numpy()[seen] > 0.1
    dots = panels["corners"].scatter(points[:, 0], points[:, 1], c=theta, s=3, lw=0)
    top.colorbar(dots, ax=panels["corners"], location="bottom", pad=0.02, label="θ (°)")
    _draw_residuals(panels["residuals"], points, misses, counts, lens)
    _draw_map(panels["map"], found, lens)
    _draw_curve(panels["curve"], found, lens)
    around = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)
    rim = lens.project_rays(lens.theta_max, around).numpy()
    for name in ("corners", "residuals", "map"):
        panels[name].plot(*rim.T, color="0.4", lw=0.8)
        limits = dict(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        panels[name].set(aspect="equal", xticks=[], yticks=[], **limits)
    titles = {
        "corners": f"{int(counts.sum())} corners",
        "residuals": f"residuals, noise {found.noise:.2g} px",
        "map": "standard deviation\nof the projection",
        "curve": f"projection:\n{type(lens).__name__}",
    }
    for name, text in titles.items():
        panels[name].set_title(text, fontsize=TEXT)
    return figure


def _draw_residuals(
    axes: Axes, points: np.ndarray, misses: np.ndarray, counts: np.ndarray, lens: Lens
) -> None:
    """Draws arrows from corners to where the lens sees them, red for those that count little."""
    length = np.linalg.norm(misses, axis=1)
    usual = max(float(np.quantile(length, 0.95)), 1e-9)
    width = lens.image_size[0, 1].item()
    # Wrong corners would have arrows across the whole picture.
    shown = misses * np.minimum(1, 2 * usual / length.clip(1e-9))[:, None]
    arrows = axes.quiver(
        *points.T, *shown.T, color=np.where(counts, "C0", "red"), angles="xy", scale_units="xy",
        scale=usual / (LONGEST * width), width=0.004,
    )  # fmt: skip
    round_ = float(f"{usual:.1g}")
    axes.quiverkey(arrows, 0.5, -0.1, round_, f"{round_:g} px", labelpos="E", color="C0")


def _draw_worst(
    figure: FigureBase, found: CalibratedLens, read: Callable[[str], np.ndarray]
) -> None:
    """Draws the pictures with the largest residuals: above, the board with all residuals, longer
    than they are; below, the pixels around the corner that is farthest off."""
    distance = found.residuals.norm(dim=-1).nan_to_num(-1).numpy()
    worst = [k for k in distance.max(1).argsort()[::-1][:WORST] if distance[k].max() >= 0]
    panels = figure.subplots(2, len(worst), squeeze=False)
    for k, (whole, part) in zip(worst, panels.T, strict=True):
        picture, seen, corner = read(found.names[k]), distance[k] >= 0, int(distance[k].argmax())
        points, misses = (x[k].numpy()[seen] for x in (found.corners, found.residuals))
        low, high, longest = points.min(0), points.max(0), distance[k, corner]
        half, around = 0.6 * (high - low).max(), max(AROUND[0], AROUND[1] * longest)
        times = max(1.0, float(f"{2 * LONGEST * half / max(longest, 1e-9):.1g}"))
        _show_part(whole, picture, (low + high) / 2, half)
        whole.plot(*points.T, "r.", ms=2)
        lines = [*np.stack((points, points + times * misses), 1)]
        whole.add_collection(LineCollection(lines, colors="cyan", lw=1.5), autolim=False)
        place = found.corners[k, corner].numpy() - around
        border = Rectangle(place, 2 * around, 2 * around, fill=False, color="yellow", lw=1.5)
        whole.add_patch(border)
        _show_part(part, picture, place + around, around)
        part.plot(*points.T, "r+", ms=12, mew=1.5, label="found")
        part.plot(*(points + misses).T, "cx", ms=12, mew=1.5, label="predicted")
        name = os.fsencode(os.path.basename(found.names[k])).decode(errors="replace")
        name = name if len(name) <= LETTERS else f"…{name[1 - LETTERS :]}"
        title = f"{name}\nresiduals × {times:g}"
        whole.set_title(title, fontsize=TEXT, parse_math=False)
        part.set_title(f"corner {corner + 1}, {longest:.3g} px off", fontsize=TEXT)
    figure.legend(handles=panels[1, 0].lines, loc="outside lower center", ncols=2)


def _show_part(axes: Axes, picture: np.ndarray, middle: np.ndarray, half: float) -> None:
    """Shows the square of a picture within `half` px of a place."""
    left, top = np.maximum(np.floor(middle - half), 0).astype(int)
    right, bottom = np.ceil(middle + half).astype(int) + 1
    part = picture[top:bottom, left:right]
    height, width = part.shape[:2]
    axes.imshow(part, extent=(left - 0.5, left + width - 0.5, top + height - 0.5, top - 0.5))
    (x, y) = middle
    axes.set(xlim=(x - half, x + half), ylim=(y + half, y - half), xticks=[], yticks=[])
    axes.patch.set(**HATCH)


def _draw_map(axes: Axes, found: CalibratedLens, lens: Lens) -> None:
    height, width = lens.image_size[0].tolist()
    step = max(height, width) / STEPS
    y, x = (torch.arange(step / 2 - 0.5, side - 0.5, step).double() for side in (height, width))
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    spread = found.uncertainty(pixels)
    spread[lens.unproject_pixels(pixels[None])[0][0].isnan()] = torch.nan
    extent = (-0.5, len(x) * step - 0.5, len(y) * step - 0.5, -0.5)
    most = spread.nanquantile(0.98).item()
    drawn = axes.imshow(spread.numpy(), extent=extent, vmin=0, vmax=most, cmap="magma_r")
    axes.patch.set(**HATCH)
    axes.figure.colorbar(drawn, ax=axes, location="bottom", pad=0.02, label="px", extend="max")


def _draw_curve(axes: Axes, found: CalibratedLens, lens: Lens) -> None:
    theta = torch.linspace(0, lens.theta_max.item(), 129, dtype=torch.float64)
    degrees, band = torch.rad2deg(theta), 2 * found.uncertainty_of_theta(theta)
    axes.plot(degrees, lens.project(theta), "k-")
    axes.set(xlabel="incident angle θ (°)", ylabel="r (px)", xlim=(0, degrees[-1].item()))
    axes.set_ylim(bottom=0)
    beside = axes.twinx()
    beside.fill_between(degrees, band, color="C0", alpha=0.3, lw=0)
    beside.set_ylabel("2σ of r (px)", color="C0")
    beside.set_ylim(0, 2 * band.max().item())
    last = math.degrees(found.supported)
    axes.axvline(last, color="0.4", ls="--", lw=1, label="last corners")
    axes.legend(loc="upper left")
    axes.set_box_aspect((lens.image_size[0, 0] / lens.image_size[0, 1]).item())  # as of the map
