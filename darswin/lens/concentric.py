"""The concentric map from the image disc of any lens to a square. It keeps ratios of areas.

Points in the square are (a, b) in [-1, 1]², a to the right and b down. The middle is the optical
axis, the edge is θ_max, and nested squares are circles of equal θ, evenly spaced in a `Spacing`.
With a fixed `theta_max`, the edge is at this angle for every lens, in equal steps of θ.

Source: Shirley and Chiu, "A Low Distortion Map Between Disk and Square", JGT 1997.
"""

import math

import torch
from torch import Tensor

from darswin.lens.base import Lens
from darswin.lens.pixels import OUTSIDE, as_map, pixel_rays
from darswin.lens.spacing import Spacing, span, to_spacing, to_theta


def square_to_disc(points: Tensor) -> tuple[Tensor, Tensor]:
    """The disc's radius (...), in [0, 1], and (cos φ, sin φ) at points (..., 2) of the square. The
    direction is (1, 0) in the middle."""
    a, b = points.unbind(-1)
    wide = a.abs() >= b.abs()
    long, short = torch.where(wide, a, b), torch.where(wide, b, a)
    turn = math.pi / 4 * short / torch.where(long == 0, 1, long)
    sign = torch.where(long < 0, -1.0, 1.0).to(points.dtype)
    along, aside = sign * torch.cos(turn), sign * torch.sin(turn)
    direction = torch.where(wide, along, aside), torch.where(wide, aside, along)
    return long.abs(), torch.stack(direction, -1)


def disc_to_square(radius: Tensor, direction: Tensor) -> Tensor:
    """The inverse of `square_to_disc`. In the middle the direction may be (0, 0)."""
    c, s = direction.unbind(-1)
    wide = c.abs() >= s.abs()
    long, short = torch.where(wide, c, s), torch.where(wide, s, c)
    turn = torch.atan(short / torch.where(long == 0, 1, long))
    edge = torch.where(long < 0, -radius, radius)
    other = edge * turn * (4 / math.pi)
    points = torch.where(wide, edge, other), torch.where(wide, other, edge)
    return torch.stack(points, -1)


def square_rays(
    lens: Lens, size: int, spacing: Spacing, theta_max: float | None = None
) -> tuple[Tensor, Tensor]:
    """The rays of the pixels of a square with `size` S: θ (N, S, S), rad, and (cos φ, sin φ),
    (1, S, S, 2). With a fixed `theta_max`, θ is NaN beyond θ_max of the lens."""
    like = lens.theta_max
    steps = (2 * torch.arange(size, dtype=like.dtype, device=like.device) + 1) / size - 1
    points = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1)
    return rays_at(lens, points[None], spacing, theta_max)


def rays_at(
    lens: Lens, points: Tensor, spacing: Spacing, theta_max: float | None = None
) -> tuple[Tensor, Tensor]:
    """`square_rays` of points (N or 1, ..., 2) of the square."""
    radius, direction = square_to_disc(points)
    if theta_max is not None:
        theta = theta_max * radius
        return torch.where(lens.sees(theta), theta, torch.nan), direction
    first, last = (lens._row(end[:, 0], radius.dim()) for end in span(lens, spacing))
    return to_theta(lens, first + (last - first) * radius, spacing), direction


def square_view(
    lens: Lens,
    image_size: tuple[int, int],
    size: int,
    spacing: Spacing,
    theta_max: float | None = None,
) -> Tensor:
    """(N, S, S, 2) px: the points in images of (H, W) of the pixels of a square with `size` S.

    With a fixed `theta_max`, they are `OUTSIDE` beyond θ_max of the lens.
    """
    theta, direction = square_rays(lens, size, spacing, theta_max)
    if theta_max is not None:
        return as_map(lens.seen_pixels(theta, direction, image_size))
    return lens.pixels(theta, direction, image_size)


def square_points(
    lens: Lens, image_size: tuple[int, int], spacing: Spacing, theta_max: float | None = None
) -> Tensor:
    """(N, H, W, 2): the points in the square of the images' pixels; `OUTSIDE` where no ray of
    [0, θ_max] lands, also of a fixed `theta_max`."""
    return points_at(lens, *pixel_rays(lens, image_size), spacing, theta_max)


def points_at(
    lens: Lens, theta: Tensor, direction: Tensor, spacing: Spacing, theta_max: float | None = None
) -> Tensor:
    """`square_points` of rays (N, ...), with (cos φ, sin φ), (N or 1, ..., 2)."""
    seen = ~theta.isnan()  # NaN must not reach the gradients
    if theta_max is not None:
        seen = seen & (theta <= theta_max)
        points = disc_to_square(torch.where(seen, theta / theta_max, 0.0), direction)
        return torch.where(seen[..., None], points, OUTSIDE)
    first, last = (lens._row(end[:, 0], theta.dim()) for end in span(lens, spacing))
    value = to_spacing(lens, torch.where(seen, theta, 0.0), spacing)
    radius = ((value - first) / (last - first)).clamp(max=1)
    points = disc_to_square(radius, direction)
    return torch.where(seen[..., None], points, OUTSIDE)
