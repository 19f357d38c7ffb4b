"""All around a camera, upright: for cameras that look down or up."""

from darswin.views.base import Pair, PerChannel
from darswin.views.directions import Vector
from darswin.views.mercator import MercatorView
from darswin.views.registry import register_view


@register_view("panorama")
class PanoramaView(MercatorView):
    """All directions around the vertical, as a Mercator map: for cameras that look down or up.

    The view is 360° wide. Its rows show what the lens sees, as far as its height allows and near
    the horizon first; sizes with W' = 3 H' suit a camera that looks straight down. Give `up`
    unless the camera stands upright.

    The arguments and errors are those of `RayView`, but `fov` is 2π.
    """

    around = True

    def __init__(
        self,
        size: Pair,
        theta_max: float | None = None,
        *,
        up: Vector | None = None,
        direction: Vector | None = None,
        reads: int | None = None,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(
            size, None, theta_max, up=up, direction=direction, reads=reads, mean=mean, std=std
        )
