"""All pixels of an image: their rays and solid angles, z from distance, and what another lens sees.

A map tells for each pixel of a target where in the source's image its ray lands: (..., 2), x and y,
and (`OUTSIDE`, `OUTSIDE`) where no ray does. Nothing here depends on what the image shows.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens.base import Lens
from darswin.lens.ideal import Perspective
from darswin.lens.solve import determinant, length_of
from darswin.ops.checks import tensor_there

OUTSIDE = -10.0  # px: beyond any image, also for an interpolation of several pixels


def pixel_rays(lens: Lens, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The rays that land on the pixels' centres. Differentiable in the lens.

    Args:
        size: (H, W) of the image.

    Returns:
        θ (N, H, W), rad, NaN where no ray lands or the lens does not see it; and (cos φ, sin φ),
        (N, H, W, 2).
    """
    like = lens.theta_max
    rows, columns = (torch.arange(side, dtype=like.dtype, device=like.device) for side in size)
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    theta, direction = lens.rays(pixels[None], size)
    return torch.where(lens.sees(theta), theta, torch.nan), direction


def pixel_angles(lens: Lens, size: tuple[int, int]) -> Tensor:
    """θ of `pixel_rays`."""
    return pixel_rays(lens, size)[0]


def solid_angles(lens: Lens, size: tuple[int, int]) -> Tensor:
    """The solid angle of the sphere around the camera that each pixel shows, (N, H, W), sr.

    The area of a pixel times dΩ/dA at its centre, found in float64; 0 where θ is NaN. Those of an
    image that the whole circle lies in sum up to 2π (1 − cos θ_max), but for the pixels that the
    circle's rim cuts.

    Args:
        lens: N lenses. size: (H, W) of the image.
    """
    exact = lens.detach().to(torch.float64)
    theta, direction = pixel_rays(exact, size)
    seen = ~theta.isnan()
    # In the plane θ (cos φ, sin φ), dΩ = sin θ / θ dp, also on the axis.
    plane = torch.where(seen, theta, 0.0)[..., None] * torch.nan_to_num(direction)

    def place(point: Tensor) -> Tensor:
        angle = length_of(point)
        return exact.pixels(angle, point / angle[..., None], size)

    columns = [
        torch.func.jvp(place, (plane,), (axis.expand_as(plane),))[1]
        for axis in torch.eye(2, dtype=plane.dtype, device=plane.device)
    ]
    pixels_per_plane = determinant(torch.stack(columns, -1)).abs()
    area = torch.sinc(length_of(plane) / torch.pi) / pixels_per_plane
    return torch.where(seen, area, 0.0).to(lens.theta_max.dtype)


def distance_to_z(distance: Tensor, lens: Lens) -> Tensor:
    """Distance along the ray → z, along the optical axis: what pinhole cameras call depth.

    Args:
        distance: (N, H, W) or (N, 1, H, W), metres or any other unit; 0 where it is not known.
        lens: N lenses, or one.

    Returns:
        The shape of `distance`. Behind the camera, beyond 90°, z is below 0. It is 0 where the
        distance is, where no ray lands, and beyond θ_max.
    """
    return distance * _cosines(distance, lens)


def z_to_distance(z: Tensor, lens: Lens) -> Tensor:
    """z, along the optical axis → distance along the ray, the inverse of `distance_to_z`.

    Args:
        z: (N, H, W) or (N, 1, H, W); 0 where it is not known. lens: N lenses, or one.

    Returns:
        The shape of `z`; 0 where z is not known, where no ray lands, beyond θ_max, and where z has
        another sign than the ray.
    """
    cosine = _cosines(z, lens)
    known = z * cosine > 0
    return torch.where(known, z / torch.where(known, cosine, 1.0), 0.0)


def _cosines(values: Tensor, lens: Lens) -> Tensor:
    """cos θ of the pixels of (N, H, W) or (N, 1, H, W); 0 where the lens sees nothing."""
    if not isinstance(values, Tensor):
        raise TypeError(f"a map must be a tensor, got {type(values).__name__}")
    if values.dim() not in (3, 4) or (values.dim() == 4 and values.shape[1] != 1):
        raise ValueError(f"a map must be (N, H, W) or (N, 1, H, W), got {tuple(values.shape)}")
    if lens.count not in (1, values.shape[0]):
        raise ValueError(f"there are {lens.count} lenses for {values.shape[0]} maps")
    theta = pixel_angles(lens, (values.shape[-2], values.shape[-1]))
    cosine = torch.nan_to_num(torch.cos(theta)).to(values)
    return cosine[:, None] if values.dim() == 4 else cosine


def reprojection(
    source: Lens, source_size: tuple[int, int], target: Lens, size: tuple[int, int]
) -> Tensor:
    """The map (N, H, W, 2) of `target`'s pixels in `source`'s image; `OUTSIDE` where a ray is
    beyond either θ_max. Differentiable in both lenses; the sizes are (H, W) of their images."""
    theta, direction = pixel_rays(target, size)
    return as_map(source.seen_pixels(theta, direction, source_size))


def radial_reprojection(source: Lens, target: Lens, radii: Tensor) -> Tensor:
    """`reprojection` of two radial lenses without `affine`, along one azimuth.

    For radii (1, K) px, above 0, in the image of `target`, one lens: how many times as far from
    its own principal point `source` has the same ray; NaN where it is beyond either θ_max.
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
    """Images (B, C, H, W) read at pixels (B or 1, H', W', 2), bilinear and 0 outside, on the
    images' device and in their dtype → (B, C, H', W')."""
    height, width = images.shape[2:]
    exact = torch.promote_types(images.dtype, torch.float32)  # bfloat16 has no half pixels
    there = pixels.to(images.device, exact)
    # -1 and 1 are the image's edges, half a pixel beyond the centres of its outermost pixels.
    places = (2 * there + 1) / tensor_there((width, height), there) - 1
    places = places.expand(images.shape[0], -1, -1, -1)
    view = F.grid_sample(images.to(exact), places, padding_mode="zeros", align_corners=False)
    return view.to(images.dtype)


def perspective_view(lens: Lens, size: tuple[int, int], max_fov: float) -> Perspective:
    """The perspective lens that shows a lens's field of view in (H, W), with θ_max at half the
    shorter side; of a wider lens than `max_fov` (rad, below π) it shows the middle."""
    theta_max = lens.theta_max.clamp(max=max_fov / 2)
    focal = min(size) / 2 / torch.tan(theta_max)
    return Perspective._from_tensors(dict(focal=focal, theta_max=theta_max, center=None))
