"""The images themselves."""

from typing import Any

import numpy as np
from torch import Tensor

from darswin.lens import Lens, pixels
from darswin.views.base import Pair, PreparedPixels
from darswin.views.pixels import PixelView, exact_grid, resized
from darswin.views.registry import register_view


@register_view("none")
class PlainView(PixelView):
    """The images themselves, for a network that does not know their lens.

    Args:
        size: (H, W) of the images; None for any size.
        mean, std: the arguments of `View`.
    """

    uses_lens = False

    def image_points(self, lens: Any, size: Pair) -> None:
        return None

    def view_points(self, lens: Any, size: Pair) -> None:
        return None

    def pixel_rays(self, lens: Any, size: Pair) -> tuple[Tensor, Tensor]:
        return pixels.pixel_rays(lens, size)

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return lens.unproject_points(points, size)

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        return lens.project_points(rays, size)

    def to_image(self, points: Tensor, lens: Any, size: Pair) -> Tensor:
        return points

    def to_view(self, points: Tensor, lens: Any, size: Pair) -> Tensor:
        return points

    def points_read(self, lens: Any, size: Pair) -> np.ndarray:
        return exact_grid(size)[0].numpy()

    def back(self, maps: Tensor, prepared: PreparedPixels) -> Tensor:
        return resized(maps, prepared.size)
