"""Figures with matplotlib: a lens, its polar image, and accuracy over distortion.

Most functions draw on `axes`. `draw_lens` returns a figure that pyplot knows nothing of, and
`save_figure` writes it. Images are (H, W) or (H, W, 3), uint8 or floats in [0, 1].

All figures have one width, `WIDTH`, and text of `TEXT` pt or more.
"""

import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke
from matplotlib.ticker import MaxNLocator
from PIL import Image
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import OUTSIDE
from darswin.ops import polar_sample
from darswin.utils.arrays import as_tensor
from darswin.utils.files import replace_file
from darswin.views import PixelView, PolarView
from darswin.viz.report import SIDES, beyond_lens, pixels_per_degree

__all__ = ["draw_lens", "save_figure"]

# On a phone, where a figure is 390 px wide, this text is 9 px high.
WIDTH, TEXT = 6.0, 10.0  # inches, pt
DPI = 200

SPACING_SYMBOLS = {"theta": "θ", "tan": "tan θ", "g": "g(θ)", "radius": "r"}


# The formats that matplotlib writes without another program, by their endings.
FORMATS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp", ".tif": "tiff",
           ".tiff": "tiff", ".pdf": "pdf", ".svg": "svg"}  # fmt: skip
# The style of areas without an image.
HATCH: dict[str, Any] = dict(facecolor="0.9", hatch="///", edgecolor="0.6", linewidth=0)


def figure_format(path: str | os.PathLike) -> str:
    """The format for the ending of a file name; ValueError if it is not in `FORMATS`."""
    ending = Path(path).suffix.lower()
    if ending not in FORMATS:
        raise ValueError(
            f"the name of a figure must end in one of {', '.join(FORMATS)}, got {os.fspath(path)!r}"
        )
    return FORMATS[ending]


def page_figure(height: float) -> Figure:
    """An empty figure of `WIDTH` by `height` inches, whose parts do not overlap."""
    return Figure(figsize=(WIDTH, height), layout="constrained")


def add_legend(
    figure: Figure,
    handles: Sequence[Artist],
    *,
    loc: Literal["outside lower center", "outside upper center"] = "outside lower center",
) -> None:
    """Adds the legend of a figure, with as many columns as fit beside each other. The figure grows
    by the height of the legend."""
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(handles=handles, loc=loc, ncols=columns)
        box = legend.get_window_extent()
        if columns == 1 or box.width <= figure.bbox.width:
            figure.set_figheight(figure.get_figheight() + box.height / figure.dpi)
            return
        legend.remove()


def save_figure(figure: Figure, path: str | os.PathLike, *, colors: int | None = None) -> None:
    """Writes a figure; the ending of the path names the format. A failure leaves no partial file.

    Args:
        colors: of the palette of a small PNG, at most 256; None means all colours.

    Raises:
        ValueError: another ending, or one other than ".png" with `colors`.
        OSError: as `darswin.utils.files.replace_file`.
    """
    picture, format_ = io.BytesIO(), figure_format(path)
    if colors is not None and format_ != "png":
        raise ValueError(f"only a .png has a palette of colors, got {os.fspath(path)!r}")
    figure.savefig(picture, format=format_, dpi=DPI)
    if colors is not None:
        drawn, picture = Image.open(picture), io.BytesIO()
        drawn.convert("RGB").quantize(colors).save(picture, "png", optimize=True, dpi=(DPI, DPI))
    replace_file(path, picture.getvalue())


def draw_grid(
    image: np.ndarray, lens: Lens, sampler: PolarView, *, samples: bool = True, axes: Axes
) -> None:
    """Draws an image with the borders of its polar patches and the sample points.

    Affine, tangential and thin-prism terms of the lens deform the rings. The sampler of a model is
    `model.view`.
    """
    x, y = _draw_partition(image, lens, sampler, (0.6, 0.3), axes)
    if samples:
        axes.plot(x, y, "r.", ms=0.6, alpha=0.5)
    axes.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))


def draw_samples(image: np.ndarray, lens: Lens, sampler: PolarView, *, axes: Axes) -> None:
    """Draws the grid on a tenth of the image, enlarged. The part lies half way between the centre
    and the upper right end of the lens, if the image reaches there."""
    left, top, width, height = _enlarged(image, lens)
    x, y = _draw_partition(image, lens, sampler, (1.2, 1.2), axes)
    inside = (x > left) & (x < left + width) & (y > top) & (y < top + height)
    axes.plot(x[inside], y[inside], "r.", ms=1.5, path_effects=_outline(0.3, "white"))
    axes.set(xlim=(left, left + width), ylim=(top + height, top))


def _draw_partition(
    image: np.ndarray, lens: Lens, sampler: PolarView, widths: tuple[float, float], axes: Axes
) -> Tensor:
    """Draws an image with rings and sectors, whose outlines keep them visible where it is bright.
    Returns x and y of the sample points, (2, n) px."""
    lens, size = _one(lens), image.shape[:2]
    _show(axes, image)
    # Rings beyond θ_max of the lens, of a fixed theta_max, are drawn at its rim.
    rings = sampler.border_angles(lens)[0].clamp(max=lens.theta_max)[:, None]
    around = torch.linspace(0, 2 * math.pi, 361)
    outwards = torch.linspace(rings.min(), rings.max(), 65)
    sectors = torch.arange(sampler.sectors)[:, None] * (2 * math.pi / sampler.sectors)
    for theta, azimuth, width in zip((rings, outwards), (around, sectors), widths, strict=True):
        lines = lens.project_rays(theta, azimuth, size).numpy()
        effects = _outline(width, "black")
        collection = LineCollection(list(lines), colors="cyan", lw=width, path_effects=effects)
        axes.add_collection(collection, autolim=False)
    grid = sampler.grid(lens, size)
    theta = lens.unproject(grid.radii[0])[:, None]
    return lens.project_rays(theta, grid.azimuths, size).flatten(0, 1).T


def _outline(width: float, colour: str) -> list[AbstractPathEffect]:
    """The path effects for a line of this width with a thin outline."""
    return [Stroke(linewidth=width + 0.8, foreground=colour, alpha=0.6), Normal()]


def draw_polar(image: np.ndarray, lens: Lens, sampler: PolarView, *, axes: Axes) -> None:
    """Draws the polar image, without jitter: rows are radii, columns are azimuths."""
    lens = _one(lens)
    pixels = as_tensor(np.atleast_3d(image)).permute(2, 0, 1)[None].float()
    # The last channel is the fraction of a sample that lies in the image.
    pixels = torch.cat((pixels, torch.ones_like(pixels[:, :1])), 1)
    grid = sampler.grid(lens, image.shape[:2])
    arguments = sampler.arguments(pixels, grid) | dict(jitter=0.0)
    *colours, share = polar_sample(**arguments, layout="image")[0].numpy()
    rows, scale = len(share), 255 if image.dtype == np.uint8 else 1
    outside = share < 0.5
    _show(axes, np.stack(colours, -1) / scale, outside, extent=(0, 360, rows, 0), aspect="auto")
    sides = ("right", "below", "left", "above", "right")
    axes.set_xticks(range(0, 361, 90), [f"{90 * k}°\n{side}" for k, side in enumerate(sides)])
    step = -(-sampler.rings // 8)  # at most nine labels
    angles = torch.rad2deg(sampler.border_angles(lens)[0])[::step].tolist()
    axes.set_yticks([k * step * sampler.samples[0] for k in range(len(angles))],
                    [f"{angle:.0f}°" for angle in angles])  # fmt: skip
    axes.set(xlabel=_label("azimuth φ", outside), ylabel="incident angle θ")


def draw_view(image: np.ndarray, lens: Lens, view: PixelView, *, axes: Axes) -> None:
    """Draws the image as a view of one picture shows it. The ticks are the angles from the middle
    of the view, in its middle row and column; they rise to the right and upwards."""
    if view.count != 1:
        raise ValueError(f"a figure shows a view of one picture, got {view.count}")
    lens, size = _one(lens), (image.shape[0], image.shape[1])
    remap = view.at(lens, size)
    points, (height, width) = remap.points, remap.view_size
    supersampling = points.shape[1] // width
    beyond = (points == OUTSIDE).all(-1)
    outside = beyond | ((points < -0.5) | (points > (size[1] - 0.5, size[0] - 0.5))).any(-1)
    # A pixel is hatched if all of its points are.
    beyond, outside = (
        x.reshape(height, supersampling, width, supersampling).all((1, 3))
        for x in (beyond, outside)
    )
    _show(axes, remap(image), outside)
    x, y = torch.arange(width), torch.arange(height)
    row = torch.stack((x, torch.full((width,), (height - 1) / 2)), -1)
    column = torch.stack((torch.full((height,), (width - 1) / 2), y), -1)
    for axis, pixels, sign in ((axes.xaxis, row, 1), (axes.yaxis, column, -1)):
        rays = remap.rays(pixels.to(torch.float64))
        most = max(2, 5 * len(rays) // max(height, width))
        positions, degrees = _angle_ticks(F.normalize(rays, dim=-1), most)
        axis.set_ticks(positions, [f"{sign * angle + 0:g}°" for angle in degrees])
    axes.set(xlabel=_label("degrees from the view's middle", outside & ~beyond, beyond))


def _angle_ticks(line: Tensor, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The positions of ticks on a line of unit vectors (n, 3), NaN where nothing is seen, and their
    round angles from the middle in degrees; at most `most` steps."""
    seen = ~line.isnan().any(-1).numpy()
    half = (len(line) - 1) / 2
    middle = F.normalize(line[math.floor(half)] + line[math.ceil(half)], dim=0)
    apart = torch.linalg.cross(line, middle.expand_as(line)).norm(dim=-1)
    positions = np.arange(len(line))
    degrees = torch.rad2deg(torch.atan2(apart, line @ middle)).numpy() * np.sign(positions - half)
    positions, degrees = positions[seen], degrees[seen]
    if len(degrees) < 2 or not (np.diff(degrees) > 0).all():
        return positions[:0], degrees[:0]  # the directions along the line do not rise
    ticks = MaxNLocator(most, steps=[1, 1.5, 2, 3, 5, 6, 10]).tick_values(*degrees[[0, -1]])
    ticks = ticks[(ticks >= degrees[0]) & (ticks <= degrees[-1])]
    return np.interp(ticks, degrees, positions), ticks


def _label(text: str, outside: np.ndarray, beyond: np.ndarray | None = None) -> str:
    """The label of an axis, with an explanation of hatched areas if there are any."""
    reasons = ["outside the sensor"] if outside.any() else []
    reasons += ["beyond θ_max"] if beyond is not None and beyond.any() else []
    return "\nhatched: ".join((text, " or\n".join(reasons))) if reasons else text


def draw_curve(lens: Lens, image_size: tuple[int, int] | None = None, *, axes: Axes) -> None:
    """The projection curve r(θ) up to θ_max, and the pixels of a degree along the radius and around
    the axis; the ends of the image (H, W), if given, are dashed at the left and right and dotted
    above and below."""
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
    # Leave room for the legend above the curves.
    axes.set_ylim(0, 1.15 * radius.max().item())
    density.set_ylim(0, 1.15 * torch.cat((along, around)).max().item())
    if image_size is not None:
        _draw_sides(axes, lens, image_size)
    axes.legend(
        handles=[*axes.lines[:1], *density.lines], loc="upper center", ncols=3, handlelength=1,
        columnspacing=1, framealpha=1,
    )  # fmt: skip


def _draw_sides(axes: Axes, lens: Lens, image_size: tuple[int, int]) -> None:
    """Draws a line at the angle of each side of the image that lies within θ_max. The label of the
    axis names them, since texts beside the lines would cross the curves."""
    angles = torch.rad2deg(lens.side_angles(image_size)[0]).tolist()
    ends, last = beyond_lens(lens, image_size).tolist(), axes.get_xlim()[1]
    labels: dict[str, dict[str, list[str]]] = {}  # sides by the style of their line and their angle
    styles = ("dashed", "dotted", "dashed", "dotted")
    for side, style, angle, beyond in zip(SIDES, styles, angles, ends, strict=True):
        if not beyond and angle <= last + 1e-6:
            axes.axvline(angle, color="0.4", ls=style, lw=1)
            labels.setdefault(style, {}).setdefault(f"{angle:.0f}°", []).append(side)
    lines = [axes.get_xlabel()]
    for style, sides in labels.items():
        text = ", ".join(f"{' and '.join(names)} {angle}" for angle, names in sides.items())
        lines.append(f"{style}: {text}")
    axes.set_xlabel("\n".join(lines))


def draw_lens(
    image: np.ndarray, lens: Lens, sampler: PolarView, view: PixelView, title: str = "undistorted",
    supported: float | None = None,
) -> Figure:  # fmt: skip
    """Draws a lens: partition, sample points, a view, polar image, projection curve.

    Args:
        image: (H, W) or (H, W, 3), uint8 or floats in [0, 1]. lens: one, of the image.
        sampler: how it is cut and sampled, as `model.view`.
        view: of one picture. title: of the view.
        supported: rad: a circle where the corners of a calibration end; None draws none.

    Raises:
        ValueError: more than one lens.
    """
    figure = page_figure(8.4)
    panels = figure.subplot_mosaic(
        [
            [*["partition"] * 3, *["view"] * 3],
            ["polar"] * 6,
            [*["samples"] * 2, *["curve"] * 4],
        ]
    )
    draw_grid(image, lens, sampler, samples=False, axes=panels["partition"])
    draw_samples(image, lens, sampler, axes=panels["samples"])
    left, top, width, height = _enlarged(image, lens)
    border = Rectangle(
        (left, top), width, height, fill=False, color="red", path_effects=_outline(1.5, "white")
    )
    panels["partition"].add_patch(border)
    draw_view(image, lens, view, axes=panels["view"])
    draw_polar(image, lens, sampler, axes=panels["polar"])
    draw_curve(lens, image.shape[:2], axes=panels["curve"])
    (rows, columns), rings, sectors = sampler.samples, sampler.rings, sampler.sectors
    equal = SPACING_SYMBOLS[sampler.spacing]
    titles = {
        "partition": f"{rings} rings × {sectors} sectors,\nequal steps of {equal}",
        "samples": f"{rows} × {columns} samples\nin each, enlarged",
        "view": title,
        "polar": f"polar image, {rows * rings} × {columns * sectors} samples",
        "curve": f"projection: {type(lens).__name__}",
    }
    if supported is not None and supported < lens.theta_max.item():
        around = torch.linspace(0, 2 * math.pi, 361)
        end = _one(lens).project_rays(supported, around, image.shape[:2])
        effects = _outline(1.2, "black")
        panels["partition"].plot(*end.T.numpy(), color="magenta", lw=1.2, path_effects=effects)
        degrees = math.degrees(supported)
        panels["curve"].axvline(degrees, color="magenta", lw=1)
        titles["partition"] += f"\nmagenta: last corners, {degrees:.1f}°"
    for name, text in titles.items():
        panels[name].set_title(text, fontsize=TEXT)
    return figure


def draw_accuracy(
    xi: Sequence[float],
    accuracy: Mapping[str, Sequence[float] | Sequence[Sequence[float]]],
    trained: tuple[float, float] | None,
    *,
    axes: Axes,
) -> None:
    """Draws accuracy (%) over ξ, with one line for each model and the range of training shaded. If
    there are lists for several seeds, the line is their mean and a band their range."""
    if trained is not None:
        axes.axvspan(*trained, color="tab:pink", alpha=0.3, lw=0, label="seen in training")
    for name, values in accuracy.items():
        seeds = np.atleast_2d(np.asarray(values))
        (line,) = axes.plot(xi, seeds.mean(0), "o-", ms=4, label=name, clip_on=False)
        if len(seeds) > 1:
            span = seeds.min(0), seeds.max(0)
            axes.fill_between(xi, *span, color=line.get_color(), alpha=0.2, lw=0)
    axes.set(xlabel="distortion ξ", ylabel="accuracy (%)", xlim=(min(xi), max(xi)))
    axes.grid(alpha=0.3)
    axes.legend()


def _show(axes: Axes, image: np.ndarray, outside: np.ndarray | None = None, **options) -> None:
    """Draws an image (H, W[, 1 or 3]), hatched where `outside` (H, W) is true."""
    image = np.atleast_3d(image)
    opaque, colours = (255 if image.dtype == np.uint8 else 1), image.shape[2]
    image = np.repeat(image, 3, 2) if colours == 1 else image
    image = image.clip(0, opaque)
    if outside is not None:
        alpha = np.where(outside, 0, opaque).astype(image.dtype)
        image = np.concatenate((image, alpha[..., None]), 2)
        axes.patch.set(**HATCH)
    axes.imshow(image, **options)
    axes.set(xticks=[], yticks=[])


def _one(lens: Lens) -> Lens:
    """The lens in double precision, without gradients; ValueError unless it is one."""
    if len(lens) != 1:
        raise ValueError(f"a figure shows one lens, got {len(lens)}")
    return lens.detach().to("cpu", torch.float64)


def _enlarged(image: np.ndarray, lens: Lens) -> tuple[float, float, float, float]:
    """Left, top, width and height of the part of the image that `draw_samples` shows."""
    height, width = image.shape[:2]
    place = _one(lens).project_rays(lens.theta_max.item() / 2, -math.pi / 4, (height, width))[0]
    x, y = (
        min(max(at, 0.05 * side - 0.5), 0.95 * side - 0.5) if math.isfinite(at) else side / 2
        for at, side in zip(place.tolist(), (width, height), strict=True)
    )
    return x - width / 20, y - height / 20, width / 10, height / 10
