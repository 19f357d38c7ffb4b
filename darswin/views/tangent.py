"""A perspective picture in one direction, as of a narrow camera that looks there."""

import math

import torch
from torch import Tensor

from darswin.views.directions import RayView
from darswin.views.registry import register_view


@register_view("tangent")
class TangentView(RayView):
    """A perspective picture around one `direction`: straight lines stay straight.

    This is the picture for a network that looks at one thing, such as a classifier. It gets coarse
    in the middle above 100°, so a view of a whole lens ends there. The arguments and errors are
    those of `RayView`, but `fov` is below π.
    """

    reach = math.radians(50)
    widest = math.radians(179.9)

    def half_width(self, angle: float) -> float:
        return math.tan(angle)

    def to_plane(self, rays: Tensor) -> Tensor:
        ahead = rays[..., 2:]
        flat = rays[..., :2] / torch.where(ahead > 0, ahead, 1.0)
        return torch.where(ahead > 0, flat, torch.nan)

    def from_plane(self, points: Tensor) -> Tensor:
        length = torch.rsqrt(1 + points.square().sum(-1, keepdim=True))
        return torch.cat((points * length, length), -1)
