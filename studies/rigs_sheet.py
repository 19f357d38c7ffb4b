"""The figure of the study of rigs."""

from pathlib import Path

import cv2
import rigs_cameras as cameras
import rigs_faces as faces
from rigs_peers import Table, read
from rigs_scene import rays_of, room, street

from darswin import Rig
from darswin.views import CameraView, GroundView
from darswin.viz.plot import page_figure, save_figure

SIDE, WRONG = 1024, 2.0  # px; degrees


def draw(out: Path, path: Path) -> None:
    """Draws a fisheye picture by nearest pixels and by darswin, and the ground around a car with
    the right rig and with a wrong one."""
    lens = faces.fisheye(faces.SIZE, faces.SIZE[0] / 2)
    frames = [faces.as_frame(of.colour) for of in faces.cube(out, room(), "room", SIDE, 1)]
    table = Table(rays_of(lens, faces.SIZE), faces.SIZE, SIDE)
    pictures = [
        read(frames, table, cv2.INTER_NEAREST),
        CameraView(lens, faces.SIZE).at(Rig.cube(SIDE))(frames),
    ]
    lens = faces.fisheye(cameras.CAR, cameras.CAR[1] / 2, cameras.CAR_FOV)
    seen = cameras.frames_of(out, "car", street(), cameras.car(lens), False)
    view = GroundView((256, 256), span=cameras.SPAN, center=cameras.CENTER)
    for yaw in (0.0, WRONG):
        pictures.append(view.at(cameras.car(lens, yaw), seam="narrow")(seen))
    figure = page_figure(1.5)
    for axes, picture in zip(figure.subplots(1, len(pictures)), pictures, strict=True):
        axes.imshow(picture, interpolation="nearest")
        axes.axis("off")
    save_figure(figure, path, colors=256)
