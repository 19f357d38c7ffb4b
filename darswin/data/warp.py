"""Shows an image taken with one lens as another lens would have taken it."""

import cv2
import numpy as np
import torch

from darswin.lens import Lens
from darswin.lens.reprojection import reprojection


def warp_map(
    source: Lens, source_size: tuple[int, int], target: Lens, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """`darswin.lens.reprojection` in double precision, as the maps of `cv2.remap`.

    Returns:
        x and y, (N, H, W) float32 each; outside the image where a ray is beyond either θ_max.
    """
    source, target = source.detach().to(torch.float64), target.detach().to(torch.float64)
    there = reprojection(source, source_size, target, size).to(torch.float32).numpy()
    return np.ascontiguousarray(there[..., 0]), np.ascontiguousarray(there[..., 1])


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
    map_x, map_y = warp_map(source, image.shape[:2], target, size)
    return cv2.remap(
        image, map_x[0], map_y[0], interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0
    )
