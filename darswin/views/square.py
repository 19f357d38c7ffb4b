"""The image disc as a square, by a concentric map, which keeps ratios of areas.

Source: Shirley and Chiu, "A Low Distortion Map Between Disk and Square", JGT 1997.
"""

import math

import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import as_map, pixel_grid, pixel_rays
from darswin.lens.solve import length_of, vector_of
from darswin.lens.spacing import SPACINGS, Spacing, span, to_spacing, to_theta
from darswin.utils.angles import degrees_hint
from darswin.views.base import Pair, PerChannel
from darswin.views.pixels import PixelView
from darswin.views.registry import register_view


@register_view("square")
class SquareView(PixelView):
    """The image disc as a square, by the concentric map of Shirley and Chiu (JGT 1997).

    Nested squares are circles of equal θ, in equal steps of `spacing` from the optical axis to the
    edge. Pixels that no ray reaches get 0.

    Args:
        size: (S, S) of the view.
        fov: the horizontal field of view between the outer edges of the middle row, rad. None means
            twice θ_max of each lens. The size of an object in the square then depends on the lens:
            if sizes matter, give that of your widest lens. The square is 0 beyond θ_max of a lens.
        spacing: the spacing from the centre of the square to its edge; see `darswin.lens.spacing`.
        mean, std: the arguments of `View`.

    Raises:
        ValueError: the view is not square, the spacing is unknown, or fov is not in (0, 2π] or has
            another spacing than "theta".
    """

    size: Pair

    def __init__(
        self,
        size: Pair,
        fov: float | None = None,
        *,
        spacing: Spacing = "theta",
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(size, mean=mean, std=std)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing must be one of {SPACINGS}, got {spacing!r}")
        if size[0] != size[1]:
            raise ValueError(f"size must be square, got {size}")
        if fov is not None and not 0 < fov <= 2 * math.pi:
            raise ValueError(f"fov must be in (0, 2π] rad, got {fov}{degrees_hint(fov)}")
        if fov is not None and spacing != "theta":
            raise ValueError(f"a square with fov needs spacing='theta', got {spacing!r}")
        self.spacing, self.fov = spacing, fov
        # Its edge is before π, where all directions are one.
        self.theta_max = None if fov is None else min(fov / 2, math.nextafter(math.pi, 0))

    @classmethod
    def usual_shape(cls, lens: Lens, size: Pair, fov: float | None = None) -> tuple[float, float]:
        """`RayView.usual_shape`, of all up to θ_max."""
        return 2 * lens.theta_max.item() if fov is None else fov, 1.0

    def image_points(self, lens: Lens, size: Pair) -> Tensor:
        return as_map(lens.seen_pixels(*self.pixel_rays(lens, size), size))

    def view_points(self, lens: Lens, size: Pair) -> Tensor:
        return as_map(self._pixels(lens, *pixel_rays(lens, size)))

    def pixel_rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        return self._rays(lens, pixel_grid(self.size, lens.theta_max))

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return vector_of(*self._rays(lens, points))

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        aside = length_of(rays[..., :2])
        theta = torch.atan2(aside, rays[..., 2])
        theta = torch.where(lens.sees(theta), theta, torch.nan)
        return self._pixels(lens, theta, rays[..., :2] / aside[..., None])

    def _rays(self, lens: Lens, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """θ (N, ...) of pixels (N or 1, ..., 2) of the view, rad, NaN beyond its edge and beyond
        θ_max of the lens, and (cos φ, sin φ)."""
        radius, direction = square_to_disc((2 * pixels + 1) / self.size[0] - 1)
        first, last = self._ends(lens, radius.dim())
        theta = to_theta(lens, first + (last - first) * radius, self.spacing)
        return torch.where((radius <= 1) & lens.sees(theta), theta, torch.nan), direction

    def _pixels(self, lens: Lens, theta: Tensor, direction: Tensor) -> Tensor:
        """The inverse of `_rays`; NaN where θ is or is beyond the edge."""
        inside = ~theta.isnan()  # NaN must not reach the gradients
        if self.theta_max is not None:
            inside = inside & (theta <= self.theta_max)
        first, last = self._ends(lens, theta.dim())
        value = to_spacing(lens, torch.where(inside, theta, 0.0), self.spacing)
        square = disc_to_square(((value - first) / (last - first)).clamp(max=1), direction)
        pixels = ((square + 1) * self.size[0] - 1) / 2
        return torch.where(inside[..., None], pixels, torch.nan)

    def _ends(self, lens: Lens, dim: int) -> tuple[Tensor, Tensor]:
        """The values of the spacing in the middle and at the edge, for `dim` dimensions."""
        first, last = (lens._row(end[:, 0], dim) for end in span(lens, self.spacing))
        return first, last if self.theta_max is None else torch.full_like(last, self.theta_max)

    def extra_repr(self) -> str:
        edge = "" if self.fov is None else f", fov={self.fov:g}"
        return f"{super().extra_repr()}, spacing={self.spacing!r}{edge}"


def square_to_disc(points: Tensor) -> tuple[Tensor, Tensor]:
    """The disc's radius (...), in [0, 1], and (cos φ, sin φ) at points (..., 2) of the square
    [-1, 1]². The direction is (1, 0) in the middle."""
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
