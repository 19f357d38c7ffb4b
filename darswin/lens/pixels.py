"""What a lens says of every pixel of an image: its ray, its solid angle, and z from distance.

Nothing here depends on what the image shows.
"""

import torch
from torch import Tensor

from darswin.lens.base import Lens, length_of
from darswin.lens.plane import determinant


def pixel_rays(lens: Lens, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The rays that land on the pixels' centres. Differentiable in the lens.

    Args:
        size: (H, W) of the image.

    Returns:
        θ (N, H, W), rad, NaN where no ray lands or the lens does not see it; and (cos φ, sin φ),
        (N, H, W, 2).
    """
    height, width = size
    like = lens.theta_max
    y, x = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    theta, direction = lens.rays(torch.stack((x, y), -1)[None], size)
    return torch.where(lens.sees(theta), theta, torch.nan), direction


def pixel_angles(lens: Lens, size: tuple[int, int]) -> Tensor:
    """θ at the pixels' centres, (N, H, W), rad; NaN where no ray lands, and beyond θ_max.

    Args:
        lens: N lenses. size: (H, W) of the image.
    """
    return pixel_rays(lens, size)[0]


def solid_angles(lens: Lens, size: tuple[int, int]) -> Tensor:
    """How much of the sphere around the camera each pixel shows, (N, H, W), sr.

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
    if len(lens) not in (1, values.shape[0]):
        raise ValueError(f"there are {len(lens)} lenses for {values.shape[0]} maps")
    theta = pixel_angles(lens, (values.shape[-2], values.shape[-1]))
    cosine = torch.nan_to_num(torch.cos(theta)).to(values)
    return cosine[:, None] if values.dim() == 4 else cosine
