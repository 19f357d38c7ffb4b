"""`darswin lens`: draws, describes or converts a calibrated lens."""

import math
from typing import Literal

import torch

import darswin.lens
from darswin.layers.polar import PolarSample
from darswin.lens.base import Lens
from darswin.lens.files.load import Calibration, reach
from darswin.lens.files.opencv import Coefficients
from darswin.lens.orientation import in_upright_picture, stored_size
from darswin.lens.spacing import Spacing
from darswin.viz.report import describe, sides

Format = Literal["darswin", "opencv", "colmap", "kalibr"]
View = Literal["perspective", "cylindrical", "equirectangular"]
VIEW_SIDE = 800  # px, the longer one
# More than a picture can show: rings, sectors, samples along each side of a patch, and in all.
MOST = {"rings": 1024, "sectors": 4096, "samples": 256}
MOST_SAMPLES = 2**22
MOST_LISTED = 20  # cameras


def show(
    calib: str, image: str, *, out: str = "lens.png", rings: int = 16, sectors: int = 64,
    samples: tuple[int, int] = (10, 10), spacing: Spacing = "theta",
    view: View = "perspective", fov_deg: float | None = None, yaw_deg: float = 0.0,
    pitch_deg: float = 0.0, theta_max_deg: float | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Draws what a lens does to a picture: partition, samples, polar image, an undistorted view.

    Args:
        calib: a calibration file, of any format that darswin.lens.load reads.
        image: a picture that the camera took.
        out: the file to write: png, jpg, webp, tif, pdf or svg, as its name ends.
        rings: of the partition.
        sectors: of the partition.
        samples: along radius and azimuth, in each patch, e.g. 10,10.
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
    # Only `show` needs OpenCV and matplotlib. To import them takes a second.
    from darswin.utils.image import read_oriented
    from darswin.viz import views
    from darswin.viz.plot import draw_lens, figure_format, save_figure

    figure_format(out)
    _check_partition(rings, sectors, samples)
    for name, angle in (("yaw_deg", yaw_deg), ("pitch_deg", pitch_deg)):
        _check(name, angle, math.isfinite(angle), "a finite number of degrees")
    if fov_deg is not None:
        flat = view == "perspective"
        most = "below 180°" if flat else "at most 360°"
        in_range = 0 < fov_deg < 180 if flat else 0 < fov_deg <= 360
        _check("fov_deg", fov_deg, in_range, f"above 0° and {most} in a view that is {view}")
    picture, orientation = read_oriented(image)
    size = picture.shape[:2]
    stored = stored_size(size, orientation)
    file, theta_max = _calibration(calib, theta_max_deg, stored, coefficients)
    lens = file.lens(camera, theta_max, stored, torch.float64)
    lens = in_upright_picture(lens, size, orientation)
    sampler = PolarSample(rings, sectors, samples, spacing=spacing)
    across, down = _fields_of_view(lens, size)
    if fov_deg is None:
        fov_deg = min(across, 110) if view == "perspective" else across
        if not fov_deg > 0:
            raise ValueError(
                "the picture shows nothing on the row of the lens's principal point: choose the "
                "view with `fov_deg` and `yaw_deg`"
            )
    aspect = {
        "perspective": size[0] / size[1],
        "cylindrical": 1 / 2,
        # As high as what the lens shows in the picture; a narrower view keeps that shape.
        "equirectangular": down / max(fov_deg, across),
    }[view]
    fov, yaw, pitch = (math.radians(angle) for angle in (fov_deg, yaw_deg, pitch_deg))
    longer = max(aspect, 1.0)
    view_size = (max(1, round(VIEW_SIDE * aspect / longer)), max(1, round(VIEW_SIDE / longer)))
    rays = getattr(views, view)(view_size, fov, yaw=yaw, pitch=pitch)
    title = f"{view} view, {fov_deg:.4g}° across\nyaw {yaw_deg:.4g}°, pitch {pitch_deg:.4g}°"
    save_figure(draw_lens(picture, lens, sampler, rays, title), out)
    print(out)


def info(
    calib: str, *, image_size: tuple[int, int] | None = None, rings: int = 16, sectors: int = 64,
    theta_max_deg: float | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Prints what a lens shows: field of view, pixels per degree, and which spacing fits.

    Args:
        calib: a calibration file, of any format that darswin.lens.load reads.
        image_size: height and width, px, e.g. 960,1280, where the file does not say it.
        rings: of the partition.
        sectors: of the partition.
        theta_max_deg: where the last ring ends; without it as far as image and lens reach.
        camera: which one, in a file of several.
        coefficients: what they are, in an OpenCV or ROS file that does not say it.
    """
    _check_partition(rings, sectors)
    file, theta_max = _calibration(calib, theta_max_deg, image_size, coefficients)
    origin = f"({file.format.origin:g}, {file.format.origin:g})"
    rows = [
        f"{'format':<16}{file.format.name}, with the centre of the upper left pixel at {origin}"
    ]
    names = file.names[:MOST_LISTED]
    more = len(file.names) - len(names)
    if camera is None and file.has_several():
        rows.append(f"{'cameras':<16}{len(file.names)}; to describe one, give its name as --camera")
        rows += [
            f"  {name:<14}{_in_short(file.lens(name, theta_max, image_size))}" for name in names
        ]
        rows += [f"  and {more} more"] if more else []
    else:
        lens = file.lens(camera, theta_max, image_size, torch.float64)
        if lens.image_size is None:
            raise ValueError(
                f"{calib} does not say how large its images are: give `image_size`, their height "
                "and width, e.g. 960,1280"
            )
        if len(file.names) > 1:
            listed = ", ".join(names) + ", …" * bool(more)
            rows.append(f"{'camera':<16}{file.choose(camera)}, of {len(file.names)}: {listed}")
        rows.append(describe(lens, rings=rings, sectors=sectors))
    print(*rows, sep="\n")


def _in_short(lens: Lens) -> str:
    size = ""
    if lens.image_size is not None:
        height, width = (round(side) for side in lens.image_size[0].tolist())
        size = f", {width} × {height} px"
    return f"{type(lens).__name__}{size}, up to {math.degrees(lens.theta_max.item()):.2f}°"


def convert(
    calib: str, out: str, *, model: str | None = None, theta_max_deg: float | None = None,
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
    file, theta_max = _calibration(calib, theta_max_deg, image_size, coefficients)
    lens = file.lens(camera, theta_max, image_size, torch.float64)
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


def _calibration(
    calib: str,
    theta_max_deg: float | None,
    image_size: tuple[int, int] | None,
    coefficients: str | None,
) -> tuple[Calibration, float | None]:
    """The file, and θ_max in radians; ValueError for options out of their ranges."""
    for side in image_size or ():
        _check("image_size", side, 1 <= side <= 10**6, "from 1 to 1000000 px")
    if theta_max_deg is not None:
        in_range = 0 < theta_max_deg <= 180
        _check("theta_max_deg", theta_max_deg, in_range, "above 0° and at most 180°")
    file = Calibration.read(calib, coefficients)
    return file, None if theta_max_deg is None else math.radians(theta_max_deg)


def _check(name: str, value: float, ok: bool, range_: str) -> None:
    if not ok:
        raise ValueError(f"`{name}` must be {range_}, got {str(value)[:40]}")


def _check_partition(rings: int, sectors: int, samples: tuple[int, int] = (1, 1)) -> None:
    """ValueError for more than a picture can show, before memory is asked for it."""
    given = (("rings", rings), ("sectors", sectors), *(("samples", count) for count in samples))
    for name, value in given:
        _check(name, value, 1 <= value <= MOST[name], f"from 1 to {MOST[name]}")
    if (total := rings * sectors * math.prod(samples)) > MOST_SAMPLES:
        raise ValueError(
            f"`rings` × `sectors` × `samples` must be at most {MOST_SAMPLES} samples, got {total}"
        )


def _fields_of_view(lens: Lens, size: tuple[int, int]) -> tuple[float, float]:
    """Horizontal and vertical field of view up to θ_max in a picture (H, W), in degrees."""
    end = lens.theta_max.item()
    angles = torch.rad2deg(sides(lens, size).clamp(-end, end))
    return min(angles[::2].sum().item(), 360.0), angles[1::2].sum().clamp(max=180).item()


COMMANDS = {"show": show, "info": info, "convert": convert}
