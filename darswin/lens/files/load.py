"""Reading a calibration file of any format, and writing our own."""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from darswin.files import replace_file
from darswin.lens.base import Lens
from darswin.lens.description import MODELS, from_dict, to_dict
from darswin.lens.files import (
    basalt,
    camodocal,
    colmap,
    kalibr,
    nerfstudio,
    ocamcalib,
    opencv,
    own,
    woodscape,
)
from darswin.lens.files.cameras import Description
from darswin.lens.files.content import Content, parse, read_text
from darswin.lens.files.fields import Fields, short

# A curve that lands further out than this, px, is of no use: a pinhole's near 90°.
MAX_RADIUS = 1e6
# A θ_max that was written in another precision may pass the limit by this, rad.
ROUNDING = 1e-4
MAX_CAMERAS = 10_000


@dataclass(frozen=True)
class Format:
    """Attributes: name; fits: whether content is of this format; cameras: its descriptions;
    origin: where the format has the center of the upper left pixel, along both axes. Ours is 0."""

    name: str
    fits: Callable[[Content], bool]
    cameras: Callable[..., dict[str, Description]]
    origin: float
    takes_model: bool = False


# The first that fits is taken.
FORMATS = (
    Format("darswin", own.fits, own.cameras, 0.0),
    Format("WoodScape", woodscape.fits, woodscape.cameras, 0.5),
    Format("basalt", basalt.fits, basalt.cameras, 0.0),
    Format("nerfstudio", nerfstudio.fits, nerfstudio.cameras, 0.5),
    Format("KITTI-360 or CamOdoCal", camodocal.fits, camodocal.cameras, 0.0),
    Format("Kalibr", kalibr.fits, kalibr.cameras, 0.0),
    Format("ROS camera_info", opencv.fits_ros, opencv.cameras, 0.0, takes_model=True),
    Format("OpenCV", opencv.fits, opencv.cameras, 0.0, takes_model=True),
    Format("OCamCalib", ocamcalib.fits, ocamcalib.cameras, 0.0),
    Format("COLMAP", colmap.fits, colmap.cameras, 0.5),
)


def load(
    path: str | os.PathLike,
    *,
    camera: str | int | None = None,
    theta_max: float | None = None,
    image_size: tuple[int, int] | None = None,
    model: str | None = None,
    dtype: torch.dtype | None = None,
) -> Lens:
    """The lens of a calibration file.

    Reads WoodScape, KITTI-360 and CamOdoCal, Kalibr, OpenCV (fisheye, omnidir and pinhole), ROS
    camera_info, OCamCalib, COLMAP, nerfstudio, basalt, and what `save` writes; the format is told
    from the content. The lens has our pixel origin, whatever the file's.

    Args:
        path: the file.
        camera: a name, or a number from 0, of a file with several different cameras.
        theta_max: rad. None means the file's, or the widest of the lens's `side_angles`: the
            corners of the image may see more; or `theta_limit`, where no image size is known.
        image_size: (H, W) px, for a file that does not say it.
        model: "fisheye", "pinhole" or "omnidir": what the coefficients of an OpenCV or ROS file
            are, if it does not say it.
        dtype: of the lens; None means torch's default.

    Raises:
        ValueError: an unknown format, a field that is missing or wrong, several cameras and none
            chosen, a theta_max beyond the lens's limit; it names the file. OSError: the file cannot
            be read.
    """
    return loads(
        _read(path), camera=camera, theta_max=theta_max, image_size=image_size, model=model,
        dtype=dtype, name=os.fspath(path),
    )  # fmt: skip


def loads(
    text: str,
    *,
    camera: str | int | None = None,
    theta_max: float | None = None,
    image_size: tuple[int, int] | None = None,
    model: str | None = None,
    dtype: torch.dtype | None = None,
    name: str = "in a string",
) -> Lens:
    """`load` for a file's text; `name` is what errors call it."""
    cameras, what = _cameras(text, name, model)
    with _about(what):
        chosen = _choose(cameras, camera)
    with _about(what, chosen if len(cameras) > 1 else None):
        return _lens(cameras[chosen], theta_max, image_size, dtype)


def load_all(
    path: str | os.PathLike,
    *,
    theta_max: float | None = None,
    image_size: tuple[int, int] | None = None,
    model: str | None = None,
    dtype: torch.dtype | None = None,
) -> dict[str, Lens]:
    """All cameras of a calibration file by their names. Arguments and errors: as `load`."""
    cameras, what = _cameras(_read(path), os.fspath(path), model)
    lenses: dict[str, Lens] = {}  # by description: frames often repeat one camera
    for name, description in cameras.items():
        if (key := repr(description)) not in lenses:
            with _about(what, name if len(cameras) > 1 else None):
                lenses[key] = _lens(description, theta_max, image_size, dtype)
    return {name: lenses[repr(description)] for name, description in cameras.items()}


def save(lens: Lens, path: str | os.PathLike) -> None:
    """Writes one lens as our own JSON, which `load` and `darswin predict --lens` read.

    Raises:
        ValueError: several lenses, or a lens of a model that is not in `MODELS`.
    """
    replace_file(path, json.dumps(to_dict(lens), indent=2) + "\n")


def _read(path: str | os.PathLike) -> str:
    with _about(f"calibration {os.fspath(path)}"):
        return read_text(path)


def _cameras(text: str, name: str, model: str | None) -> tuple[dict[str, Description], str]:
    """The descriptions in a file, in our pixel origin; and how errors name the file."""
    with _about(f"calibration {name}"):
        content = parse(text)
        file_format = next((f for f in FORMATS if f.fits(content)), None)
        if file_format is None:
            known = ", ".join(f.name for f in FORMATS)
            said = content.get("model") if isinstance(content, Mapping) else None
            raise ValueError(
                f'it must be of one of the formats {known}; darswin\'s own "model" must be one of '
                f"{', '.join(MODELS)}, got {short(said)}"
            )
    what = f"{file_format.name} calibration {name}"
    with _about(what):
        fields = content if isinstance(content, list) else Fields(content)
        if model is None:
            cameras = file_format.cameras(fields)
        elif not file_format.takes_model:
            raise ValueError(f"its cameras say their model, but model={model!r} was given")
        elif model not in opencv.MODELS:
            raise ValueError(f"model must be one of {', '.join(opencv.MODELS)}, got {model!r}")
        else:
            cameras = file_format.cameras(fields, model)
        if not 1 <= len(cameras) <= MAX_CAMERAS:
            raise ValueError(f"it must have 1 to {MAX_CAMERAS} cameras, got {len(cameras)}")
        for description in cameras.values():
            if "center" in description:
                description["center"] = [c - file_format.origin for c in description["center"]]
    return cameras, what


def _choose(cameras: dict[str, Description], camera: str | int | None) -> str:
    names = list(cameras)
    shown = ", ".join(short(name) for name in names[:20]) + (", …" if len(names) > 20 else "")
    if camera is None:
        first = cameras[names[0]]
        if any(description != first for description in cameras.values()):
            raise ValueError(f"it has several cameras, choose one as camera=: {shown}")
        return names[0]
    if isinstance(camera, int) and 0 <= camera < len(names):
        return names[camera]
    if camera not in cameras:
        raise ValueError(f"camera must be one of {shown}, or its number, got {camera!r}")
    return camera


def _lens(
    description: Description,
    theta_max: float | None,
    image_size: tuple[int, int] | None,
    dtype: torch.dtype | None,
) -> Lens:
    """The lens of a description, used as far as `load` says."""
    dtype = dtype or torch.get_default_dtype()
    description = dict(description)
    if image_size is not None:
        description.setdefault("image_size", list(image_size))
    if theta_max is None:
        theta_max = description.pop("theta_max", None)
    values = {
        name: torch.tensor(value, dtype=dtype) if isinstance(value, (int, float, list)) else value
        for name, value in description.items()
        if name != "theta_max"
    }
    lens = from_dict(values, description.get("image_size"))
    limit = lens.theta_max
    if theta_max is not None:
        wanted = torch.tensor([theta_max], dtype=dtype)
        rounded = (limit < wanted) & (wanted <= limit + ROUNDING)
        lens = lens.with_theta_max(torch.where(rounded, limit, wanted))
    elif "image_size" in description and "fov" not in description:
        lens = lens.with_theta_max(torch.minimum(lens.side_angles().amax(1), limit))
    _check(lens, math.inf if theta_max is not None else MAX_RADIUS)
    return lens


def _check(lens: Lens, most: float) -> None:
    """That rays land at finite places, and within `most` px of the center."""
    theta = lens.theta_max[0] * torch.linspace(0, 1, 33, dtype=lens.theta_max.dtype)
    azimuth = torch.linspace(0, 2 * math.pi, 5, dtype=theta.dtype)[:4]
    pixels = lens.project_rays(theta[:, None].expand(33, 4), azimuth.expand(33, 4), (1, 1))
    reach = pixels.abs().amax().item()
    if not (reach <= most and math.isfinite(reach)):
        raise ValueError(
            f"up to theta_max = {lens.theta_max.item():.4f} rad rays must land at most "
            f"{MAX_RADIUS:g} px away, got {reach:.3g} px: give a smaller theta_max, or the "
            "image_size if the file has none"
        )


@contextmanager
def _about(what: str, camera: str | None = None) -> Iterator[None]:
    """Errors within name the file, and the camera."""
    try:
        yield
    except ValueError as error:
        which = "" if camera is None else f"camera {short(camera)}: "
        raise ValueError(f"{what}: {which}{error}") from error
