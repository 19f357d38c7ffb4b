"""The base of all calibration formats. A format reads cameras, and may write lenses.

Readers return descriptions for `darswin.lens.from_dict`; writers receive `Intrinsics`. In both,
the principal point is in the file's pixel convention: only `Format.origin` changes it.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

from darswin.lens.base import MODELS, Lens
from darswin.lens.distorted import BrownConrady, DistortedLens
from darswin.lens.files.content import Content
from darswin.lens.image import Size
from darswin.lens.sphere import EnhancedUnified

# For `from_dict`. A cropped image's may have "sensor" besides: the crop's x and y in the image of
# the whole sensor, and the height and width of that image, px.
Description = dict[str, Any]
# A function for each camera of a file, by the camera's name. It reads the camera when called.
Cameras = dict[str, Callable[[], Description]]

PLANE = ("fx", "fy", "cx", "cy", "skew")
# Our names of coefficients are a letter and a number from 1: k1; d1 for the denominator; …
LETTERS = {"radial": "k", "denominator": "d", "tangential": "p", "prism": "s"}


class Intrinsics(NamedTuple):
    """A lens in the terms of other tools' files: the inverse of `describe`.

    Attributes:
        model: the lens class. A model without distortion has the class that adds distortion:
            BrownConrady for a Perspective lens.
        values: those of `PLANE`, the coefficients other than 0, and the model's other numbers.
    """

    model: type[Lens]
    values: dict[str, float]
    size: Any  # (H, W), or None

    def has_only(self, model: type[Lens], names: str) -> bool:
        """True if the model is the same and `names` include all values but focal lengths and
        principal point; that is, skew too."""
        others = self.values.keys() - {"fx", "fy", "cx", "cy"}
        return self.model is model and others <= {*names.split()}

    def listed(self, names: str) -> list[float]:
        """The values in the order of `names`; 0 for a missing one."""
        return [self.values.get(name, 0.0) for name in names.split()]


class Format:
    """Base of the formats. A class sets `name` and `keys`, and defines `_recognizes` and `cameras`.
    Formats that are written also set `holds` and define `_text`."""

    name: str  # for errors
    origin = 0.0  # x and y of the upper left pixel's center in the file; we use 0
    keys: str  # what its files hold, for errors
    is_table = False  # True if its files are lines of words
    takes_coefficients = False  # True if `coefficients` of `load` may name their model
    holds = ""  # the lenses that `write` supports, for errors
    needs_size = False  # True if a written camera must have an image_size

    def recognizes(self, content: Content) -> bool:
        """True if a file's content is in this format. One common entry, such as "frames", does not
        make a format: it needs several, as in `has_several`."""
        return isinstance(content, list) == self.is_table and self._recognizes(content)

    def _recognizes(self, content: Any) -> bool:
        """`recognizes` for a mapping, or for the rows of a table if the format's files are such."""
        raise NotImplementedError

    def cameras(self, file: Any, coefficients: str | None) -> Cameras:
        """The cameras of a file; `file` is its `Fields`, or the rows of a table."""
        raise NotImplementedError

    def up(self, file: Any) -> list[float]:
        """The direction away from gravity in the camera's frame, by the file's extrinsics."""
        raise ValueError(f"{self.name} files do not say which way is up in the camera's frame")

    def supported(self, file: Any) -> float | None:
        """rad: the angle up to which corners support the lens, or None if the file does not say."""
        return None

    def write(self, lens: Lens, suffix: str, supported: float | None = None) -> str:
        """The text of a file with this suffix; ValueError if the format cannot hold the lens. Our
        own alone has a place for `supported`."""
        camera = intrinsics_of(lens, self.origin)
        if camera is not None and camera.size is None and self.needs_size:
            raise ValueError(f"{self.name} files need the lens's image_size, but it has none")
        text = None if camera is None else self._text(camera, suffix)
        if text is None:
            raise ValueError(
                f"{self.name} files cannot hold this {type(lens).__name__} lens exactly. They hold "
                f"{self.holds}. `darswin lens convert --model` writes the closest lens of one of "
                "these models, without what they cannot hold"
            )
        return text

    def _text(self, camera: Intrinsics, suffix: str) -> str | None:
        """The text of a file, or None if the format cannot hold the camera."""
        raise NotImplementedError


def has_several(entries: Iterable[str], marks: Iterable[str]) -> bool:
    """True if two of the marks are among the entries."""
    return len({*entries} & {*marks}) > 1


def describe(model: type[Lens], values: Mapping[str, float], size: Size) -> Description:
    """The description of a camera with two focal lengths: x = fx x' + skew y' + cx.

    `values` are those of `PLANE`, px, where skew is optional; coefficients such as k1 and p2; and
    the model's other numbers. Coefficients of a kind that are all zero are left out. A FieldOfView
    with ω = 0 and a division of 0 are pinholes.
    """
    if division := values.get("division", 0.0):  # r / (1 + k r²) = tan θ is an EUCM
        values = {**values, "alpha": 0.5, "beta": -4 * division}
    elif "division" in values or values.get("omega") == 0:
        model = BrownConrady
    if model is EnhancedUnified:
        values = {"beta": 1.0, **values}
    coefficients = {}
    for name, letter in LETTERS.items():
        found = {int(n[1:]): v for n, v in values.items() if re.fullmatch(rf"{letter}\d", n)}
        if any(found.values()):
            count = model.declared[name].shape[0] or max(found)
            coefficients[name] = [found.get(i, 0.0) for i in range(1, count + 1)]
    others = {name: v for name, v in values.items() if name in model.parameters}
    if issubclass(model, DistortedLens) and not coefficients:
        model = model.plain
    fx, fy, skew = values["fx"], values["fy"], values.get("skew", 0.0)
    affine = None if fx == fy and skew == 0 else [[1.0, skew / fx], [0.0, fy / fx]]
    parameters = {"focal": fx} | others | coefficients
    return in_image(model, (values["cx"], values["cy"]), affine, size, parameters)


def in_image(
    model: type[Lens],
    center: tuple[float, float],
    affine: list[list[float]] | None,
    size: Size,
    parameters: Mapping[str, Any],
) -> Description:
    """The description of a camera from its class, its place in the image and its parameters."""
    common: Description = {"center": list(center)}
    if affine is not None:
        common["affine"] = affine
    if size is not None:
        common["image_size"] = list(size)
    return {"model": model.__name__, **parameters, **common}


def intrinsics_of(lens: Lens, origin: float) -> Intrinsics | None:
    """A lens's intrinsics, with the center of the upper left pixel at (origin, origin). None for a
    lens without a focal length, or whose `affine` tilts the image's columns."""
    if len(lens) != 1:
        raise ValueError(f"save takes one lens, got {len(lens)}")
    cx, cy = lens.center_in()[0].tolist()
    numbers: dict[str, Any] = {n: v.detach()[0].tolist() for n, v in lens._tensors().items()}
    (a, b), (c, d) = numbers.get("affine", [[1.0, 0.0], [0.0, 1.0]])
    if "focal" not in numbers or c != 0 or a <= 0 or d <= 0:
        return None
    focal = numbers["focal"]
    values = {"fx": _times(a, focal), "fy": _times(d, focal), "cx": cx + origin, "cy": cy + origin}
    if b != 0:
        values["skew"] = focal * b
    for name in (*lens.parameters, *lens.optional):
        if name in LETTERS:
            found = enumerate(numbers.get(name, []), 1)
            values |= {f"{LETTERS[name]}{i}": value for i, value in found if value != 0}
        elif name != "focal":
            values[name] = numbers[name]
    size = None if lens.image_size is None else [round(side) for side in numbers["image_size"]]
    with_terms = {m.__dict__["plain"]: m for m in MODELS.values() if "plain" in m.__dict__}
    return Intrinsics(with_terms.get(type(lens), type(lens)), values, size)


def _times(ratio: float, focal: float) -> float:
    """ratio × focal, rounded to 15 digits if dividing by `focal` still gives the same ratio."""
    product = ratio * focal
    short = float(f"{product:.15g}")
    return short if short / focal == ratio else product
