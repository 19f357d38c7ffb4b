"""The undistorted views of `darswin lens`: their options, and what they show by default."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch

from darswin.lens import BrownConrady, Lens, Perspective
from darswin.lens.files.load import reach
from darswin.utils.parameters import check, naming
from darswin.views import (
    CylindricalView,
    EquirectangularView,
    MercatorView,
    PanoramaView,
    PixelView,
    RayView,
    SquareView,
    StereographicView,
    TangentView,
    make_view,
    turned,
)
from darswin.viz.report import sides

View = Literal[
    "perspective", "cylindrical", "equirectangular", "mercator", "stereographic", "panorama",
    "square",
]  # fmt: skip
Up = tuple[float, float, float]
_RAY_VIEWS: dict[str, type[RayView]] = {
    "perspective": TangentView,
    "tangent": TangentView,
    "cylindrical": CylindricalView,
    "equirectangular": EquirectangularView,
    "mercator": MercatorView,
    "stereographic": StereographicView,
}


class NarrowView(UserWarning):
    """The warning of a field of view that looks like radians in place of degrees."""


class Look(NamedTuple):
    """The options of an undistorted view."""

    view: View
    fov_deg: float | None
    yaw_deg: float
    pitch_deg: float
    up: Up | None

    def check(self) -> None:
        """ValueError for an option that is out of its range."""
        for name, angle in (("yaw_deg", self.yaw_deg), ("pitch_deg", self.pitch_deg)):
            check(name, angle, -360 <= angle <= 360, "from -360° to 360°")
            ahead = "0 for a square view, which looks along the optical axis"
            check(name, angle, self.view != "square" or angle == 0, ahead)
        _check_fov_and_up(self.view, self.fov_deg, self.up)
        check("up", self.up, self.view != "square" or self.up is None, "left out for a square view")
        whole = self.view != "panorama" or self.fov_deg in (None, 360)
        check("fov_deg", self.fov_deg, whole, "360° for a panorama view")

    def shape(self, lens: Lens, size: tuple[int, int], side: int) -> tuple[float, tuple[int, int]]:
        """The field of view, in degrees, and (H, W) of a view whose longer side has `side` px.

        By default the view shows all that pictures of (H, W) show in the row of the principal
        point; a perspective view 110° at most, a panorama 360°, and a square all up to θ_max.
        """
        across, down = _fields_of_view(lens, size)
        fov_deg = self.fov_deg
        if fov_deg is None:
            fov_deg = {
                "perspective": min(across, 110.0),
                "stereographic": min(across, 340.0),
                "panorama": 360.0,
                "square": 2 * math.degrees(lens.theta_max.item()),
            }.get(self.view, across)
            if not fov_deg > 0:
                raise ValueError(
                    "the picture shows nothing in the row of the lens's principal point: choose "
                    "the view with --fov_deg and --yaw_deg"
                )
        aspect = {
            "cylindrical": 1 / 2,
            # The height of all that the picture shows; narrower views keep this shape.
            "equirectangular": down / max(fov_deg, across),
            "panorama": 1 / 3,
            "square": 1.0,
        }.get(self.view, size[0] / size[1])
        longer = max(aspect, 1.0)
        return fov_deg, (max(1, round(side * aspect / longer)), max(1, round(side / longer)))

    def make(self, size: tuple[int, int], fov_deg: float) -> PixelView:
        """The view of (H, W)."""
        fov = math.radians(fov_deg)
        if self.view == "square":
            # Its edge is before π, where all directions are one.
            return SquareView(size, theta_max=min(fov / 2, math.nextafter(math.pi, 0)))
        turn = turned(math.radians(self.yaw_deg), math.radians(self.pitch_deg))
        if self.up is not None:
            turn["up"] = self.up
        if self.view == "panorama":
            return PanoramaView(size, **turn)
        return _RAY_VIEWS[self.view](size, fov, **turn)


def _check_fov_and_up(view: str, fov_deg: float | None, up: Sequence[float] | None) -> None:
    """ValueError for values out of their ranges; a warning for radians in place of degrees."""
    if up is not None:
        vector = len(up) == 3 and 0 < math.hypot(*up) < math.inf
        check("up", up, vector, "three finite numbers that are not all 0")
    if fov_deg is None:
        return
    widest = _RAY_VIEWS.get(view, RayView).widest
    most = f"above 0° and at most {math.degrees(widest):.4g}° for a {view} view"
    check("fov_deg", fov_deg, 0 < math.radians(fov_deg) <= widest, most)
    if fov_deg <= 2 * math.pi:
        text = f"--fov_deg {fov_deg:g} is a narrow view; {fov_deg:g} rad would be "
        warnings.warn(f"{text}{math.degrees(fov_deg):.4g}°", NarrowView, stacklevel=3)


def to_corners(lens: Lens) -> Lens:
    """A pinhole camera up to the corners of its picture, since it has no image circle; another
    lens, or a distorted one with a θ_max of its own, as it is."""
    whole = lens.with_theta_max(None)
    distorted = isinstance(lens, BrownConrady) and (lens.theta_max - reach(whole)).abs() < 1e-5
    if lens.image_size is None or not (isinstance(lens, Perspective) or distorted):
        return lens
    height, width = (lens.image_size[0] - 0.5).tolist()
    corners = [[x, y] for x in (-0.5, width) for y in (-0.5, height)]
    theta = whole.theta_and_direction(lens.theta_max.new_tensor([corners]))[0]
    return lens.with_theta_max(theta.nan_to_num(whole.theta_max.item()).max().item())


def named_view(
    parameter: str, spec: str, size: tuple[int, int], *, fov_deg: float | None,
    up: Sequence[float] | None, mean: Sequence[float] = (0.0,), std: Sequence[float] = (1.0,),
) -> PixelView:  # fmt: skip
    """The view NAME or NAME:COUNT of (H, W) that a `parameter` names, for networks."""
    name, colon, count = spec.partition(":")
    _check_fov_and_up(name, fov_deg, up)
    options: dict[str, Any] = {
        key: values[0] if len(values) == 1 else values
        for key, values in (("mean", mean), ("std", std))
    }
    if up is not None:
        options["up"] = up
    if colon:
        check(parameter, spec, count.isdecimal(), "NAME or NAME:COUNT, such as tiles:5")
        options["count"] = int(count)
    if fov_deg is not None:
        options["max_fov" if name == "perspective" else "fov"] = math.radians(fov_deg)
    try:
        view = make_view(name, size, **options)
    except TypeError as error:
        raise ValueError(str(error)) from error
    if not isinstance(view, PixelView):
        raise naming(ValueError(f"`{parameter}` {name} shows no picture to a network"), parameter)
    return view


def _fields_of_view(lens: Lens, size: tuple[int, int]) -> tuple[float, float]:
    """Horizontal and vertical field of view up to θ_max in a picture (H, W), in degrees."""
    end = lens.theta_max.item()
    angles = torch.rad2deg(sides(lens, size).clamp(-end, end))
    return min(angles[::2].sum().item(), 360.0), angles[1::2].sum().clamp(max=180).item()
