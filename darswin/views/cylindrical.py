"""A panorama of what a camera sees, on an upright cylinder."""

import torch
from torch import Tensor

from darswin.lens.solve import length_of
from darswin.views.directions import RayView
from darswin.views.registry import register_view


@register_view("cylindrical")
class CylindricalView(RayView):
    """The picture on a cylinder about the vertical: columns are equal angles, verticals straight.

    The arguments and errors are those of `RayView`.
    """

    upright = True
    aspect = 1 / 2

    def to_plane(self, rays: Tensor) -> Tensor:
        level = length_of(rays[..., ::2])
        return torch.stack((torch.atan2(rays[..., 0], rays[..., 2]), rays[..., 1] / level), -1)

    def from_plane(self, points: Tensor) -> Tensor:
        longitude, y = points.unbind(-1)
        level = torch.rsqrt(1 + y * y)
        rays = (level * torch.sin(longitude), level * y, level * torch.cos(longitude))
        return torch.stack(rays, -1)
