"""Where what one lens shows at a pixel stands in another lens's image."""

import torch
from torch import Tensor

from darswin.lens import Lens


def reprojection(
    source: Lens, source_size: tuple[int, int], target: Lens, size: tuple[int, int]
) -> Tensor:
    """Where in `source`'s image each pixel of `target`'s lies. Differentiable in both lenses.

    Convention:
        Pixel centres are integers in both images, x to the right and y down.

    Args:
        source, target: N lenses each, or one. source_size, size: (H, W) of their images.

    Returns:
        (N, H, W, 2): x and y; (-10, -10), outside the image, where a ray is beyond either θ_max.
    """
    like = target.theta_max
    height, width = size
    y, x = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    offset = torch.stack((x, y), -1) - target.center_in(size)[:, None, None]
    # Away from 0, where a root has no slope: r_source / r_target has a limit there all the same.
    square = offset.square().sum(-1).clamp(min=1e-12)
    radius = square.sqrt().expand(len(target), -1, -1)
    theta = target.unproject(radius)
    limit = torch.minimum(source.theta_max, target.theta_max)[:, None, None]
    seen = theta <= limit * (1 + 4 * torch.finfo(like.dtype).eps)  # False for NaN
    ratio = source.project(torch.where(seen, theta, limit)) / radius  # keeps the azimuth
    there = source.center_in(source_size)[:, None, None] + offset * ratio[..., None]
    return torch.where(seen[..., None], there, -10)
