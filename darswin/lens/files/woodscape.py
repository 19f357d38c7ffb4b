"""WoodScape's and SynWoodScape's JSON: `intrinsic` holds a polynomial of the angle."""

from collections.abc import Mapping

import numpy as np

from darswin.lens.files.fields import Fields
from darswin.lens.files.format import Cameras, Description, Format, has_several, in_image
from darswin.lens.polynomial import Polynomial
from darswin.utils.poses import from_quaternion

# k₁, px per rad, is at least this even for images of a few dozen pixels.
LEAST_K1 = 10.0
MAX_ORDER = 16
MARKS = ("poly_order", "cx_offset", "cy_offset", "aspect_ratio", "k1")


class WoodScape(Format):
    """One camera, called by its name in the file, or "camera"."""

    name = "WoodScape"
    origin = 0.5
    keys = "intrinsic with poly_order, k1, k2, …"

    def _recognizes(self, content: Mapping) -> bool:
        intrinsic = content.get("intrinsic")
        return isinstance(intrinsic, Mapping) and has_several(intrinsic, MARKS)

    def cameras(self, file: Fields, coefficients: str | None) -> Cameras:
        return {file.text("name") if "name" in file else "camera": lambda: _camera(file)}

    def up(self, file: Fields) -> list[float]:
        return [float(x) for x in camera_to_vehicle(file)[2]]


def camera_to_vehicle(file: Fields) -> np.ndarray:
    """The rotation (3, 3) of vectors of the camera's frame to the vehicle's: x forward, y left, z
    up."""
    x, y, z, w = file.section("extrinsic").numbers("quaternion", (4,))
    return from_quaternion("extrinsic.quaternion", w, x, y, z)


def _camera(file: Fields) -> Description:
    intrinsic = file.section("intrinsic")
    intrinsic.one_of("model", ["radial_poly"])
    order = intrinsic.number("poly_order", 4.0)
    if order not in range(1, MAX_ORDER + 1):
        raise ValueError(f"intrinsic.poly_order must be 1 to {MAX_ORDER}, got {order:g}")
    coefficients = [intrinsic.number(f"k{i}") for i in range(1, int(order) + 1)]
    if coefficients[0] < LEAST_K1:
        raise ValueError(
            f"intrinsic.k1 must be in pixels per radian, at least {LEAST_K1:g}, got "
            f"{coefficients[0]:g}. Kannala–Brandt coefficients (OpenCV's fisheye) are of another "
            "kind: write them into an OpenCV file or a KannalaBrandt lens"
        )
    width, height = intrinsic.side("width"), intrinsic.side("height")
    offset = intrinsic.values("x=cx_offset y=cy_offset")
    center = (width / 2 + offset["x"], height / 2 + offset["y"])
    aspect = intrinsic.positive("aspect_ratio") if "aspect_ratio" in intrinsic else 1.0
    affine = None if aspect == 1 else [[1.0, 0.0], [0.0, aspect]]
    intrinsic.check_all_read(f"a radial_poly of order {order:g}")
    return in_image(Polynomial, center, affine, (height, width), {"coefficients": coefficients})
