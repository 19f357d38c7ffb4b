"""A calibration format is an object that reads cameras, and writes those that it can hold.

Readers make a description as `darswin.lens.from_dict` takes, and writers get `Intrinsics`. Both
have the principal point as the file has it: `origin` is the one place that moves it.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from darswin.lens.base import MODELS, Lens
from darswin.lens.distorted import DistortedLens
from darswin.lens.files.content import Content

Description = dict[str, Any]
Size = tuple[int, int] | None  # (H, W)
# A function for each camera of a file, by its name: nothing is read before it is asked for.
Cameras = dict[str, Callable[[], Description]]

PLANE = ("fx", "fy", "cx", "cy", "skew")
# Our names of coefficients have these letters and a number from 1: k1, d1 of the denominator, …
LETTERS = {"radial": "k", "denominator": "d", "tangential": "p", "prism": "s"}


class Intrinsics(NamedTuple):
    """A lens as files of other tools have it, the inverse of `describe`.

    Attributes: model: its class, with terms: a Perspective lens is a BrownConrady without any.
    values: of `PLANE`, the coefficients that are not 0, and the model's other numbers.
    """

    model: type[Lens]
    values: dict[str, float]
    size: Any  # (H, W), or None

    def fits(self, model: type[Lens], names: str) -> bool:
        """True if it is of a model and has no other values than these, skew among them."""
        others = self.values.keys() - {"fx", "fy", "cx", "cy"}
        return self.model is model and others <= {*names.split()}

    def listed(self, names: str) -> list[float]:
        """Values in an order, 0 where there are none."""
        return [self.values.get(name, 0.0) for name in names.split()]


class Format:
    """Base of the formats. A class sets `name` and `keys`, or `fits`, and defines `cameras`."""

    name: str  # in errors
    origin = 0.0  # where it has the center of the upper left pixel, along both axes: ours is 0
    keys: tuple[str, ...] = ()  # of the mappings that are of this format: any of them
    takes_model = False  # whether `load`'s model may say what its coefficients are
    holds = ""  # what `write` can write, in errors
    needs_size = False  # whether a written camera must have an image_size

    def fits(self, content: Content) -> bool:
        """True for a file's content that is of this format."""
        return isinstance(content, Mapping) and any(key in content for key in self.keys)

    def cameras(self, file: Any, model: str | None) -> Cameras:
        """The cameras of a file: its `Fields`, or the rows of a table."""
        raise NotImplementedError

    def write(self, lens: Lens, suffix: str) -> str:
        """The text of a file with this suffix; ValueError for a lens that the format lacks."""
        camera = intrinsics_of(lens, self.origin)
        if camera is not None and camera.size is None and self.needs_size:
            raise ValueError(f"{self.name}'s cameras have an image_size, and this lens has none")
        text = None if camera is None else self._text(camera, suffix)
        if text is None:
            raise ValueError(
                f"{self.name} has no exact place for this {type(lens).__name__} lens; it holds "
                f"{self.holds}. darswin.lens.fit, or --model, finds the closest lens of another "
                "model"
            )
        return text

    def _text(self, camera: Intrinsics, suffix: str) -> str | None:
        raise NotImplementedError


def describe(model: type[Lens], values: Mapping[str, float], size: Size) -> Description:
    """A camera of two focal lengths: x = fx x' + skew y' + cx.

    `values` are those of `PLANE`, px, skew if there is any; k1, p2 and other coefficients, which
    are left out where all are zero; and the model's other numbers.
    """
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
    """A camera of any model: its class, where it stands in the image, and its parameters."""
    frame: Description = {"center": list(center)}
    if affine is not None:
        frame["affine"] = affine
    if size is not None:
        frame["image_size"] = list(size)
    return {"model": model.__name__, **parameters, **frame}


def intrinsics_of(lens: Lens, origin: float) -> Intrinsics | None:
    """One lens with the center of the upper left pixel at (origin, origin); None for a lens without
    a focal length, or with columns that slant."""
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
    size = None
    if lens.image_size is not None:
        height, width = (round(side) for side in numbers["image_size"])
        size = height, width
    with_terms = {m.__dict__["plain"]: m for m in MODELS.values() if "plain" in m.__dict__}
    return Intrinsics(with_terms.get(type(lens), type(lens)), values, size)


def _times(ratio: float, focal: float) -> float:
    """A focal length that `describe` divides to the same ratio: of these, a short one."""
    product = ratio * focal
    short = float(f"{product:.15g}")
    return short if short / focal == ratio else product
