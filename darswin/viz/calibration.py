"""The figure of a calibration: its corners, how far they are off, and how sure the lens is."""

import math

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from darswin.calibrate import CalibratedLens
from darswin.lens import Lens
from darswin.viz.plot import HATCH, TEXT, page_figure

STEPS = 60  # of the map, along the image's longer side
LONGEST = 0.08  # of the image's width: the arrow of a residual that 95 % do not exceed


def draw_calibration(found: CalibratedLens, corners: np.ndarray, lens: Lens) -> Figure:
    """Draws the corners coloured by θ, their residuals, the standard deviation of the projection
    over the picture, and r(θ) with twice its standard deviation.

    Args:
        corners: (P, K, 2) px, as `calibrate` took them.
        lens: `found.lens`, perhaps with another θ_max.
    """
    figure = page_figure(6.4)
    panels = figure.subplot_mosaic([["corners", "residuals"], ["map", "curve"]])
    seen = ~torch.isnan(found.theta).numpy()
    points, misses = np.asarray(corners)[seen], found.residuals.numpy()[seen]
    theta, counts = torch.rad2deg(found.theta).numpy()[seen], found.weights.numpy()[seen] > 0.1
    dots = panels["corners"].scatter(points[:, 0], points[:, 1], c=theta, s=3, lw=0)
    figure.colorbar(dots, ax=panels["corners"], location="bottom", pad=0.02, label="θ (°)")
    _draw_residuals(panels["residuals"], points, misses, counts, lens)
    _draw_map(panels["map"], found, lens)
    _draw_curve(panels["curve"], found, lens)
    height, width = lens.image_size[0].tolist()
    around = torch.linspace(0, 2 * math.pi, 181, dtype=torch.float64)
    rim = lens.project_rays(lens.theta_max, around).numpy()
    for name in ("corners", "residuals", "map"):
        panels[name].plot(*rim.T, color="0.4", lw=0.8)
        limits = dict(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        panels[name].set(aspect="equal", xticks=[], yticks=[], **limits)
    titles = {
        "corners": f"{int(counts.sum())} corners",
        "residuals": f"residuals, noise {found.sigma:.2g} px",
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
    axes.axvline(last, color="0.4", ls="--", lw=1)
    axes.text(last, 0.03, "last corners ", transform=axes.get_xaxis_transform(), rotation=90,
              ha="right", va="bottom", color="0.3")  # fmt: skip
