"""Figures of a rig: its cameras in space, what they see together, and where they disagree."""

import cv2
import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from darswin.lens.rig import Camera, Rig
from darswin.utils.image import with_channels
from darswin.views import GroundView
from darswin.views.rig import RigRemap
from darswin.viz.pixels import palette
from darswin.viz.plot import HATCH, TEXT, add_legend, page_figure

GREYS = ("0.9", "0.72", "0.5", "0.3")  # of places that 1, 2, 3, and more cameras see
RAYS = 33  # along each side of a picture, for the outline of a field of view
LEAST = 0.3  # m, of the size of a rig
# The directions to the right and upwards on paper, in the level frame of a rig.
ABOVE, SIDE = np.array([[1, 0], [0, 0], [0, 1]]), np.array([[0, 0], [0, -1], [1, 0]])


def draw_rig(remap: RigRemap, picture: np.ndarray | None = None) -> Figure:
    """Draws the cameras of a rig from above and from the right, and how many see each place of a
    view: of a part of the ground, or of all directions.

    Args:
        picture: what the view shows, (H', W', 1 or 3) uint8, to draw it too.
    """
    maps = ["counts"] if picture is None else ["counts", "picture"]
    is_ground = isinstance(remap.view, GroundView)
    rows = [["above", "side"]]
    rows += [maps] if is_ground and len(maps) > 1 else [[name, name] for name in maps]
    figure = page_figure(3.1 * len(rows))
    panels = figure.subplot_mosaic(rows)  # type: ignore[arg-type]
    titles = {"above": "cameras, from above", "side": "from the right",
              "counts": "number of cameras", "picture": "stitched"}  # fmt: skip
    _draw_cameras(panels["above"], remap.rig, ABOVE)
    _draw_cameras(panels["side"], remap.rig, SIDE)
    panels["above"].set(xlabel="m to the right", ylabel="m ahead")
    panels["side"].set(xlabel="m ahead", ylabel="m up")
    if is_ground:
        panels["side"].axhline(0, color="0.4", lw=1)
    counts = remap.seen_by.sum(0)
    shades = np.array([[1.0], *([float(grey)] for grey in GREYS)])[counts.clip(max=len(GREYS))]
    _draw_map(panels["counts"], remap, np.repeat(shades, 3, 2), counts == 0)
    if picture is not None:
        _draw_map(panels["picture"], remap, with_channels(picture, 3), ~remap.shown)
    for name, axes in panels.items():
        axes.set_title(titles[name], fontsize=TEXT)
    handles: list[Artist] = list(_lines(remap.rig))
    for k, grey in enumerate(GREYS, 1):
        if (counts == k).any() or (k == len(GREYS) and (counts > k).any()):
            more = " or more" * (k == len(GREYS))
            handles.append(Patch(fc=grey, label=f"{k}{more} camera{'s' * (k > 1)}"))
    if (counts == 0).any():
        handles.append(Patch(**HATCH, label="none"))
    add_legend(figure, handles)
    return figure


def draw_differences(remap: RigRemap, apart: np.ndarray) -> Figure:
    """Draws how much cameras differ where they overlap, as `RigRemap.disagreement` returns it."""
    figure = page_figure(6.0 if isinstance(remap.view, GroundView) else 4.2)
    axes = figure.add_subplot()
    missing = np.isnan(apart)
    drawn = _draw_map(axes, remap, np.ma.masked_array(apart, missing), missing, cmap="magma",
                      vmin=0, vmax=np.nanquantile(apart, 0.99))  # fmt: skip
    label = "largest difference of two cameras, of 255"
    figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.7, label=label, extend="max")
    mean = np.nanmean(apart)
    axes.set_title(f"where cameras overlap, {mean:.1f} of 255 in the mean", fontsize=TEXT)
    add_legend(figure, [*_lines(remap.rig), Patch(**HATCH, label="fewer than 2 cameras")])
    return figure


def _colours(rig: Rig) -> dict[str, str]:
    """A colour of each camera."""
    return {
        name: "#" + bytes(c).hex() for name, c in zip(rig.names, palette(len(rig)), strict=True)
    }


def _lines(rig: Rig) -> list[Line2D]:
    """The entries of the legend for the cameras."""
    return [Line2D([], [], color=colour, label=name) for name, colour in _colours(rig).items()]


def _draw_cameras(axes: Axes, rig: Rig, paper: np.ndarray) -> None:
    """Draws the places, the axes and the fields of view of cameras, projected to `paper`."""
    length = 0.6 * max(rig.spread, float(rig.middle @ rig.up) / 2, LEAST)
    axes.plot(0, 0, "+", color="0.4", ms=10)  # the origin
    for name, colour in _colours(rig).items():
        camera = rig[name]
        seen = _rays(camera)
        ends = np.concatenate((np.zeros((1, 3)), seen, [[0, 0, 1]])) * length
        points = (ends @ camera.pose[:3, :3].T + camera.pose[:3, 3]) @ rig.level @ paper
        outline = cv2.convexHull(points.astype(np.float32))[:, 0]
        axes.fill(*outline.T, fc=(colour, 0.15), ec=colour, lw=1)
        axes.plot(*points[[0, -1]].T, color=colour, lw=2)
        axes.plot(*points[0], "o", color=colour, ms=5)
    axes.set_aspect("equal", "datalim")
    axes.margins(0.1)


def _rays(camera: Camera) -> np.ndarray:
    """Unit vectors (K, 3) of a grid in the picture of a camera, without those beyond θ_max."""
    x, y = (np.linspace(-0.5, side - 0.5, RAYS) for side in camera.size[::-1])
    grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1).reshape(1, -1, 2))
    rays = camera.lens.unproject_points(grid, camera.size)[0].numpy()
    return rays[np.isfinite(rays).all(1)]


def _draw_map(
    axes: Axes, remap: RigRemap, image: np.ndarray, outside: np.ndarray, **options
) -> AxesImage:
    """Draws an image of a view, hatched outside, with an outline of what each camera sees."""
    view, names = remap.view, ("yaw (°)", "pitch (°)")
    extent = (-180.0, 180.0, -90.0, 90.0)
    if isinstance(view, GroundView):
        names = ("m to the right", "m ahead")
        (ahead, left), width = view.center, view.span / 2
        height = width * view.size[0] / view.size[1]
        extent = (-left - width, -left + width, ahead - height, ahead + height)
    scale = 255 if image.dtype == np.uint8 else 1
    if image.ndim == 3:
        image = np.dstack((image / scale, ~outside))
    drawn = axes.imshow(image, extent=extent, **options)
    axes.patch.set(**HATCH)
    axes.set(xlabel=names[0], ylabel=names[1])
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(7, steps=[1, 2, 3, 5, 6, 10]))
    for seen, colour in zip(remap.seen_by, _colours(remap.rig).values(), strict=True):
        if seen.any() and not seen.all():
            axes.contour(seen, [0.5], colors=[colour], extent=extent, origin="upper")
    return drawn
