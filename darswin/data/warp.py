"""Shows an image taken with one lens as another lens would have taken it, through OpenCV."""

import cv2
import numpy as np
import torch

from darswin.lens import Lens
from darswin.lens.pixels import reprojection


def warp_map(
    source: Lens, source_size: tuple[int, int], target: Lens, size: tuple[int, int]
) -> np.ndarray:
    """`darswin.lens.pixels.reprojection` in double precision, as maps of `cv2.remap`.

    Returns:
        (N, H, W, 2) float32, x and y; outside the image where a ray is beyond either θ_max.
    """
    source, target = source.detach().to(torch.float64), target.detach().to(torch.float64)
    return reprojection(source, source_size, target, size).to(torch.float32).numpy()


def remap(
    image: np.ndarray,
    places: np.ndarray,
    interpolation: int = cv2.INTER_LINEAR,
    border: float = 0,
) -> np.ndarray:
    """An image (H, W) or (H, W, C) at the places (H', W', 2) of a map; `border` outside the image,
    0 is black."""
    # None: x and y are in one array, which OpenCV's types do not know.
    return cv2.remap(image, places, None, interpolation, borderValue=border)  # type: ignore[call-overload]


def warp(
    image: np.ndarray,
    source: Lens,
    target: Lens,
    size: tuple[int, int],
    *,
    interpolation: int = cv2.INTER_LINEAR,
) -> np.ndarray:
    """The view of `target` on what `source` saw in `image`; black beyond either lens's θ_max.

    Args:
        image: (H, W) or (H, W, C), uint8 or float32, taken with `source`.
        source, target: one lens each. size: (H, W) of the result.
        interpolation: of `cv2.remap`.

    Raises:
        ValueError: more than one lens. See `warp_map` for many.
    """
    if len(source) != 1 or len(target) != 1:
        raise ValueError(f"warp takes one lens each, got {len(source)} and {len(target)}")
    height, width = image.shape[:2]
    return remap(image, warp_map(source, (height, width), target, size)[0], interpolation)
