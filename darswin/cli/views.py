"""The undistorted views of `darswin lens`: their options, and what they show by default."""

import inspect
import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

from darswin.lens import BrownConrady, Lens, Perspective
from darswin.lens.files.load import Calibration, reach
from darswin.utils.nearest import did_you_mean
from darswin.utils.parameters import check, naming
from darswin.views import CameraView, PixelView, list_views, make_view, turned
from darswin.views.registry import flat_views, view_class

Up = tuple[float, float, float]


class Look(NamedTuple):
    """The options of an undistorted view; its name is one of `flat_views()`."""

    view: str
    fov_deg: float | None
    yaw_deg: float
    pitch_deg: float
    up: Up | None

    def check(self) -> None:
        """ValueError for an option that is out of its range."""
        check("view", self.view, self.view in flat_views(), f"one of {', '.join(flat_views())}")
        for name, angle in (("yaw_deg", self.yaw_deg), ("pitch_deg", self.pitch_deg)):
            check(name, angle, -360 <= angle <= 360, "from -360° to 360°")
            ahead = f"0 for a {self.view} view, which looks along the optical axis"
            check(name, angle, self._turns or angle == 0, ahead)
        _check_fov_and_up(self.view, self.fov_deg, self.up)
        left_out = f"left out for a {self.view} view"
        check("up", self.up, self._turns or self.up is None, left_out)
        whole = not self._around or self.fov_deg in (None, 360)
        check("fov_deg", self.fov_deg, whole, f"360° for a {self.view} view")

    @property
    def _turns(self) -> bool:
        return "direction" in inspect.signature(view_class(self.view)).parameters

    @property
    def _around(self) -> bool:
        return getattr(view_class(self.view), "around", False)

    def shape(self, lens: Lens, size: tuple[int, int], side: int) -> tuple[float, tuple[int, int]]:
        """The field of view, in degrees, and (H, W) of a view whose longer side has `side` px.

        By default the view shows what its class says of pictures of (H, W).
        """
        given = None if self.fov_deg is None else math.radians(self.fov_deg)
        fov, aspect = view_class(self.view).usual_shape(lens, size, given)
        if not fov > 0:
            raise ValueError(
                "the picture shows nothing in the row of the lens's principal point: choose the "
                "view with --fov_deg and --yaw_deg"
            )
        longer = max(aspect, 1.0)
        shape = max(1, round(side * aspect / longer)), max(1, round(side / longer))
        return math.degrees(fov) if self.fov_deg is None else self.fov_deg, shape

    def make(self, size: tuple[int, int], fov_deg: float | None) -> PixelView:
        """The view of (H, W)."""
        turn: dict[str, Any] = {}
        if self._turns:
            turn = turned(math.radians(self.yaw_deg), math.radians(self.pitch_deg))
            turn |= {} if self.up is None else dict(up=self.up)
        fov = None if self._around or fov_deg is None else math.radians(fov_deg)
        view = make_view(self.view, size, fov=fov, **turn)
        assert isinstance(view, PixelView)
        return view


def _check_fov_and_up(view: str, fov_deg: float | None, up: Sequence[float] | None) -> None:
    """ValueError for values out of their ranges; a warning for radians in place of degrees."""
    if up is not None:
        vector = len(up) == 3 and 0 < math.hypot(*up) < math.inf
        check("up", up, vector, "three finite numbers that are not all 0")
    if fov_deg is None:
        return
    widest = getattr(view_class(view), "widest", 2 * math.pi)
    most = f"above 0° and at most {math.degrees(widest):.4g}° for a {view} view"
    check("fov_deg", fov_deg, 0 < math.radians(fov_deg) <= widest, most)
    if fov_deg <= 2 * math.pi:
        text = f"--fov_deg {fov_deg:g} is a narrow view; {fov_deg:g} rad would be "
        warnings.warn(f"{text}{math.degrees(fov_deg):.4g}°", stacklevel=3)


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


def camera_view(to: str, size: tuple[int, int] | None) -> CameraView:
    """The pictures of (H, W) of a camera, from its calibration file or its lens as JSON."""
    calibration = Calibration(to, "--to") if to.startswith("{") else Calibration.read(to)
    lens = calibration.lens(image_size=size)
    if lens.image_size is None:
        raise naming(ValueError(f"{to} has no image_size: give `size`"), "size")
    return CameraView(to_corners(lens if size is None else lens.in_picture(size)))


def named_view(
    parameter: str, spec: str, size: tuple[int, int], *, fov_deg: float | None,
    up: Sequence[float] | None, mean: Sequence[float] = (0.0,), std: Sequence[float] = (1.0,),
) -> PixelView:  # fmt: skip
    """The view NAME or NAME:COUNT of (H, W) that a `parameter` names, for networks."""
    name, colon, count = spec.partition(":")
    meant = did_you_mean(name, list_views()).rstrip(".")
    check(parameter, name + meant, name in list_views(), f"one of {', '.join(list_views())}")
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
        options["fov"] = math.radians(fov_deg)
    try:
        view = make_view(name, size, **options)
    except TypeError as error:
        raise ValueError(str(error)) from error
    if not isinstance(view, PixelView):
        raise naming(ValueError(f"`{parameter}` {name} shows no picture to a network"), parameter)
    return view
