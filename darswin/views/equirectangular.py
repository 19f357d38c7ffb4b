"""An equirectangular map of what a camera sees."""

import math

import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.solve import length_of
from darswin.views.base import Pair
from darswin.views.directions import RayView, fields_of_view
from darswin.views.registry import register_view


@register_view("equirectangular")
class EquirectangularView(RayView):
    """A map of the sphere about the vertical: columns are equal longitudes, rows equal latitudes.

    Things stand upright, and are stretched sideways far above and below the horizon. Rows beyond
    the poles show nothing. The arguments and errors are those of `RayView`.
    """

    upright = True

    @classmethod
    def usual_shape(cls, lens: Lens, size: Pair, fov: float | None = None) -> tuple[float, float]:
        fov, _ = super().usual_shape(lens, size, fov)
        # The height of all that the picture shows; narrower views keep this shape.
        across, down = fields_of_view(lens, size)
        return fov, down / max(fov, across)

    def to_plane(self, rays: Tensor) -> Tensor:
        level = length_of(rays[..., ::2])
        longitude = torch.atan2(rays[..., 0], rays[..., 2])
        return torch.stack((longitude, torch.atan2(rays[..., 1], level)), -1)

    def from_plane(self, points: Tensor) -> Tensor:
        longitude, latitude = points.unbind(-1)
        level = torch.cos(latitude)
        rays = (level * torch.sin(longitude), torch.sin(latitude), level * torch.cos(longitude))
        inside = (latitude.abs() <= math.pi / 2)[..., None]
        return torch.where(inside, torch.stack(rays, -1), torch.nan)
