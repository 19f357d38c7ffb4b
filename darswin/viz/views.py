"""Undistorted views: a camera's image as another, ideal camera would show it, through OpenCV.

A view is the rays that its pixels look along, (H, W, 3), of any length and anywhere on the sphere:
`perspective`, `cylindrical` and `equirectangular` make them, `undistort` looks an image up along
them. A lens of 190° shows more than one perspective view holds; `yaw` and `pitch` look aside.

Convention:
    Camera frame: x to the right, y down, z forward along the optical axis. A ray (x, y, z) has
    θ = atan2(√(x² + y²), z) and φ = atan2(y, x). Pixel centres are integers, and the middle of a
    view is the middle of its pixels, ((W-1)/2, (H-1)/2). yaw > 0 looks to the right and pitch > 0
    up; the view is pitched first, so that yaw turns it around the camera's y axis and keeps the
    horizon level.
    `fov` is the horizontal field of view between the outer edges of a row's outermost pixels; the
    vertical one follows, as pixels are square in the middle of the view.
"""

import math

import cv2
import numpy as np
import torch
from torch import Tensor

from darswin.data.warping import remap
from darswin.lens import Lens
from darswin.lens.pixels import as_map

__all__ = ["cylindrical", "equirectangular", "perspective", "undistort"]


def perspective(
    size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a pinhole camera, in whose view straight lines are straight.

    Of a view of (H, W), with a `fov` in (0, π) rad; yaw and pitch are in rad → (H, W, 3), float64.
    """
    _check_fov(fov, math.pi, "below π")
    x, y = _plane(size, 2 * math.tan(fov / 2))
    return rotated(torch.stack((x, y, torch.ones_like(x)), -1), yaw, pitch)


def cylindrical(
    size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a panorama on an upright cylinder: columns are equal angles, verticals straight.

    As `perspective`, but with a `fov` in (0, 2π] rad.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    longitude, y = _plane(size, fov)
    return rotated(torch.stack((torch.sin(longitude), y, torch.cos(longitude)), -1), yaw, pitch)


def equirectangular(
    size: tuple[int, int], fov: float = 2 * math.pi, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a map of the sphere: columns are equal longitudes, rows equal latitudes.

    As `perspective`, but with a `fov` in (0, 2π] rad: with 2π and H = W/2 it is the whole sphere,
    its middle the optical axis. Rows beyond the poles are zeros, which see nothing.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    longitude, latitude = _plane(size, fov)
    level = torch.cos(latitude)
    rays = torch.stack(
        (level * torch.sin(longitude), torch.sin(latitude), level * torch.cos(longitude)), -1
    )
    rays = torch.where((latitude.abs() <= math.pi / 2)[..., None], rays, 0.0)
    return rotated(rays, yaw, pitch)


def rotated(rays: Tensor, yaw: float, pitch: float) -> Tensor:
    """Rays (..., 3) of a camera that looks `yaw` to the right and `pitch` up, rad."""
    cos, sin = math.cos(pitch), math.sin(pitch)
    pitched = rays.new_tensor([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    cos, sin = math.cos(yaw), math.sin(yaw)
    yawed = rays.new_tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return rays @ (yawed @ pitched).T


def view_map(lens: Lens, rays: Tensor, image_size: tuple[int, int] | None = None) -> np.ndarray:
    """The places in the image of a lens where rays (H, W, 3) land, as a map of `cv2.remap`:
    (H, W, 2) float32, x and y; `OUTSIDE` beyond θ_max."""
    if len(lens) != 1:
        raise ValueError(f"a view is of one lens, got {len(lens)}")
    if rays.dim() != 3 or rays.shape[2] != 3:
        raise ValueError(f"rays must have shape (H, W, 3), got {tuple(rays.shape)}")
    lens, rays = lens.detach().to("cpu", torch.float64), rays.detach().to("cpu", torch.float64)
    return as_map(lens.project_points(rays[None], image_size))[0].to(torch.float32).numpy()


def undistort(
    image: np.ndarray, lens: Lens, rays: Tensor, *, interpolation: int = cv2.INTER_LINEAR
) -> np.ndarray:
    """The image that a camera sees along rays; black beyond its θ_max and outside of its image.

    Args:
        image: (H, W) or (H, W, C), uint8 or float32, taken with `lens`.
        lens: one lens. rays: (H', W', 3). interpolation: of `cv2.remap`.

    Returns:
        (H', W') or (H', W', C), of the image's type.

    Raises:
        ValueError: more than one lens, or rays of another shape.
    """
    height, width = image.shape[:2]
    return remap(image, view_map(lens, rays, (height, width)), interpolation)


def _plane(size: tuple[int, int], width: float) -> tuple[Tensor, Tensor]:
    """The coordinates of the pixels of (H, W) from their middle, where W of them are `width`."""
    step = width / size[1]
    y, x = ((torch.arange(side, dtype=torch.float64) - (side - 1) / 2) * step for side in size)
    y, x = torch.meshgrid(y, x, indexing="ij")
    return x, y


def _check_fov(fov: float, end: float, range_: str, closed: bool = False) -> None:
    if not (0 < fov < end or (closed and fov == end)):
        raise ValueError(f"fov must be above 0 and {range_} rad, got {fov}")
