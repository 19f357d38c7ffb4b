"""All around a camera, upright: for cameras that look down or up."""

from darswin.views.mercator import MercatorView
from darswin.views.registry import register_view


@register_view("panorama")
class PanoramaView(MercatorView):
    """All directions around the vertical, as a Mercator map: for cameras that look down or up.

    Without `fov`, the view is 360° wide. Its rows show what the lens sees, as far as its height
    allows and near the horizon first; sizes with W' = 3 H' suit a camera that looks straight down.
    Give `up` unless the camera stands upright. The arguments and errors are those of `RayView`.
    """

    around = True
    aspect = 1 / 3
