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

from darswin.data.warp import remap
from darswin.lens import Lens
from darswin.lens.pixels import as_map


def perspective(
    size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a pinhole camera, in whose view straight lines are straight.

    Args:
        size: (H, W) of the view. fov: in (0, π), rad. yaw, pitch: rad.

    Returns:
        (H, W, 3), float64.
    """
    _check_fov(fov, math.pi, "below π")
    x, y = _plane(size, 2 * math.tan(fov / 2))
    return turned(torch.stack((x, y, torch.ones_like(x)), -1), yaw, pitch)


def cylindrical(
    size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a panorama on an upright cylinder: columns are equal angles, verticals straight.

    Args:
        size: (H, W) of the view. fov: in (0, 2π], rad. yaw, pitch: rad.

    Returns:
        (H, W, 3), float64.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    longitude, y = _plane(size, fov)
    return turned(torch.stack((torch.sin(longitude), y, torch.cos(longitude)), -1), yaw, pitch)


def equirectangular(
    size: tuple[int, int], fov: float = 2 * math.pi, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a map of the sphere: columns are equal longitudes, rows equal latitudes.

    With the `fov` of 2π and H = W/2 it is the whole sphere, its middle the optical axis.

    Args:
        size: (H, W) of the view. fov: in (0, 2π], rad. yaw, pitch: rad.

    Returns:
        (H, W, 3), float64. Zeros, which see nothing, in rows beyond the poles.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    longitude, latitude = _plane(size, fov)
    level = torch.cos(latitude)
    rays = torch.stack(
        (level * torch.sin(longitude), torch.sin(latitude), level * torch.cos(longitude)), -1
    )
    rays = torch.where((latitude.abs() <= math.pi / 2)[..., None], rays, 0.0)
    return turned(rays, yaw, pitch)


def turned(rays: Tensor, yaw: float, pitch: float) -> Tensor:
    """Rays (..., 3) seen by a camera that looks `yaw` to the right and `pitch` up, rad."""
    cos, sin = math.cos(pitch), math.sin(pitch)
    pitched = rays.new_tensor([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    cos, sin = math.cos(yaw), math.sin(yaw)
    yawed = rays.new_tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return rays @ (yawed @ pitched).T


def view_map(lens: Lens, rays: Tensor, image_size: tuple[int, int] | None = None) -> np.ndarray:
    """Where in the image of a lens its rays land, as a map of `cv2.remap`.

    Args:
        lens: one lens. rays: (H, W, 3). image_size: (H', W') of the lens's image, for the principal
            point of a lens that has none.

    Returns:
        (H, W, 2) float32, x and y; `darswin.lens.pixels.OUTSIDE` beyond θ_max.

    Raises:
        ValueError: more than one lens, or rays of another shape.
    """
    if len(lens) != 1:
        raise ValueError(f"a view is of one lens, got {len(lens)}")
    if rays.dim() != 3 or rays.shape[2] != 3:
        raise ValueError(f"rays must have shape (H, W, 3), got {tuple(rays.shape)}")
    lens, rays = lens.detach().to("cpu", torch.float64), rays.detach().to("cpu", torch.float64)
    return as_map(lens.project_points(rays[None], image_size))[0].to(torch.float32).numpy()


def undistort(
    image: np.ndarray, lens: Lens, rays: Tensor, *, interpolation: int = cv2.INTER_LINEAR
) -> np.ndarray:
    """What a camera sees along rays; black beyond its lens's θ_max and outside its image.

    Args:
        image: (H, W) or (H, W, C), uint8 or float32, taken with `lens`.
        lens: one lens. rays: (H', W', 3), from `perspective`, `cylindrical`, `equirectangular` or
            elsewhere. interpolation: of `cv2.remap`.

    Returns:
        (H', W') or (H', W', C), of the image's type.

    Raises:
        ValueError: as `view_map`.
    """
    height, width = image.shape[:2]
    return remap(image, view_map(lens, rays, (height, width)), interpolation)


def _plane(size: tuple[int, int], width: float) -> tuple[Tensor, Tensor]:
    """The coordinates of the pixels of (H, W) from their middle, where W of them are `width`."""
    rows, columns = size
    step = width / columns
    y = (torch.arange(rows, dtype=torch.float64) - (rows - 1) / 2) * step
    x = (torch.arange(columns, dtype=torch.float64) - (columns - 1) / 2) * step
    y, x = torch.meshgrid(y, x, indexing="ij")
    return x, y


def _check_fov(fov: float, end: float, range_: str, closed: bool = False) -> None:
    if not (0 < fov < end or (closed and fov == end)):
        raise ValueError(f"fov must be above 0 and {range_} rad, got {fov}")
