"""Pictures with matplotlib: what a lens does to an image, and accuracy over distortion.

Each function draws on `axes`, or on a new figure that pyplot knows nothing of, and returns the
figure; `save_figure` writes it. Images are (H, W) or (H, W, 3), uint8 or floats in [0, 1].
"""

import io
import math
import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from torch import Tensor

from darswin.files import replace_file
from darswin.grid import PolarGrid
from darswin.layers import PolarSample
from darswin.lens import Lens
from darswin.lens.report import pixels_per_degree
from darswin.ops import polar_sample
from darswin.views import undistort

SPACING_SYMBOLS = {"theta": "θ", "tan": "tan θ", "g": "g(θ)", "radius": "r"}


def save_figure(figure: Figure, path: str | os.PathLike) -> None:
    """Writes a figure as a PNG file, whole or not at all."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    replace_file(path, picture.getvalue())


def draw_grid(
    image: np.ndarray,
    lens: Lens,
    sampler: PolarSample,
    *,
    samples: bool = True,
    axes: Axes | None = None,
) -> Figure:
    """An image with the borders of its polar patches and, over them, the sample points.

    All follow the lens: with affine, tangential or thin-prism terms they are on no circles.

    Args:
        lens: of the image. sampler: how it is cut and sampled, as `model.patch_embed.sample`.

    Raises:
        ValueError: more than one lens.
    """
    axes = axes or _new_axes()
    lens, grid = _grid(lens, sampler, image)
    _show(axes, image)
    rings = lens.unproject(grid.borders[0])[:, None]
    around = torch.linspace(0, 2 * math.pi, 361)
    outwards = torch.linspace(rings.min(), rings.max(), 65)
    sectors = torch.arange(sampler.sectors)[:, None] * (2 * math.pi / sampler.sectors)
    size = image.shape[:2]
    for theta, azimuth, width in ((rings, around, 0.6), (outwards, sectors, 0.3)):
        lines = lens.project_rays(theta, azimuth, size).numpy()
        axes.add_collection(LineCollection(lines, colors="cyan", lw=width), autolim=False)
    if samples:
        theta = lens.unproject(grid.radii[0])[:, None]
        x, y = lens.project_rays(theta, grid.azimuths, size).flatten(0, 1).T
        axes.plot(x, y, "r.", ms=0.6, alpha=0.5)
    axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    return axes.figure


def draw_samples(
    image: np.ndarray, lens: Lens, sampler: PolarSample, *, axes: Axes | None = None
) -> Figure:
    """`draw_grid` of a tenth of the image, enlarged: half way out, to the right and upwards."""
    axes = axes or _new_axes()
    draw_grid(image, lens, sampler, axes=axes)
    axes.lines[-1].set(markersize=2, alpha=1)
    for borders in axes.collections:
        borders.set_linewidth(1.2)
    left, top, width, height = _enlarged(image, lens)
    axes.set(xlim=(left, left + width), ylim=(top + height, top))
    return axes.figure


def draw_polar(
    image: np.ndarray, lens: Lens, sampler: PolarSample, *, axes: Axes | None = None
) -> Figure:
    """The polar image that a network gets: a row a radius, a column an azimuth, without jitter.

    Arguments: as `draw_grid`.
    """
    axes = axes or _new_axes(9, 3)
    lens, grid = _grid(lens, sampler, image)
    pixels = torch.from_numpy(np.atleast_3d(image)).permute(2, 0, 1)[None].float()
    arguments = sampler.arguments(pixels, grid) | dict(jitter=0.0)
    polar = polar_sample(**arguments, layout="image")[0].permute(1, 2, 0).numpy()
    rows = len(polar)
    scale = 255 if image.dtype == np.uint8 else 1
    _show(axes, polar.squeeze(2) / scale if image.ndim == 2 else polar / scale,
          extent=(0, 360, rows, 0), aspect="auto")  # fmt: skip
    sides = ("right", "below", "left", "above", "right")
    axes.set_xticks(range(0, 361, 90), [f"{90 * k}°\n{side}" for k, side in enumerate(sides)])
    step = -(-sampler.rings // 8)  # at most nine labels
    angles = torch.rad2deg(lens.unproject(grid.borders[0]))[::step].tolist()
    axes.set_yticks([k * step * sampler.samples[0] for k in range(len(angles))],
                    [f"{angle:.0f}°" for angle in angles])  # fmt: skip
    axes.set(xlabel="azimuth φ", ylabel="incident angle θ")
    return axes.figure


def draw_view(image: np.ndarray, lens: Lens, rays: Tensor, *, axes: Axes | None = None) -> Figure:
    """What the image shows along rays (H, W, 3), which `darswin.views` makes."""
    axes = axes or _new_axes()
    _show(axes, undistort(image, lens, rays))
    return axes.figure


def draw_curve(
    lens: Lens, image_size: tuple[int, int] | None = None, *, axes: Axes | None = None
) -> Figure:
    """The projection curve r(θ) up to θ_max, and how many pixels a degree has along the radius and
    around the axis; dotted where the image (H, W) ends, if it is given.

    Raises:
        ValueError: more than one lens.
    """
    axes = axes or _new_axes()
    lens = _one(lens)
    theta = torch.linspace(0, lens.theta_max.item(), 257, dtype=torch.float64)
    degrees, radius = torch.rad2deg(theta), lens.project(theta)
    axes.plot(degrees, radius, "k-", label="r")
    axes.set(xlabel="incident angle θ (°)", ylabel="r (px)", xlim=(0, degrees[-1].item()))
    density = axes.twinx()
    along, around = pixels_per_degree(lens, theta)
    density.plot(degrees, along, "C0-", label="px/° along r")
    density.plot(degrees, around, "C1-", label="px/° around")
    density.set(ylabel="pixels per degree")
    # Room for the legend above the curves.
    axes.set_ylim(0, 1.15 * radius.max().item())
    density.set_ylim(0, 1.15 * torch.cat((along, around)).max().item())
    if image_size is not None:
        ends = torch.rad2deg(lens.side_angles(image_size)[0])
        sides = (("left, right", ends[::2], 0.02), ("top, bottom", ends[1::2], 0.3))
        for label, pair, height in sides:
            seen = pair[pair < degrees[-1] + 1e-6].tolist()
            for angle in seen:
                axes.axvline(angle, color="0.5", ls=":", lw=1)
            if seen:
                axes.text(
                    min(seen), height, label, transform=axes.get_xaxis_transform(), rotation=90,
                    ha="right", va="bottom", color="0.4", fontsize="small",
                )  # fmt: skip
    axes.legend(handles=[*axes.lines[:1], *density.lines], loc="upper center", ncols=3)
    return axes.figure


def draw_lens(
    image: np.ndarray, lens: Lens, sampler: PolarSample, view: Tensor, title: str = "undistorted"
) -> Figure:
    """All of it in one figure: partition, sample points, a view, polar image, projection curve.

    Args:
        lens, sampler: as `draw_grid`. view: (H, W, 3), its rays. title: of the view.
    """
    figure = Figure(figsize=(15, 9), layout="constrained")
    panels = figure.subplot_mosaic([["partition", "samples", "view"], ["polar", "polar", "curve"]])
    draw_grid(image, lens, sampler, samples=False, axes=panels["partition"])
    draw_samples(image, lens, sampler, axes=panels["samples"])
    left, top, width, height = _enlarged(image, lens)
    frame = Rectangle((left, top), width, height, fill=False, color="red")
    panels["partition"].add_patch(frame)
    draw_view(image, lens, view, axes=panels["view"])
    draw_polar(image, lens, sampler, axes=panels["polar"])
    draw_curve(lens, image.shape[:2], axes=panels["curve"])
    (rows, columns), rings, sectors = sampler.samples, sampler.rings, sampler.sectors
    equal = SPACING_SYMBOLS[sampler.spacing]
    panels["partition"].set_title(f"{rings} rings × {sectors} sectors, equal steps of {equal}")
    panels["samples"].set_title(f"{rows} × {columns} samples in each, enlarged")
    panels["view"].set_title(title)
    panels["polar"].set_title(f"polar image, {rows * rings} × {columns * sectors} samples")
    panels["curve"].set_title(f"projection: {type(lens).__name__}")
    return figure


def draw_accuracy(
    xi: Sequence[float],
    accuracy: Mapping[str, Sequence[float]],
    trained: tuple[float, float] | None,
    *,
    axes: Axes | None = None,
) -> Figure:
    """Accuracy (%) against ξ, a line a model, with the range of training, if any, shaded."""
    axes = axes or _new_axes(7, 4.2)
    if trained is not None:
        axes.axvspan(*trained, color="tab:pink", alpha=0.3, lw=0, label="seen in training")
    for name, values in accuracy.items():
        axes.plot(xi, values, "o-", ms=4, label=name, clip_on=False)
    axes.set_xlabel("distortion ξ")
    axes.set_ylabel("accuracy (%)")
    axes.set_xlim(min(xi), max(xi))
    axes.grid(alpha=0.3)
    axes.legend()
    return axes.figure


def _new_axes(width: float = 6, height: float = 6) -> Axes:
    return Figure(figsize=(width, height), layout="constrained").subplots()


def _show(axes: Axes, image: np.ndarray, **options) -> None:
    axes.imshow(image, cmap="gray", **options)
    axes.set_xticks([])
    axes.set_yticks([])


def _one(lens: Lens) -> Lens:
    """The lens in double precision, without gradients; ValueError unless it is one."""
    if len(lens) != 1:
        raise ValueError(f"a picture is of one lens, got {len(lens)}")
    return lens.detach().to("cpu", torch.float64)


def _grid(lens: Lens, sampler: PolarSample, image: np.ndarray) -> tuple[Lens, PolarGrid]:
    lens = _one(lens)
    return lens, sampler.grid(lens, image.shape[:2])


def _enlarged(image: np.ndarray, lens: Lens) -> tuple[float, float, float, float]:
    """Left, top, width and height of the part that `draw_samples` shows."""
    height, width = image.shape[:2]
    x, y = (
        _one(lens)
        .project_rays(lens.theta_max.item() / 2, -math.pi / 4, (height, width))[0]
        .tolist()
    )
    return x - width / 20, y - height / 20, width / 10, height / 10
