"""The undistorted views of `darswin lens`: their options, and what they show by default."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from darswin.lens import BrownConrady, Lens, Perspective
from darswin.lens.files.load import reach
from darswin.utils.parameters import check, naming
from darswin.views import PixelView, make_view
from darswin.viz.report import sides

View = Literal["perspective", "cylindrical", "equirectangular", "square"]


class NarrowView(UserWarning):
    """The warning of a field of view that looks like radians in place of degrees."""


def check_view(view: View, fov_deg: float | None, yaw_deg: float, pitch_deg: float) -> None:
    """ValueError for an option of a view that is out of its range."""
    for name, angle in (("yaw_deg", yaw_deg), ("pitch_deg", pitch_deg)):
        check(name, angle, -360 <= angle <= 360, "from -360° to 360°")
    if fov_deg is not None:
        flat = view == "perspective"
        most = "below 180°" if flat else "at most 360°"
        in_range = 0 < fov_deg < 180 if flat else 0 < fov_deg <= 360
        check("fov_deg", fov_deg, in_range, f"above 0° and {most} for a {view} view")
        if fov_deg <= 2 * math.pi:
            text = f"--fov_deg {fov_deg:g} is a narrow view; {fov_deg:g} rad would be "
            warnings.warn(f"{text}{math.degrees(fov_deg):.4g}°", NarrowView, stacklevel=2)


def view_of(
    lens: Lens, size: tuple[int, int], view: View, fov_deg: float | None, side: int
) -> tuple[float, tuple[int, int]]:
    """The field of view, in degrees, and (H, W) of a view whose longer side has `side` px.

    By default the view shows all that pictures of (H, W) show in the row of the principal point; a
    perspective view 110° at most, and a square all up to θ_max.
    """
    across, down = _fields_of_view(lens, size)
    if fov_deg is None:
        fov_deg = {
            "perspective": min(across, 110.0),
            "cylindrical": across,
            "equirectangular": across,
            "square": 2 * math.degrees(lens.theta_max.item()),
        }[view]
        if not fov_deg > 0:
            raise ValueError(
                "the picture shows nothing in the row of the lens's principal point: choose the "
                "view with --fov_deg and --yaw_deg"
            )
    aspect = {
        "perspective": size[0] / size[1],
        "cylindrical": 1 / 2,
        # The height of all that the picture shows; narrower views keep this shape.
        "equirectangular": down / max(fov_deg, across),
        "square": 1.0,
    }[view]
    longer = max(aspect, 1.0)
    return fov_deg, (max(1, round(side * aspect / longer)), max(1, round(side / longer)))


def view_rays(
    view: View, size: tuple[int, int], fov_deg: float, yaw_deg: float, pitch_deg: float
) -> Tensor:
    """The rays (H, W, 3) of a view of (H, W)."""
    from darswin.viz import views  # imports OpenCV

    fov, yaw, pitch = (math.radians(angle) for angle in (fov_deg, yaw_deg, pitch_deg))
    return getattr(views, view)(size, fov, yaw=yaw, pitch=pitch)


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
    name, _, count = spec.partition(":")
    options: dict[str, Any] = {
        key: values[0] if len(values) == 1 else values
        for key, values in (("mean", mean), ("std", std))
    }
    if up is not None:
        options["up"] = up
    if count:
        check(parameter, spec, count.isdecimal(), "NAME or NAME:COUNT, such as tiles:5")
        options["count"] = int(count)
    if fov_deg is not None:
        check("fov_deg", fov_deg, 0 < fov_deg <= 360, "above 0° and at most 360°")
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
