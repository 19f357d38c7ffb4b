"""What every format's reader makes of a camera: a description, as `darswin.lens.from_dict` takes.

A reader leaves the principal point as its file has it; `load` moves it to our pixel origin.
"""

from collections.abc import Callable, Sequence
from typing import Any

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, Fisheye624, KannalaBrandt, Mei
from darswin.lens.ideal import Equidistant, Perspective
from darswin.lens.sphere import Spherical

Description = dict[str, Any]
# What describes each camera of a file, by its name: nothing is read before it is asked for.
Cameras = dict[str, Callable[[], Description]]

TERMS = ("radial", "denominator", "tangential", "prism")
# What is left of a model when all its terms are zero, with a closed inverse.
PLAIN: dict[type[Lens], type[Lens]] = {
    KannalaBrandt: Equidistant, Fisheye624: Equidistant, BrownConrady: Perspective, Mei: Spherical
}  # fmt: skip


def describe(
    model: type[Lens],
    focal: tuple[float, float],
    center: tuple[float, float],
    image_size: tuple[int, int] | None,
    *,
    skew: float = 0.0,
    **parameters: float | Sequence[float],
) -> Description:
    """A camera of two focal lengths.

    Args:
        model: its class. focal: fx and fy > 0, px. center: (cx, cy) px. image_size: (H, W) or None.
        skew: px, by which a pixel's x grows with y: x = fx x' + skew y' + cx.
        parameters: the model's others. Terms that are all zero are left out.
    """
    fx, fy = focal
    parameters = {k: v for k, v in parameters.items() if k not in TERMS or any(v)}
    if not any(term in parameters for term in TERMS):
        model = PLAIN.get(model, model)
    affine = None if fx == fy and skew == 0 else [[1.0, skew / fx], [0.0, fy / fx]]
    return in_image(model, center, affine, image_size, focal=fx, **parameters)


def in_image(
    model: type[Lens],
    center: tuple[float, float],
    affine: list[list[float]] | None,
    image_size: tuple[int, int] | None,
    **parameters: float | Sequence[float],
) -> Description:
    """A camera of any model: its class, where it stands in the image, and its parameters."""
    frame = {"center": center, "affine": affine, "image_size": image_size}
    frame = {name: list(value) for name, value in frame.items() if value is not None}
    return {"model": model.__name__, **parameters, **frame}
