"""Shows an image taken with one lens as another lens would have taken it."""

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


def warp_map(
    source: Lens, source_size: tuple[int, int], target: Lens, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Where in `source`'s image each pixel of `target`'s lies: the maps of `cv2.remap`.

    Convention:
        Pixel centres are integers in both images, x to the right and y down.

    Args:
        source: one lens, or one each. source_size: (H, W) of its image.
        target: N lenses. size: (H, W) of their images.

    Returns:
        x and y, (N, H, W) float32 each; outside the image where a ray is beyond either θ_max.
    """
    source, target = source.detach().to(torch.float64), target.detach().to(torch.float64)
    height, width = size
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64),
        torch.arange(width, dtype=torch.float64),
        indexing="ij",
    )
    cx, cy = target.center_in(size).T[..., None, None]
    x, y = x - cx, y - cy  # (N or 1, H, W)
    radius = torch.hypot(x, y).expand(len(target), -1, -1)
    theta = target.unproject(radius)
    limit = torch.minimum(source.theta_max, target.theta_max)[:, None, None]
    seen = theta <= limit * (1 + 1e-9)  # False for NaN
    there = source.project(torch.where(seen, theta, 0))
    # r_source / r_target keeps the azimuth; at the axis both radii are 0.
    ratio = there / radius.clamp(min=1e-12)
    sx, sy = source.center_in(source_size).T[..., None, None]
    maps = (torch.where(seen, s + d * ratio, -10) for s, d in ((sx, x), (sy, y)))
    return tuple(m.to(torch.float32).numpy() for m in maps)


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
