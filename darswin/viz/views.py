"""Undistorted views: the image that an ideal camera would take in place of a calibrated one.

A view consists of the rays of its pixels, (H, W, 3), of any length and direction. `perspective`,
`cylindrical`, `equirectangular` and `square` compute them, and `undistort` samples an image along
them with OpenCV. One perspective view cannot hold a lens of 190°; `yaw` and `pitch` turn the view.

Convention:
    Camera coordinates: x to the right, y down, z forward along the optical axis. A ray (x, y, z)
    has θ = atan2(√(x² + y²), z) and φ = atan2(y, x). Pixel centres are integers, and the middle of
    a view is the middle of its pixels, ((W-1)/2, (H-1)/2). yaw > 0 looks to the right and pitch > 0
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
from darswin.lens.concentric import square_to_disc
from darswin.lens.pixels import as_map
from darswin.lens.solve import vector_of
from darswin.utils.angles import check_turn, degrees_hint

__all__ = ["cylindrical", "equirectangular", "perspective", "square", "undistort"]


def perspective(
    size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a pinhole camera, which shows straight lines straight: (H, W, 3), float64.

    `size` is (H, W), `fov` lies in (0, π) rad, and yaw and pitch in [-2π, 2π] rad.
    """
    _check_fov(fov, math.pi, "below π")
    x, y = _plane(size, 2 * math.tan(fov / 2))
    return rotated(torch.stack((x, y, torch.ones_like(x)), -1), yaw, pitch)


def cylindrical(
    size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a panorama on an upright cylinder: columns are equal angles, verticals straight.

    The arguments are those of `perspective`, but `fov` lies in (0, 2π] rad.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    longitude, y = _plane(size, fov)
    return rotated(torch.stack((torch.sin(longitude), y, torch.cos(longitude)), -1), yaw, pitch)


def equirectangular(
    size: tuple[int, int], fov: float = 2 * math.pi, *, yaw: float = 0.0, pitch: float = 0.0
) -> Tensor:
    """The rays of a map of the sphere: columns are equal longitudes, rows equal latitudes.

    The arguments are those of `perspective`, but `fov` lies in (0, 2π] rad. With 2π and H = W/2 the
    map shows the whole sphere, with the optical axis in its middle. Rows beyond the poles are
    zeros, which show nothing.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    longitude, latitude = _plane(size, fov)
    level = torch.cos(latitude)
    rays = torch.stack(
        (level * torch.sin(longitude), torch.sin(latitude), level * torch.cos(longitude)), -1
    )
    rays = torch.where((latitude.abs() <= math.pi / 2)[..., None], rays, 0.0)
    return rotated(rays, yaw, pitch)


def square(size: tuple[int, int], fov: float, *, yaw: float = 0.0, pitch: float = 0.0) -> Tensor:
    """The rays of the concentric square, which a `LensAdapter` sees: squares around the middle are
    circles around the axis, and equal steps are equal angles.

    The arguments are those of `perspective`, but H = W, and `fov` lies in (0, 2π] rad: the edge is
    at fov/2 from the axis.
    """
    _check_fov(fov, 2 * math.pi, "at most 2π", closed=True)
    if size[0] != size[1]:
        raise ValueError(f"size must be square for this view, got {size}")
    radius, direction = square_to_disc(torch.stack(_plane(size, 2.0), -1))
    return rotated(vector_of(fov / 2 * radius, direction), yaw, pitch)


def rotated(rays: Tensor, yaw: float, pitch: float) -> Tensor:
    """Rays (..., 3) of a camera that looks `yaw` to the right and `pitch` up, rad."""
    check_turn("yaw", yaw)
    check_turn("pitch", pitch)
    cos, sin = math.cos(pitch), math.sin(pitch)
    pitched = rays.new_tensor([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    cos, sin = math.cos(yaw), math.sin(yaw)
    yawed = rays.new_tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return rays @ (yawed @ pitched).T


def view_map(lens: Lens, rays: Tensor, image_size: tuple[int, int] | None = None) -> np.ndarray:
    """The pixels of rays (H, W, 3) in the image of a lens, as a map for `cv2.remap`: (H, W, 2)
    float32, x and y; `OUTSIDE` beyond θ_max."""
    if len(lens) != 1:
        raise ValueError(f"a view needs one lens, got {len(lens)}")
    if rays.dim() != 3 or rays.shape[2] != 3:
        raise ValueError(f"rays must have shape (H, W, 3), got {tuple(rays.shape)}")
    lens, rays = lens.detach().to("cpu", torch.float64), rays.detach().to("cpu", torch.float64)
    return as_map(lens.project_points(rays[None], image_size))[0].to(torch.float32).numpy()


def undistort(
    image: np.ndarray, lens: Lens, rays: Tensor, *, interpolation: int = cv2.INTER_LINEAR
) -> np.ndarray:
    """Samples an image along rays; pixels beyond θ_max or outside of the image are black.

    Args:
        image: (H, W) or (H, W, C), uint8 or float32, taken with `lens`.
        lens: one lens. rays: (H', W', 3). interpolation: of `cv2.remap`.

    Returns:
        (H', W') or (H', W', C), of the image's type.

    Raises:
        ValueError: there are several lenses, or the rays have another shape.
    """
    height, width = image.shape[:2]
    return remap(image, view_map(lens, rays, (height, width)), interpolation)


def _plane(size: tuple[int, int], width: float) -> tuple[Tensor, Tensor]:
    """The x and y of the pixels of (H, W), from the middle; W pixels have the length `width`."""
    step = width / size[1]
    y, x = ((torch.arange(side, dtype=torch.float64) - (side - 1) / 2) * step for side in size)
    y, x = torch.meshgrid(y, x, indexing="ij")
    return x, y


def _check_fov(fov: float, end: float, range_: str, closed: bool = False) -> None:
    if not (0 < fov < end or (closed and fov == end)):
        raise ValueError(f"fov must be above 0 and {range_} rad, got {fov}{degrees_hint(fov)}")
