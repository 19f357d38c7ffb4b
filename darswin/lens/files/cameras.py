"""What readers make of a camera, a description as `darswin.lens.from_dict` takes, and writers get.

Both have the principal point as their files have it; `load` and `save` move it from and to our
pixel origin.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from darswin.lens.base import MODELS, Lens
from darswin.lens.distorted import DistortedLens

Parameters = Mapping[str, float | Sequence[float]]
Description = dict[str, Any]
# What describes each camera of a file, by its name: nothing is read before it is asked for.
Cameras = dict[str, Callable[[], Description]]

# What the terms are called in files, with a number from 1.
LETTERS = {"radial": "k", "denominator": "d", "tangential": "p", "prism": "s"}


def describe(
    model: type[Lens],
    focal: tuple[float, float],
    center: tuple[float, float],
    image_size: tuple[int, int] | None,
    parameters: Parameters,
    skew: float = 0.0,
) -> Description:
    """A camera of two focal lengths.

    Args:
        model: its class. focal: fx and fy > 0, px. center: (cx, cy) px. image_size: (H, W) or None.
        parameters: the model's others. Terms that are all zero are left out.
        skew: px, by which a pixel's x grows with y: x = fx x' + skew y' + cx.
    """
    fx, fy = focal
    parameters = {
        name: value
        for name, value in parameters.items()
        if not isinstance(value, Sequence) or any(value)
    }
    if issubclass(model, DistortedLens) and not parameters.keys() & LETTERS.keys():
        model = model.plain
    affine = None if fx == fy and skew == 0 else [[1.0, skew / fx], [0.0, fy / fx]]
    return in_image(model, center, affine, image_size, {"focal": fx, **parameters})


def in_image(
    model: type[Lens],
    center: tuple[float, float],
    affine: list[list[float]] | None,
    image_size: tuple[int, int] | None,
    parameters: Parameters,
) -> Description:
    """A camera of any model: its class, where it stands in the image, and its parameters."""
    frame: dict[str, Any] = {"center": list(center)}
    if affine is not None:
        frame["affine"] = affine
    if image_size is not None:
        frame["image_size"] = list(image_size)
    return {"model": model.__name__, **parameters, **frame}


class Camera(NamedTuple):
    """A lens for a writer, the inverse of `describe`.

    Attributes: model: its class, with terms: a Perspective lens is a BrownConrady without any.
    plane: fx, fy, cx, cy (px) and those parameters that are numbers. terms: those that are not 0,
    as k1, k2, p1, …; d1 is the first of the denominator. skew: px. size: (H, W) or None.
    """

    model: type[Lens]
    plane: dict[str, float]
    terms: dict[str, float]
    skew: float
    size: tuple[int, int] | None

    def listed(self, names: str) -> list[float]:
        """Terms in an order, 0 where there are none."""
        return [self.terms.get(name, 0.0) for name in names.split()]


def camera_of(lens: Lens, origin: float) -> Camera | None:
    """A lens with the center of the upper left pixel at (origin, origin), or None: it has no focal
    length, or columns that slant.

    Raises:
        ValueError: several lenses, or one with neither a center nor an image_size.
    """
    if len(lens) != 1:
        raise ValueError(f"save takes one lens, got {len(lens)}")
    center = lens.center_in()[0].tolist()
    values = {name: getattr(lens, name) for name in (*lens.parameters, *lens.optional)}
    values = {name: v.detach()[0].tolist() for name, v in values.items() if v is not None}
    affine = [[1.0, 0.0], [0.0, 1.0]] if lens.affine is None else lens.affine.detach()[0].tolist()
    if "focal" not in values or affine[1][0] != 0 or affine[0][0] <= 0 or affine[1][1] <= 0:
        return None
    focal = values.pop("focal")
    terms = {
        f"{letter}{i}": value
        for name, letter in LETTERS.items()
        for i, value in enumerate(values.pop(name, []), 1)
        if value != 0
    }
    plane = {
        "fx": _times(affine[0][0], focal),
        "fy": _times(affine[1][1], focal),
        "cx": center[0] + origin,
        "cy": center[1] + origin,
        **values,
    }
    size = None
    if lens.image_size is not None:
        height, width = (round(side) for side in lens.image_size[0].tolist())
        size = height, width
    with_terms = {m.__dict__["plain"]: m for m in MODELS.values() if "plain" in m.__dict__}
    model = with_terms.get(type(lens), type(lens))
    return Camera(model, plane, terms, focal * affine[0][1], size)


def _times(ratio: float, focal: float) -> float:
    """A focal length that `describe` divides to the same ratio: of these, a short one."""
    product = ratio * focal
    short = float(f"{product:.15g}")
    return short if short / focal == ratio else product
