"""What one lens shows, in another lens's image: where it stands, and how it looks.

A map says for each pixel of a target where in the source's image its ray lands: (..., 2), x and y,
and (`OUTSIDE`, `OUTSIDE`) where no ray does.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens.base import Lens
from darswin.lens.ideal import Perspective
from darswin.lens.pixels import pixel_rays
from darswin.ops.waiting import tensor_there

OUTSIDE = -10.0  # px: beyond any image, also for an interpolation of several pixels


def reprojection(
    source: Lens, source_size: tuple[int, int], target: Lens, size: tuple[int, int]
) -> Tensor:
    """Where in `source`'s image each pixel of `target`'s lies. Differentiable in both lenses.

    Convention:
        Pixel centres are integers in both images, x to the right and y down.

    Args:
        source, target: N lenses each, or one. source_size, size: (H, W) of their images.

    Returns:
        (N, H, W, 2): x and y; `OUTSIDE` where a ray is beyond either θ_max.
    """
    theta, direction = pixel_rays(target, size)
    return as_map(source.seen_pixels(theta, direction, source_size))


def radial_reprojection(source: Lens, target: Lens, radii: Tensor) -> Tensor:
    """`reprojection` of two radial lenses without `affine`, along one azimuth.

    Args:
        radii: (1, K) px, above 0, from the principal point of `target`, one lens.

    Returns:
        (1, K): how many times as far from its own principal point `source` has the same ray; NaN
        where a ray is beyond either θ_max.
    """
    theta = target.unproject(radii)
    seen = target.sees(theta) & source.sees(theta)
    return torch.where(seen, source.project(torch.where(seen, theta, 0.0)) / radii, torch.nan)


def as_map(pixels: Tensor) -> Tensor:
    """Pixels (..., 2) with `OUTSIDE` in place of NaN."""
    return torch.where(pixels.isnan(), OUTSIDE, pixels)


def reproject(images: Tensor, source: Lens, target: Lens, size: tuple[int, int]) -> Tensor:
    """The view of `target` on what `source` saw, bilinear; 0 beyond either θ_max.

    Runs on the images' device. Gradients go to the images and both lenses.

    Args:
        images: (B, C, H, W), floating point, taken with `source`.
        source, target: B lenses each, or one.
        size: (H', W') of the view.

    Returns:
        (B, C, H', W').
    """
    height, width = images.shape[2:]
    return sample_at(images, reprojection(source, (height, width), target, size))


def sample_at(images: Tensor, pixels: Tensor) -> Tensor:
    """Images (B, C, H, W) read at pixels (B or 1, H', W', 2), x and y → (B, C, H', W').

    Bilinear, 0 outside, on the images' device and in their dtype.
    """
    height, width = images.shape[2:]
    exact = torch.promote_types(images.dtype, torch.float32)  # bfloat16 has no half pixels
    there = pixels.to(images.device, exact)
    # -1 and 1 are the image's edges, half a pixel beyond the centres of its outermost pixels.
    places = (2 * there + 1) / tensor_there((width, height), there) - 1
    places = places.expand(images.shape[0], -1, -1, -1)
    view = F.grid_sample(images.to(exact), places, padding_mode="zeros", align_corners=False)
    return view.to(images.dtype)


def perspective_view(lens: Lens, size: tuple[int, int], max_fov: float) -> Perspective:
    """The perspective lens that shows a lens's field of view, up to `max_fov`, in (H, W).

    θ_max lands at half the shorter side. `max_fov` (rad, below π) bounds what a perspective lens
    cannot show: of a wider lens it shows the middle.
    """
    theta_max = lens.theta_max.clamp(max=max_fov / 2)
    focal = min(size) / 2 / torch.tan(theta_max)
    return Perspective._from_tensors(dict(focal=focal, theta_max=theta_max, center=None))
