"""Draws docs/rig_axes.png, the axes of the files of rigs and the directions of their poses.

Run it with `.venv/bin/python docs/rig_axes.py`.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from darswin.viz.plot import TEXT, page_figure, save_figure

# On the page, for a car that drives to the right: its left side is away from the viewer.
FORWARD, LEFT, UP = np.array((1.0, 0.0)), np.array((0.45, 0.4)), np.array((0.0, 1.0))
AXES = {
    "camera": {"x": -LEFT, "y": -UP, "z": FORWARD},
    "ISO 8855": {"x": FORWARD, "y": LEFT, "z": UP},
    "IMU": {"x": FORWARD, "y": -LEFT, "z": -UP},
    "rig": {"": UP},  # its axes are free; the file says what is up
}
COLORS = {"x": "tab:red", "y": "tab:green", "z": "tab:blue", "": "0.4"}


class Panel(NamedTuple):
    """Frames: their names and axes, from left to right. Poses: from one frame to another."""

    title: str
    frames: tuple[tuple[str, str], ...]
    poses: tuple[tuple[int, int, str], ...]


THREE = (("cam0 = rig", "camera"), ("cam1", "camera"), ("cam2", "camera"))
PANELS = (
    Panel("Kalibr", THREE, ((0, 1, "T_cn_cnm1"), (1, 2, "T_cn_cnm1"))),
    Panel("Kalibr with an IMU", (("IMU = rig", "rig"), ("cam0", "camera")), ((0, 1, "T_cam_imu"),)),
    Panel("OpenCV calibrateMultiview", THREE, ((0, 1, "R, T"), (0, 2, "R, T"))),
    Panel("COLMAP rig_config.json", (("ref_sensor = rig", "camera"), ("camera", "camera")),
          ((0, 1, "cam_from_rig"),)),
    Panel("WoodScape", (("vehicle = rig", "ISO 8855"), ("camera", "camera")),
          ((1, 0, "extrinsic"),)),
    Panel("KITTI-360", (("GPS/IMU = rig", "IMU"), ("camera", "camera")),
          ((1, 0, "calib_cam_to_pose"),)),
    Panel("darswin", (("rig", "rig"), ("camera", "camera")), ((1, 0, "pose"),)),
)  # fmt: skip


def draw_axes(axes: Axes, panel: Panel) -> None:
    """One panel: a cross of axes for each frame, and an arrow for each pose."""
    places = np.linspace(0, 6, len(panel.frames))
    for (name, kind), at in zip(panel.frames, places, strict=True):
        start = np.array((at, 0.0))
        for letter, direction in AXES[kind].items():
            color, end = COLORS[letter], start + direction
            arrow = dict(arrowstyle="-|>", color=color, shrinkA=0, shrinkB=0, linewidth=1.5)
            axes.annotate("", end, start, arrowprops=arrow)
            mark = letter or "up"
            axes.text(*(end + 0.3 * direction), mark, color=color, ha="center", va="center")
        axes.text(at, -2.2, name, ha="center", fontsize=TEXT)
    for k, (of, to, label) in enumerate(panel.poses):
        height = 1.6 + 0.7 * sum(of == other for other, _, _ in panel.poses[:k])
        ends = np.array([(places[of], height), (places[to], height)])
        axes.annotate("", ends[1], ends[0], arrowprops=dict(arrowstyle="->", linewidth=1.2))
        axes.text(ends[:, 0].mean(), height + 0.15, label, ha="center", fontsize=TEXT)
    axes.set_title(panel.title, fontsize=TEXT, fontweight="bold")
    axes.set(xlim=(-1.9, 7.9), ylim=(-2.6, 3.1), aspect="equal")
    axes.axis("off")


def draw_rigs() -> Figure:
    """All files; an arrow leads from the frame of a point to the one in which the pose has it."""
    figure = page_figure(8.2)
    grid = figure.subplots(4, 2).ravel()
    for axes, panel in zip(grid, PANELS, strict=False):
        draw_axes(axes, panel)
    grid[-1].axis("off")
    words = "A camera's axes:\nx right, y down, z forward.\nAll look to the right.\n" \
        "Black arrows: from where to\nwhere a pose takes points."  # fmt: skip
    grid[-1].text(0.02, 0.5, words, va="center", fontsize=TEXT, transform=grid[-1].transAxes)
    return figure


if __name__ == "__main__":
    save_figure(draw_rigs(), Path(__file__).parent / "rig_axes.png", colors=64)
