"""Writes calibration files."""

import itertools
import math
import os
import re
import warnings
from pathlib import Path

import torch
from torch import Tensor

from darswin.lens.base import Lens
from darswin.lens.distorted import DistortedLens
from darswin.lens.files import colmap, opencv
from darswin.lens.files.format import Format
from darswin.lens.files.named import KALIBR
from darswin.lens.files.own import Own
from darswin.lens.fitting import Fit, fit, largest_distance
from darswin.utils.files import replace_file
from darswin.utils.parameters import naming

# The formats that `save` writes.
WRITTEN: dict[str, Format] = {
    "darswin": Own(), "opencv": opencv.OpenCV(), "colmap": colmap.Colmap(), "kalibr": KALIBR
}  # fmt: skip
_BY_SUFFIX = {".json": "darswin", "": "darswin", ".txt": "colmap",
              **dict.fromkeys((".yaml", ".yml", ".xml"), "opencv")}  # fmt: skip
# The models that other programs know up to 90° from the axis alone.
IN_FRONT = {
    "darswin": "",
    "opencv": "Equidistant KannalaBrandt",
    "kalibr": "Equidistant KannalaBrandt FieldOfView",
    "colmap": "Equidistant KannalaBrandt FieldOfView Fisheye624 EnhancedUnified",
}


def save(
    lens: Lens,
    path: str | os.PathLike,
    format: str | None = None,
    *,
    supported: float | None = None,
) -> str:
    """Writes one lens to a file that `load` reads, and returns the name of the format.

    Our own JSON holds any lens. The other formats hold the lenses of their own models, without
    θ_max: `load` finds it from the image's sides.

    Args:
        format: "darswin", "opencv", "colmap" or "kalibr". None chooses by the path: OpenCV for
            .xml, .yaml and .yml, but Kalibr if the name contains "camchain" or "kalibr"; COLMAP
            for .txt; our own JSON for .json and without an ending.
        supported: rad: the angle up to which corners support the lens, as `CalibratedLens` has it.
            Our own JSON keeps it beside the lens; other formats have no place for it.

    Warns:
        UserWarning: the lens sees more than 90° from its axis, where the format's program knows
            no rays of its model: OpenCV's fisheye, COLMAP's models, and Kalibr's with pinhole.

    Raises:
        ValueError: several lenses, a lens of a model that is not in `MODELS`, a lens that the
            format cannot hold exactly, another ending without a format, or a wrong angle.
    """
    format = format_of(path, format)
    writer = WRITTEN[format]
    replace_file(path, writer.write(lens, Path(path).suffix.lower(), supported))
    warn_of_rays_beyond(lens, path, format)
    return format


def warn_of_rays_beyond(lens: Lens, path: str | os.PathLike, format: str) -> None:
    """The warning of `save`."""
    end, kind = math.degrees(lens.theta_max.item()), type(lens).__name__
    if end > 90 and kind in IN_FRONT[format].split():
        text = (
            f"{os.fspath(path)}: {WRITTEN[format].name} has no pixels for rays of 90° and more "
            f"from the axis of a {kind} lens, and wrong rays for their pixels, but this sees "
            f"{end:.4g}°"
        )
        warnings.warn(text, stacklevel=3)


def format_of(path: str | os.PathLike, format: str | None) -> str:
    """The format in which `save` writes a path; ValueError for an unknown one."""
    path = Path(path)
    suffix = path.suffix.lower()
    if format is None:
        if suffix not in _BY_SUFFIX:
            known = ", ".join(filter(None, _BY_SUFFIX))
            text = f"the ending of {path} names no format: take one of {known}, or give `format`"
            raise naming(ValueError(text), "format")
        format = _BY_SUFFIX[suffix]
        if suffix in (".yaml", ".yml") and re.search("camchain|kalibr", path.stem.lower()):
            format = "kalibr"
    if format not in WRITTEN:
        raise ValueError(f"format must be {', '.join(WRITTEN)} or None, got {format!r}")
    return format


def is_held(lens: Lens, path: str | os.PathLike, format: str | None) -> bool:
    """True if `save` can write the lens to the path."""
    try:
        WRITTEN[format_of(path, format)].write(lens, Path(path).suffix.lower())
    except ValueError:
        return False
    return True


def closest(model: str, lens: Lens, path: str | os.PathLike, format: str | None) -> Fit:
    """`fit` of a model to one lens, without what the format of a path cannot hold: skew, tangential
    and prism terms, and radial ones beyond two. If it holds no such lens, as `fit`."""
    whole = fit(model, lens)
    for terms, left_out in itertools.product((None, 2), ((), ("prism",), ("prism", "tangential"))):
        for kept in ([[1, 1], [1, 1]], [[1, 1], [0, 1]], [[1, 0], [0, 1]]):
            found = _without(whole.lens, terms, left_out, kept)
            if found is None or not is_held(found, path, format):
                continue
            if terms is None and not left_out:
                return Fit(found, largest_distance(found, lens))
            given = lens.replace(**dict.fromkeys({*left_out} & {*lens.optional}))
            found = _without(fit(model, given, terms=terms).lens, terms, left_out, kept)
            if found is not None and is_held(found, path, format):
                return Fit(found, largest_distance(found, lens))
    return whole


def _without(
    lens: Lens, terms: int | None, left_out: tuple[str, ...], kept: list[list[int]]
) -> Lens | None:
    """A lens with so many radial terms, without others, and with the `kept` places of its affine;
    None if its model has no terms to leave out."""
    changed: dict[str, Tensor | None] = {}
    if lens.affine is not None:
        changed["affine"] = lens.affine * torch.tensor(kept).to(lens.affine)
    if terms is not None or left_out:
        if not isinstance(lens, DistortedLens) or lens.radial is None:
            return None
        changed |= {"radial": lens.radial[:, :terms], **dict.fromkeys(left_out)}
    return lens.replace(**changed)
