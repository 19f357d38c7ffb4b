"""Undistorted pictures: an image as a view of `darswin.views` shows it, sampled with OpenCV.

A view such as `TangentView` says where its pixels look, and `undistort` samples an image there::

    view = make_view("tangent", (480, 640), fov=1.6, **turned(yaw=0.7))
    picture = undistort(image, lens, view)

One perspective picture cannot hold a lens of 190°; `turned` looks to the sides, and the other views
show more.
"""

import cv2
import numpy as np
import torch
from torch import Tensor

from darswin.data.warping import area_resized, remap
from darswin.lens import Lens
from darswin.views import PixelView

__all__ = ["undistort", "view_map"]


def view_map(lens: Lens, view: PixelView, size: tuple[int, int]) -> np.ndarray:
    """The points at which a view reads images of (H, W), as a map for `cv2.remap`.

    Args:
        lens: one lens. view: of (H', W') pixels, each the mean of k² points; k is
            `view.reads_of(size)`, and 1 unless the view shrinks the picture.

    Returns:
        (k·H', k·W', 2) float32, x and y; `OUTSIDE` where nothing is shown. Tiles are below each
        other.

    Raises:
        TypeError: the view has no pixels along rays.
        ValueError: there are several lenses, or the view sees nothing of the lens.
    """
    if len(lens) != 1:
        raise ValueError(f"a view needs one lens, got {len(lens)}")
    points = None
    if isinstance(view, PixelView):
        exact = lens.detach().to("cpu", torch.float64)
        points = view.prepare(exact, size, back=False, rays=False).points
    if not isinstance(points, Tensor):
        raise TypeError(f"view must have pixels along rays, as a RayView, got {view!s:.200}")
    return points[0].to(torch.float32).numpy()


def undistort(
    image: np.ndarray, lens: Lens, view: PixelView, *, interpolation: int = cv2.INTER_LINEAR
) -> np.ndarray:
    """The image as a view shows it; black where the lens or the image ends.

    Args:
        image: (H, W) or (H, W, C), uint8 or float32, taken with `lens`.
        lens: one lens. view: of (H', W') pixels, such as a `RayView` or a `SquareView`.
        interpolation: of `cv2.remap`. Pixels that read several points are the mean of them.

    Returns:
        (H', W') or (H', W', C), of the image's type. n tiles are below each other, (n·H', W').

    Raises:
        TypeError, ValueError: see `view_map`.
    """
    places = view_map(lens, view, (image.shape[0], image.shape[1]))
    reads = view.reads_of((image.shape[0], image.shape[1]))
    height, width = places.shape[0] // reads, places.shape[1] // reads
    read = remap(image, places, interpolation)
    return area_resized(read, (height, width)).reshape(height, width, *image.shape[2:])
