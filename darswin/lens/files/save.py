"""Writes calibration files."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

import torch

from darswin.lens.base import Lens
from darswin.lens.distorted import DistortedLens
from darswin.lens.files import colmap, opencv
from darswin.lens.files.format import Format
from darswin.lens.files.kalibr import Kalibr
from darswin.lens.files.own import Own
from darswin.lens.fitting import Fit, fit, largest_distance
from darswin.utils.files import replace_file

# The formats that `save` writes.
WRITTEN: dict[str, Format] = {
    "darswin": Own(), "opencv": opencv.OpenCV(), "colmap": colmap.Colmap(), "kalibr": Kalibr()
}  # fmt: skip


def save(lens: Lens, path: str | os.PathLike, format: str | None = None) -> str:
    """Writes one lens to a file that `load` reads, and returns the name of the format.

    Our own JSON holds any lens. The other formats hold the lenses of their own models, without
    θ_max: `load` finds it from the image's sides.

    Args:
        format: "darswin", "opencv", "colmap" or "kalibr". None chooses by the path: OpenCV for
            .xml, .yaml and .yml, but Kalibr if the name contains "camchain" or "kalibr"; COLMAP
            for .txt; else our own JSON.

    Raises:
        ValueError: several lenses, a lens of a model that is not in `MODELS`, or a lens that the
            format cannot hold exactly.
    """
    format = format_of(path, format)
    replace_file(path, WRITTEN[format].write(lens, Path(path).suffix.lower()))
    return format


def format_of(path: str | os.PathLike, format: str | None) -> str:
    """The format in which `save` writes a path; ValueError for an unknown one."""
    path = Path(path)
    suffix = path.suffix.lower()
    if format is None:
        by_suffix = {".xml": "opencv", ".yaml": "opencv", ".yml": "opencv", ".txt": "colmap"}
        format = by_suffix.get(suffix, "darswin")
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
    """`fit` of a model to one lens, without what the format of a path cannot hold: tangential and
    prism terms, further radial ones, and skew. If it cannot hold the model, as `fit`."""
    whole = fit(model, lens)
    if not is_held(_bare(whole.lens), path, format):
        return whole
    for found in _simpler(whole.lens, model, lens):
        if is_held(found, path, format):
            return Fit(found, largest_distance(found, lens))
    return whole


def _simpler(found: Lens, model: str, lens: Lens) -> Iterator[Lens]:
    """A fitted lens, and then lenses of its model with fewer and fewer terms."""
    yield from _less_skewed(found)
    if not isinstance(found, DistortedLens) or found.radial is None:
        return
    for terms in (None, 2):
        for left_out in (("prism",), ("prism", "tangential")):
            given = lens.replace(**dict.fromkeys({*left_out} & {*lens.optional}))
            fitted = fit(model, given, terms=terms).lens
            yield from _less_skewed(fitted.replace(**dict.fromkeys(left_out)))


def _bare(lens: Lens) -> Lens:
    """A lens with the fewest terms of its model, which a format holds if it holds any."""
    lens = lens.replace(affine=None)
    if not isinstance(lens, DistortedLens) or lens.radial is None:
        return lens
    return lens.replace(tangential=None, prism=None, radial=lens.radial[:, :2])


def _less_skewed(lens: Lens) -> Iterator[Lens]:
    """A lens, and the same with rows along x, and with columns along y too."""
    yield lens
    if lens.affine is not None:
        rows, columns = torch.tensor([[1, 1], [0, 1.0]]), torch.eye(2)
        for kept in (rows, columns):
            yield lens.replace(affine=lens.affine * kept.to(lens.affine))
