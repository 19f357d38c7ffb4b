"""A Mercator map of what a camera sees: upright and conformal."""

import torch
from torch import Tensor

from darswin.lens.solve import length_of
from darswin.views.directions import RayView
from darswin.views.registry import register_view


@register_view("mercator")
class MercatorView(RayView):
    """A Mercator map about the vertical: objects stand upright and keep their shape.

    Columns are equal angles, and rows keep the scale of their columns, so that only sizes differ.
    Pretrained networks find most in this view, if they run once on each picture.

    The arguments and errors are those of `RayView`.
    """

    upright = True

    def to_plane(self, rays: Tensor) -> Tensor:
        longitude, level = torch.atan2(rays[..., 0], rays[..., 2]), length_of(rays[..., ::2])
        return torch.stack((longitude, torch.asinh(rays[..., 1] / level)), -1)

    def from_plane(self, points: Tensor) -> Tensor:
        longitude, y = points.unbind(-1)
        level = 1 / torch.cosh(y)
        return torch.stack(
            (level * torch.sin(longitude), torch.tanh(y), level * torch.cos(longitude)), -1
        )
