"""`darswin lens`: draws, describes or converts a calibrated lens."""

import math
from typing import Literal

import torch
from jsonargparse import auto_cli

import darswin.lens
from darswin import views
from darswin.data.sources import read_image
from darswin.grid import Spacing
from darswin.layers import PolarSample
from darswin.lens.base import Lens
from darswin.lens.files.load import Calibration, reach
from darswin.lens.report import describe
from darswin.plot import draw_lens, save_figure

Coefficients = Literal["fisheye", "pinhole", "omnidir"]
Format = Literal["darswin", "opencv", "colmap", "kalibr"]
View = Literal["perspective", "cylindrical", "equirectangular"]
VIEW_WIDTH = 800  # px


def run(argv: list[str]) -> None:
    """Runs `darswin lens` with the arguments that follow it."""
    commands = {"show": show, "info": info, "convert": convert}
    auto_cli(commands, args=argv, prog="darswin lens", fail_untyped=False)


def show(
    calib: str, image: str, out: str = "lens.png", rings: int = 16, sectors: int = 64,
    samples: tuple[int, int] = (10, 10), spacing: Spacing = "theta",
    view: View = "perspective", fov_deg: float | None = None, yaw_deg: float = 0.0,
    pitch_deg: float = 0.0, theta_max_deg: float | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Draws what a lens does to a picture: partition, samples, polar image, an undistorted view.

    Args:
        calib: a calibration file, of any format that darswin.lens.load reads.
        image: a picture that the camera took.
        out: the PNG file to write.
        rings: of the partition.
        sectors: of the partition.
        samples: along radius and azimuth, in each patch.
        spacing: what the rings split equally.
        view: the kind of the undistorted view.
        fov_deg: its horizontal field of view; without it what the picture shows, in a perspective
            view 110° at most.
        yaw_deg: how far it looks to the right.
        pitch_deg: how far it looks up.
        theta_max_deg: where the last ring ends; without it as far as picture and lens reach.
        camera: which one, in a file of several.
        coefficients: what they are, in an OpenCV or ROS file that does not say it.
    """
    picture = read_image(image)
    size = picture.shape[:2]
    lens = _load(calib, camera, theta_max_deg, size, coefficients).in_picture(size)
    sampler = PolarSample(rings, sectors, samples, spacing=spacing)
    across, down = _fields_of_view(lens, size)
    if fov_deg is None:
        fov_deg = min(across, 110) if view == "perspective" else across
    height = {
        "perspective": VIEW_WIDTH * size[0] / size[1],
        "cylindrical": VIEW_WIDTH / 2,
        "equirectangular": VIEW_WIDTH * down / fov_deg,
    }[view]
    fov, yaw, pitch = (math.radians(angle) for angle in (fov_deg, yaw_deg, pitch_deg))
    rays = getattr(views, view)((round(height), VIEW_WIDTH), fov, yaw=yaw, pitch=pitch)
    title = f"{view} view, {fov_deg:.0f}° across"
    save_figure(draw_lens(picture, lens, sampler, rays, title), out)
    print(out)


def info(
    calib: str, image_size: tuple[int, int] | None = None, rings: int = 16, sectors: int = 64,
    theta_max_deg: float | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Prints what a lens shows: field of view, pixels per degree, and which spacing fits.

    Args:
        calib: a calibration file, of any format that darswin.lens.load reads.
        image_size: height and width, px, where the file does not say it.
        rings: of the partition.
        sectors: of the partition.
        theta_max_deg: where the last ring ends; without it as far as image and lens reach.
        camera: which one, in a file of several.
        coefficients: what they are, in an OpenCV or ROS file that does not say it.
    """
    file = Calibration.read(calib, coefficients)
    lens = _load(calib, camera, theta_max_deg, image_size, coefficients)
    origin = f"({file.format.origin:g}, {file.format.origin:g})"
    print(f"{'format':<16}{file.format.name}, with the centre of the upper left pixel at {origin}")
    if len(file.names) > 1:
        names = ", ".join(file.names[:20]) + ", …" * (len(file.names) > 20)
        print(f"{'camera':<16}{file.choose(camera)}, of {len(file.names)}: {names}")
    print(describe(lens, rings=rings, sectors=sectors))


def convert(
    calib: str, out: str, model: str | None = None, theta_max_deg: float | None = None,
    image_size: tuple[int, int] | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None, format: Format | None = None,
) -> None:  # fmt: skip
    """Writes a calibration as a file of darswin, OpenCV, COLMAP or Kalibr, or another model's.

    Args:
        calib: a calibration file, of any format that darswin.lens.load reads.
        out: the file to write.
        model: a name of darswin.lens.MODELS; without it the model stays.
        theta_max_deg: how far the lens is used; without it as far as image and lens reach.
        image_size: height and width, px, where the file does not say it.
        camera: which one, in a file of several.
        coefficients: what they are, in an OpenCV or ROS file that does not say it.
        format: of the file; without it OpenCV for .xml, .yaml and .yml, but Kalibr where the name
            has "camchain" or "kalibr"; COLMAP for .txt; else darswin, whose JSON holds any lens.
    """
    lens = _load(calib, camera, theta_max_deg, image_size, coefficients)
    note = ""
    if model is not None:
        lens, error = darswin.lens.fit(model, lens)
        note = f", at most {error.item():.2g} px from {calib}"
    written = darswin.lens.save(lens, out, format)
    degrees = math.degrees(lens.theta_max.item())
    if written != "darswin" and bool(
        (lens.theta_max - reach(lens.with_theta_max(None))).abs() > 1e-6
    ):
        note += f"; {written} files do not say how far: read it with --theta_max_deg {degrees:.2f}"
    print(f"{out}: {written}, {type(lens).__name__} up to {degrees:.2f}°{note}")


def _load(
    calib: str,
    camera: str | None,
    theta_max_deg: float | None,
    image_size: tuple[int, int] | None,
    coefficients: str | None,
) -> Lens:
    return darswin.lens.load(
        calib,
        camera=camera,
        theta_max=None if theta_max_deg is None else math.radians(theta_max_deg),
        image_size=image_size,
        model=coefficients,
        dtype=torch.float64,
    )


def _fields_of_view(lens: Lens, size: tuple[int, int]) -> tuple[float, float]:
    """Of the lens up to θ_max in a picture of (H, W): across and down, degrees."""
    angles = torch.rad2deg(lens.side_angles(size).minimum(lens.theta_max[:, None]))[0]
    return angles[::2].sum().item(), angles[1::2].sum().clamp(max=180).item()
