"""Shows an image taken with one lens as another lens would have taken it."""

import math

import cv2
import numpy as np
import torch

from darswin.lens import Lens

# The paper's four levels of distortion, as ranges of ξ of the Spherical lens (sec. 5.1).
LEVELS = {
    "very low": (0.0, 0.05),
    "low": (0.2, 0.35),
    "medium": (0.5, 0.7),
    "high": (0.85, 1.0),
}


def warp(
    image: np.ndarray,
    source: Lens,
    target: Lens,
    size: tuple[int, int],
    *,
    interpolation: int = cv2.INTER_LINEAR,
) -> np.ndarray:
    """The view of `target` on what `source` saw in `image`; black beyond either lens's θ_max.

    Convention:
        Pixel centres are integers in both images, x to the right and y down.

    Args:
        image: (H, W) or (H, W, C), uint8 or float32, taken with `source`.
        source, target: one lens each. size: (H, W) of the result.
        interpolation: of `cv2.remap`.

    Raises:
        ValueError: more than one lens.
    """
    if len(source) != 1 or len(target) != 1:
        raise ValueError(f"warp takes one lens each, got {len(source)} and {len(target)}")
    source, target = source.detach().to(torch.float64), target.detach().to(torch.float64)
    height, width = size
    cx, cy = target.center_in(size)[0].tolist()
    y, x = np.mgrid[:height, :width].astype(np.float64)
    x, y = x - cx, y - cy
    radius = np.hypot(x, y)
    theta = target.unproject(torch.from_numpy(radius)).numpy()
    limit = min(source.theta_max.item(), target.theta_max.item())
    seen = theta <= limit * (1 + 1e-9)  # False for NaN
    there = source.project(torch.from_numpy(np.where(seen, theta, 0.0))).numpy()
    sx, sy = source.center_in(image.shape[:2])[0].tolist()
    # r_source / r_target keeps the azimuth; at the axis both radii are 0.
    ratio = np.divide(there, radius, out=np.zeros_like(radius), where=radius > 0)
    map_x = np.where(seen, sx + x * ratio, -math.inf).astype(np.float32)
    map_y = np.where(seen, sy + y * ratio, -math.inf).astype(np.float32)
    return cv2.remap(
        image, map_x.clip(-2), map_y.clip(-2), interpolation, borderMode=cv2.BORDER_CONSTANT
    )
