"""Writing one lens: as our own JSON, or as a file of another tool."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from darswin.lens.base import Lens, to_dict
from darswin.lens.files import colmap, kalibr, opencv
from darswin.lens.files.cameras import Camera, camera_of
from darswin.utils.files import replace_file


class Writer(NamedTuple):
    """Attributes: name, and what it holds, in errors; origin: as `Format`; write: makes the text of
    a camera and the file's suffix, or None if the format has no such camera."""

    name: str
    holds: str
    origin: float
    write: Callable[[Camera, str], str | None]


# Beside our own, for `save`.
WRITERS = {
    "opencv": Writer(
        "OpenCV",
        "Perspective and BrownConrady (3 radial, no skew), Equidistant and KannalaBrandt (4 radial "
        "only), Spherical and Mei (2 radial, tangential)",
        0.0,
        opencv.write,
    ),
    "colmap": Writer(
        "COLMAP",
        "without skew, Perspective and BrownConrady (3 radial, no prism), Equidistant and "
        "KannalaBrandt (4 radial), Fisheye624 (6 radial), FieldOfView and EnhancedUnified",
        0.5,
        lambda camera, suffix: colmap.write(camera),
    ),
    "kalibr": Writer(
        "Kalibr",
        "without skew, Perspective and BrownConrady (2 radial, tangential), Equidistant and "
        "KannalaBrandt (4 radial only), FieldOfView, Spherical and Mei (2 radial, tangential), "
        "DoubleSphere and EnhancedUnified",
        0.0,
        lambda camera, suffix: kalibr.write(camera),
    ),
}


def save(lens: Lens, path: str | os.PathLike, format: str | None = None) -> str:
    """Writes one lens as a file that `load` reads, and `darswin predict --lens`.

    Our own JSON holds any lens. The other formats hold those of their own models, all but θ_max:
    `load` finds it from the image's sides.

    Args:
        format: "darswin", "opencv", "colmap" or "kalibr". None tells it from the path: OpenCV's for
            .xml, .yaml and .yml, but Kalibr's where the name has "camchain" or "kalibr"; COLMAP's
            for .txt; else ours.

    Returns:
        The format.

    Raises:
        ValueError: several lenses, a lens of a model that is not in `MODELS`, or one that the
            format cannot hold exactly.
    """
    path = Path(path)
    format = format_of(path) if format is None else format
    if format == "darswin":
        text = json.dumps(to_dict(lens), indent=2, allow_nan=False) + "\n"
    elif format in WRITERS:
        text = _written(lens, WRITERS[format], path.suffix.lower())
    else:
        raise ValueError(f"format must be darswin, {', '.join(WRITERS)} or None, got {format!r}")
    replace_file(path, text)
    return format


def format_of(path: Path) -> str:
    """The format that a file's name asks for."""
    if path.suffix.lower() in (".yaml", ".yml") and re.search("camchain|kalibr", path.stem.lower()):
        return "kalibr"
    by_suffix = {".xml": "opencv", ".yaml": "opencv", ".yml": "opencv", ".txt": "colmap"}
    return by_suffix.get(path.suffix.lower(), "darswin")


def _written(lens: Lens, writer: Writer, suffix: str) -> str:
    camera = camera_of(lens, writer.origin)
    text = None if camera is None else writer.write(camera, suffix)
    if text is None:
        raise ValueError(
            f"{writer.name} has no exact place for this {type(lens).__name__} lens; it holds "
            f"{writer.holds}. darswin.lens.fit, or --model, finds the closest lens of another model"
        )
    return text
