"""A perspective view of each image, as an ideal camera without distortion would see it."""

import math

from torch import Tensor

from darswin.lens import Lens, pixels
from darswin.utils.angles import degrees_hint
from darswin.views.base import Pair, PerChannel
from darswin.views.pixels import PixelView
from darswin.views.registry import register_view


@register_view("perspective")
class PerspectiveView(PixelView):
    """A perspective view of each image, with the field of view of the lens, but `max_fov` at most.

    Pixels of the images that are outside the view get 0 on the way back.

    Args:
        size: (H', W') of the view.
        max_fov: the largest field of view, in (0, π) rad.
        mean, std: the arguments of `View`.

    Raises:
        ValueError: max_fov is out of range.
    """

    size: Pair

    def __init__(
        self,
        size: Pair,
        max_fov: float = math.radians(175),
        *,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(size, mean=mean, std=std)
        if not 0 < max_fov < math.pi:
            hint = degrees_hint(max_fov)
            raise ValueError(f"max_fov must be in (0, π), got {max_fov}{hint}")
        self.max_fov = float(max_fov)

    def image_points(self, lens: Lens, size: Pair) -> Tensor:
        return pixels.reprojection(lens, size, self._lens(lens), self.size)

    def view_points(self, lens: Lens, size: Pair) -> Tensor:
        return pixels.reprojection(self._lens(lens), self.size, lens, size)

    def pixel_rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        return pixels.pixel_rays(self._lens(lens), self.size)

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return self._lens(lens).unproject_points(points, self.size)

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        return self._lens(lens).project_points(rays, self.size)

    def _lens(self, lens: Lens) -> Lens:
        return pixels.perspective_view(lens, self.size, self.max_fov)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, max_fov={self.max_fov:g}"
