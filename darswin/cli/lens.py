"""`darswin lens`: makes, draws, describes, converts and crops a camera calibration."""

import math

import torch

from darswin.cli.arguments import check_out
from darswin.cli.calibrate import Format, calibrate, check_lens_out, supported_part, write_lens
from darswin.cli.estimate import estimate
from darswin.cli.undistort import undistort
from darswin.cli.views import Look, Up
from darswin.lens.base import Lens
from darswin.lens.files.load import Calibration
from darswin.lens.files.reader import Coefficients
from darswin.lens.files.save import closest
from darswin.lens.orientation import in_upright_picture, stored_size
from darswin.lens.spacing import Spacing
from darswin.utils.parameters import check
from darswin.utils.words import in_px
from darswin.views import PolarView
from darswin.viz.report import describe

VIEW_SIDE = 800  # px, the longer one
# The limits of rings, sectors, samples along each side of a patch, and samples in total.
MOST = {"rings": 1024, "sectors": 4096, "samples": 256}
MOST_SAMPLES = 2**22
MOST_LISTED = 20  # cameras
_SIDES = "from 1 to 1000000 px"


def show(
    calib: str, image: str, *, out: str = "lens.png", rings: int = 16, sectors: int = 64,
    samples: tuple[int, int] = (10, 10), spacing: Spacing = "theta",
    view: str = "perspective", fov_deg: float | None = None, yaw_deg: float = 0.0,
    pitch_deg: float = 0.0, up: Up | None = None, theta_max_deg: float | None = None,
    camera: str | None = None, coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Draws a picture with its polar partition, its polar image, and an undistorted view.

    Args:
        image: a picture of this camera.
        out: the file to write; its ending names the format: png, jpg, webp, tif, pdf or svg.
        samples: the numbers of samples in each patch along radius and azimuth, e.g. 10,10.
        spacing: the quantity that the rings divide into equal parts.
        view: the projection of the undistorted view: see `darswin lens undistort`.
        fov_deg: the horizontal field of view of the undistorted view, between the outer edges of a
            row, in degrees. The default is all that the picture shows; for a perspective view, 100°
            at most; for a panorama, 360°.
        yaw_deg: the angle that the undistorted view looks to the right, in degrees.
        pitch_deg: the angle that the undistorted view looks up, in degrees.
        up: the direction away from gravity, for the undistorted view: see `darswin lens undistort`.
    """
    # Only `show` needs OpenCV and matplotlib, whose import takes a second.
    from darswin.utils.image import read_oriented
    from darswin.viz.plot import draw_lens, figure_format, save_figure

    figure_format(out)
    check_out(out, (calib, image))
    _check_partition(rings, sectors, samples)
    look = Look(view, fov_deg, yaw_deg, pitch_deg, up)
    look.check()
    picture, orientation = read_oriented(image)
    size = picture.shape[:2]
    stored = stored_size(size, orientation)
    file, theta_max = _calibration(calib, theta_max_deg, stored, coefficients)
    lens = file.lens(camera, theta_max, stored, torch.float64)
    lens = in_upright_picture(lens, size, orientation)
    sampler = PolarView(rings, sectors, samples, spacing=spacing)
    fov_deg, view_size = look.shape(lens, size, VIEW_SIDE)
    title = f"{view} view, {fov_deg:.4g}° across\nyaw {yaw_deg:.4g}°, pitch {pitch_deg:.4g}°"
    shown = look.make(view_size, fov_deg)
    save_figure(draw_lens(picture, lens, sampler, shown, title, file.supported()), out)
    print(out)


def info(
    calib: str, *, image_size: tuple[int, int] | None = None, rings: int = 16, sectors: int = 64,
    theta_max_deg: float | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None,
) -> None:  # fmt: skip
    """Prints the field of view of a lens, its pixels per degree, and the best spacing.

    A line says what looks wrong, such as lengths in another unit than pixels, and what would fit.

    Args:
        camera: the name or number of the camera, if the file has several. Without it, all
            cameras are listed.
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
            f"  {name:<14}{_in_short(*file.judged(name, theta_max, image_size))}" for name in names
        ]
        rows += [f"  and {more} more"] if more else []
    else:
        lens, doubt = file.judged(camera, theta_max, image_size, torch.float64)
        if lens.image_size is None:
            raise ValueError(
                f"{calib} lacks the size of its images: give --image_size, their height and width, "
                "e.g. 960,1280"
            )
        if len(file.names) > 1:
            listed = ", ".join(names) + ", …" * bool(more)
            rows.append(f"{'camera':<16}{file.choose(camera)}, of {len(file.names)}: {listed}")
        rows += [f"{'looks wrong':<16}{doubt}"] if doubt else []
        if (supported := file.supported()) is not None:
            rows.append(f"{'supported':<16}{supported_part(supported, lens)}")
        rows.append(describe(lens, rings=rings, sectors=sectors))
    print(*rows, sep="\n")


def _in_short(lens: Lens, doubt: str) -> str:
    size = "" if lens.image_size is None else f", {in_px(lens.image_size[0])}"
    wrong = f"; looks wrong: {doubt}" if doubt else ""
    return f"{type(lens).__name__}{size}, up to {math.degrees(lens.theta_max.item()):.2f}°{wrong}"


def convert(
    calib: str, out: str, *, model: str | None = None, theta_max_deg: float | None = None,
    image_size: tuple[int, int] | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None, format: Format | None = None,
) -> None:  # fmt: skip
    """Converts a calibration to another format, or to another lens model.

    Args:
        out: the file to write.
        model: the lens model to fit, a name of darswin.lens.MODELS. Terms that the model or the
            format cannot hold are left out; the command prints how far the lens then is from the
            given one. The default keeps the model.
        format: the format of the new file. The default is OpenCV for .xml, .yaml and .yml, but
            Kalibr if the name contains "camchain" or "kalibr"; COLMAP for .txt; and for .json that
            of darswin, which can hold any lens.
    """
    check_lens_out(out, (calib,), format)
    file, theta_max = _calibration(calib, theta_max_deg, image_size, coefficients)
    lens = file.lens(camera, theta_max, image_size, torch.float64)
    note = ""
    if model is not None:
        exact = lens
        lens, error = closest(model, exact, out, format)
        note = f", at most {error.item():.2g} px from {calib}{_dropped(lens, exact)}"
    write_lens(lens, out, format, note, file.supported())


def _dropped(lens: Lens, exact: Lens) -> str:
    """The parts of a lens that a lens of another model or format does not have, in words."""
    parts = [
        f"{name} terms"
        for name in ("tangential", "prism")
        if getattr(exact, name, None) is not None and getattr(lens, name, None) is None
    ]
    if exact.affine is not None and not torch.equal(lens.affine, exact.affine):
        parts.append("skew")
    return f", whose {' and '.join(parts)} it leaves out" if parts else ""


def crop(
    calib: str, out: str, *, box: tuple[int, int, int, int] | None = None,
    size: tuple[int, int] | None = None, theta_max_deg: float | None = None,
    image_size: tuple[int, int] | None = None, camera: str | None = None,
    coefficients: Coefficients | None = None, format: Format | None = None,
) -> None:  # fmt: skip
    """Writes the calibration of cropped or resized pictures. The pictures themselves are not read.

    Args:
        out: the file to write.
        box: the part of the picture that is kept, as top, left, height and width in px, e.g.
            0,160,960,960. A box beyond the picture means padding.
        size: the height and width in px to which the picture, or its part, is then resized.
        format: the format of the new file, as for `darswin lens convert`.
    """
    if box is None and size is None:
        raise ValueError("missing --box or --size: give the part to keep, or the new size, or both")
    for name, sides in (("box", (box or ())[2:]), ("size", size or ())):
        for side in sides:
            check(name, side, 1 <= side <= 10**6, _SIDES)
    check_lens_out(out, (calib,), format)
    file, theta_max = _calibration(calib, theta_max_deg, image_size, coefficients)
    lens, note = file.lens(camera, theta_max, image_size, torch.float64), ""
    if box is not None:
        note = _check_box(box, lens)
        lens = lens.cropped(*box)
    if size is not None:
        before, lens = lens.image_size, lens.resized(size)
        if lens.affine is not None and before is not None:
            note += f"; {in_px(before[0])} became {in_px(size)}"
    write_lens(lens, out, format, note, file.supported())


def _check_box(box: tuple[int, int, int, int], lens: Lens) -> str:
    """A note on a box beyond the pictures of a lens; ValueError for a box beside them."""
    if lens.image_size is None:
        return ""
    top, left, height, width = box
    rows, columns = (round(side) for side in lens.image_size[0].tolist())
    meets = -height < top < rows and -width < left < columns
    picture = f"the picture of {in_px((rows, columns))}"
    check("box", box, meets, f"a part of {picture}")
    inside = min(top, left) >= 0 and top + height <= rows and left + width <= columns
    return "" if inside else f"; the box extends beyond {picture}, which means padding"


def _calibration(
    calib: str,
    theta_max_deg: float | None,
    image_size: tuple[int, int] | None,
    coefficients: str | None,
) -> tuple[Calibration, float | None]:
    """The file, and θ_max in radians; ValueError for an option out of its range."""
    for side in image_size or ():
        check("image_size", side, 1 <= side <= 10**6, _SIDES)
    if theta_max_deg is not None:
        in_range = 0 < theta_max_deg <= 180
        check("theta_max_deg", theta_max_deg, in_range, "above 0° and at most 180°")
    file = Calibration.read(calib, coefficients)
    return file, None if theta_max_deg is None else math.radians(theta_max_deg)


def _check_partition(rings: int, sectors: int, samples: tuple[int, int] = (1, 1)) -> None:
    """ValueError for numbers beyond the limits, before memory is allocated."""
    given = (("rings", rings), ("sectors", sectors), *(("samples", count) for count in samples))
    for name, value in given:
        check(name, value, 1 <= value <= MOST[name], f"from 1 to {MOST[name]}")
    if (total := rings * sectors * math.prod(samples)) > MOST_SAMPLES:
        raise ValueError(
            f"--rings × --sectors × --samples must be at most {MOST_SAMPLES} samples, got {total}"
        )


COMMANDS = {
    "show": show, "info": info, "convert": convert, "crop": crop, "calibrate": calibrate,
    "estimate": estimate, "undistort": undistort,
}  # fmt: skip
