"""CamOdoCal's YAML, also used by KITTI-360 and VINS, and OCamCalib's calib_results.txt."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval

from darswin.lens.distorted import BrownConrady, KannalaBrandt, Mei
from darswin.lens.files.fields import Fields, is_number, short, to_number
from darswin.lens.files.format import Cameras, Description, Format, has_several, in_image
from darswin.lens.files.named import PLANE, RADTAN, Named, flat
from darswin.lens.image import Size
from darswin.lens.polynomial import OCam

SECTIONS = ("mirror_parameters", "projection_parameters", "distortion_parameters",
            "poly_parameters", "inv_poly_parameters", "affine_parameters")  # fmt: skip
BLOCKS = (
    "the direct polynomial", "the inverse polynomial", "the center (row and column)",
    "the affine parameters (c, d, e)", "the image size (height and width)",
)  # fmt: skip
MOST_APART = 1.0  # px, between the two polynomials; the toolbox reaches about 0.01 px inside
MAX_COEFFICIENTS = 64


class CamOdoCal(Named):
    """One camera, called by its name in the file, or "camera"."""

    def _recognizes(self, content: Mapping) -> bool:
        # OpenCV's files may have a model_type, and distortion_parameters that are a matrix.
        sections = (k for k, v in content.items() if isinstance(v, Mapping) and "data" not in v)
        return has_several([*sections, *({"model_type"} & content.keys())], self.marks)

    def _found(self, content: Mapping) -> list[tuple[str, Fields]]:
        file = Fields(flat(content))
        return [(file.text("camera_name") if "camera_name" in file else "camera", file)]

    def _described(self, camera: Fields, kind: str, size: Size) -> Description:
        described = _scaramuzza if kind == "SCARAMUZZA" else super()._described
        return described(camera, kind, size)


_DISTORTION = {"distortion_parameters.": RADTAN}
CAMODOCAL = CamOdoCal(
    "KITTI-360 or CamOdoCal", "model_type and projection_parameters", (),
    ("model_type", *SECTIONS), ("model_type",), {
        "MEI": (Mei, {"projection_parameters.": "fx=gamma1 fy=gamma2 cx=u0 cy=v0",
                      "mirror_parameters.": "xi"} | _DISTORTION),
        "KANNALA_BRANDT": (KannalaBrandt, {
            "projection_parameters.": "fx=mu fy=mv cx=u0 cy=v0 k1=k2 k2=k3 k3=k4 k4=k5"}),
        "PINHOLE": (BrownConrady, {"projection_parameters.": PLANE} | _DISTORTION),
        "SCARAMUZZA": (OCam, {})},
    "image_width image_height", strict=r".*\..*",
)  # fmt: skip


class OCamCalib(Format):
    """Rows of numbers for one camera."""

    name = "OCamCalib"
    keys = f"the lines of calib_results.txt ({', '.join(BLOCKS)})"
    is_table = True

    def _recognizes(self, content: list[list[str]]) -> bool:
        """True if the first of several lines counts its numbers, or the last three have 2, 3, 2."""
        count, *words = content[0]
        counts = count == str(len(words)) and is_number(words[0]) and len(content) > 3
        return counts or [len(row) for row in content[-3:]] == [2, 3, 2]

    def cameras(self, file: list[list[str]], coefficients: str | None) -> Cameras:
        return {"camera": partial(_camera_of_rows, file)}


def _scaramuzza(file: Fields, kind: str, size: Any) -> Description:
    """OCamCalib's polynomials. The sign of a₀ tells which way the optical axis points."""
    affine = file.values("cx cy c=ac d=ad e=ae", prefix="affine_parameters.")
    matrix = [[affine["c"], affine["d"]], [affine["e"], 1.0]]
    direct = _polynomial(file, "poly_parameters.")
    inverse = []
    if any(name.startswith("inv_poly_parameters.") for name in file.entries):
        inverse = _polynomial(file, "inv_poly_parameters.")
    if direct[0] > 0:
        direct = [-c for c in direct]
        inverse = [c * (-1) ** i for i, c in enumerate(inverse)]
    return _ocam(direct, inverse, (affine["cx"], affine["cy"]), matrix, size)


def _polynomial(file: Fields, prefix: str) -> list[float]:
    """p0, p1, … up to the first that is missing."""
    count = 1
    while count < MAX_COEFFICIENTS and f"{prefix}p{count}" in file:
        count += 1
    return [*file.values(" ".join(f"p{i}" for i in range(count)), prefix=prefix).values()]


def _camera_of_rows(rows: list[list[str]]) -> Description:
    names = BLOCKS if len(rows) != len(BLOCKS) - 1 else (BLOCKS[0], *BLOCKS[2:])
    if len(rows) != len(names):
        raise ValueError(
            f"it must have {len(BLOCKS)} lines of numbers, {', '.join(BLOCKS)}; got {len(rows)}"
        )
    file = Fields(dict(zip(names, rows, strict=True)))
    direct = _counted(file.entries, BLOCKS[0])
    inverse = _counted(file.entries, BLOCKS[1]) if BLOCKS[1] in file else []
    row, column = file.numbers(BLOCKS[2], (2,))
    c, d, e = file.numbers(BLOCKS[3], (3,))
    height, width = file.sides(BLOCKS[4])
    # x' points down and y' to the right: row = c x' + d y' + …, column = e x' + y' + ….
    return _ocam(direct, inverse, (column, row), [[1.0, e], [d, c]], (height, width))


def _counted(block: Mapping[str, list[str]], name: str) -> list[float]:
    """The coefficients that follow their count."""
    count, *words = block[name]
    if count != str(len(words)) or len(words) > MAX_COEFFICIENTS:
        raise ValueError(
            f"{name} must begin with the number of its coefficients, at most {MAX_COEFFICIENTS}; "
            f"got {short(count)} before {len(words)} coefficients"
        )
    return [to_number(word, name, "finite numbers") for word in words]


def _ocam(
    direct: list[float],
    inverse: list[float],
    center: tuple[float, float],
    affine: list[list[float]],
    size: tuple[int, int],
) -> Description:
    """The lens of the direct polynomial, which was calibrated. The toolbox fits the inverse one to
    it, loses it in rounding if it has many terms, and extrapolates it before the corners."""
    if any(inverse):
        _check_inverse(direct, inverse, size)
    return in_image(OCam, center, affine, size, {"coefficients": direct})


def _check_inverse(direct: list[float], inverse: list[float], size: tuple[int, int]) -> None:
    """Raises ValueError if both polynomials differ at most radii up to half the image's diagonal:
    then they are not of one camera."""
    radius = np.linspace(0, math.hypot(*size) / 2, 257)
    theta = np.arctan2(radius, -polyval(radius, direct))
    last = int((np.diff(theta, append=-1.0) <= 0).argmax())  # no ray lands beyond
    with np.errstate(all="ignore"):
        found = polyval(theta - math.pi / 2, inverse)[: last + 1]
        off = ~(abs(found - radius[: last + 1]) <= MOST_APART)
    if off.mean() > 0.5:
        at = int(off.argmax())
        raise ValueError(
            f"the inverse polynomial must undo the direct one to within {MOST_APART:g} px, got "
            f"{found[at]:.6g} px for {radius[at]:.6g} px; the direct one alone would be used"
        )
