"""All pixels of an image: rays, solid angles, z from distance, and samples at any points."""

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import handle_torch_function, has_torch_function_unary

from darswin.lens.base import Lens
from darswin.lens.solve import determinant, length_of, vector_of
from darswin.ops.checks import tensor_there

OUTSIDE = -10.0  # px: beyond any image, also for interpolation over several pixels


def pixel_grid(size: tuple[int, int], like: Tensor) -> Tensor:
    """The pixels (x, y) of (H, W), (1, H, W, 2), with the dtype and the device of `like`."""
    rows, columns = (torch.arange(side, dtype=like.dtype, device=like.device) for side in size)
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)[None]


def pixel_rays(lens: Lens, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The rays that land on the pixels' centres. Differentiable in the lens.

    Args:
        size: (H, W) of the image.

    Returns:
        θ (N, H, W), rad, NaN where no ray lands or beyond θ_max; and (cos φ, sin φ), (N, H, W, 2).
    """
    theta, direction = lens.theta_and_direction(pixel_grid(size, lens.theta_max), size)
    return torch.where(lens.sees(theta), theta, torch.nan), direction


def ray_channels(theta: Tensor, direction: Tensor) -> Tensor:
    """The viewing directions of pixels as channels. Differentiable.

    Args:
        theta, direction: as `pixel_rays` returns them.

    Returns:
        The unit vectors (x, y, z), (N, 3, H, W); 0 where θ is NaN.
    """
    rays = torch.where(theta.isnan()[..., None], 0.0, vector_of(theta, direction))
    return rays.permute(0, 3, 1, 2)


def pixel_angles(lens: Lens, size: tuple[int, int]) -> Tensor:
    """θ of `pixel_rays`."""
    return pixel_rays(lens, size)[0]


def solid_angles(lens: Lens, size: tuple[int, int]) -> Tensor:
    """The solid angle that each pixel shows, (N, H, W), sr.

    This is the area of a pixel times dΩ/dA at its centre, computed in float64; 0 where θ is NaN. In
    an image that contains the whole image circle, the sum is 2π (1 − cos θ_max), except for the
    pixels on the rim.

    Args:
        lens: N lenses. size: (H, W) of the image.
    """
    exact = lens.detach().to(torch.float64)
    theta, direction = pixel_rays(exact, size)
    known = ~theta.isnan()
    # In the plane θ (cos φ, sin φ), dΩ = sin θ / θ dp, also on the axis.
    plane = torch.where(known, theta, 0.0)[..., None] * torch.nan_to_num(direction)

    def place(point: Tensor) -> Tensor:
        angle = length_of(point)
        return exact.pixels(angle, point / angle[..., None], size)

    columns = [
        torch.func.jvp(place, (plane,), (axis.expand_as(plane),))[1]
        for axis in torch.eye(2, dtype=plane.dtype, device=plane.device)
    ]
    pixels_per_plane = determinant(torch.stack(columns, -1)).abs()
    area = torch.sinc(length_of(plane) / torch.pi) / pixels_per_plane
    return torch.where(known, area, 0.0).to(lens.theta_max.dtype)


def distance_to_z(distance: Tensor, lens: Lens) -> Tensor:
    """Converts distance along the ray to z along the optical axis, a pinhole camera's depth.

    Args:
        distance: (N, H, W) or (N, 1, H, W), metres or any other unit; 0 where it is unknown.
        lens: N lenses, or one.

    Returns:
        z, in the shape of `distance`. Behind the camera, beyond 90°, z is below 0. It is 0 where
        the distance is 0, where no ray lands, and beyond θ_max.
    """
    return distance * _cosines(distance, lens)


def z_to_distance(z: Tensor, lens: Lens) -> Tensor:
    """Converts z along the optical axis to distance along the ray: the inverse of `distance_to_z`.

    Args:
        z: (N, H, W) or (N, 1, H, W); 0 where it is unknown. lens: N lenses, or one.

    Returns:
        The distance, in the shape of `z`; 0 where z is unknown, where no ray lands, beyond θ_max,
        and where z and the ray have different signs.
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


def as_map(pixels: Tensor) -> Tensor:
    """Pixels (..., 2) with `OUTSIDE` in place of NaN."""
    return torch.where(pixels.isnan(), OUTSIDE, pixels)


def sample_at(images: Tensor, pixels: Tensor) -> Tensor:
    """Samples images (B, C, H, W) at pixels (B or 1, H', W', 2), bilinearly and with 0 outside:
    (B, C, H', W') on the images' device and in their dtype. Of integers it takes the nearest."""
    if has_torch_function_unary(images):
        return handle_torch_function(sample_at, (images,), images, pixels)
    height, width = images.shape[2:]
    mode = "bilinear" if images.is_floating_point() else "nearest"
    least = torch.float32 if mode == "bilinear" else torch.float64  # which holds large integers
    exact = torch.promote_types(images.dtype, least)  # bfloat16 has no half pixels
    there = pixels.to(images.device, exact)
    # -1 and 1 are the image's edges, half a pixel beyond the centres of its outermost pixels.
    points = (2 * there + 1) / tensor_there((width, height), there) - 1
    points = points.expand(images.shape[0], -1, -1, -1)
    view = F.grid_sample(images.to(exact), points, mode, padding_mode="zeros", align_corners=False)
    return view.to(images.dtype)
