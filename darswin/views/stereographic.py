"""A stereographic picture, as a lens that keeps the shape of objects would take it."""

import math

import torch
from torch import Tensor

from darswin.views.directions import RayView
from darswin.views.registry import register_view


@register_view("stereographic")
class StereographicView(RayView):
    """A stereographic picture: objects keep their shape, and lean away from the middle.

    The middle column is level with `up`. The arguments and errors are those of `RayView`.
    """

    usual_fov = widest = math.radians(340)

    def half_width(self, angle: float) -> float:
        return 2 * math.tan(angle / 2)

    def to_plane(self, rays: Tensor) -> Tensor:
        # Straight behind, the scale is infinite.
        return 2 * rays[..., :2] / (1 + rays[..., 2:]).clamp(min=1e-12)

    def from_plane(self, points: Tensor) -> Tensor:
        x, y = points.split(1, -1)  # not `sum`, as in `length_of`
        square = (x * x + y * y) / 4
        return torch.cat((points, 1 - square), -1) / (1 + square)
