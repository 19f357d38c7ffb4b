"""The image disc as a square."""

import math

import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.concentric import (
    points_at,
    rays_at,
    square_points,
    square_rays,
    square_view,
)
from darswin.lens.pixels import OUTSIDE
from darswin.lens.solve import length_of, vector_of
from darswin.lens.spacing import SPACINGS, Spacing
from darswin.utils.angles import degrees_hint
from darswin.views.base import Pair, PerChannel
from darswin.views.pixels import PixelView
from darswin.views.registry import register_view


@register_view("square")
class SquareView(PixelView):
    """The image disc as a square, by the concentric map of Shirley and Chiu (JGT 1997).

    Equal steps of `spacing` become equal distances in the square. Pixels that no ray reaches get 0.

    Args:
        size: (S, S) of the view.
        fov: the horizontal field of view between the outer edges of the middle row, rad. None means
            twice θ_max of each lens. The size of a thing in the square then depends on the lens,
            and the network is not told. If sizes matter, as for distances, give that of your widest
            lens. The square is 0 beyond θ_max of a lens.
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
        return square_view(lens, size, self.size[0], self.spacing, self.theta_max)

    def view_points(self, lens: Lens, size: Pair) -> Tensor:
        points = square_points(lens, size, self.spacing, self.theta_max)
        pixels = ((points + 1) * self.size[0] - 1) / 2
        return torch.where(points == OUTSIDE, OUTSIDE, pixels)

    def pixel_rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        return square_rays(lens, self.size[0], self.spacing, self.theta_max)

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        square = (2 * points + 1) / self.size[0] - 1
        theta, direction = rays_at(lens, square, self.spacing, self.theta_max)
        inside = (square.abs().amax(-1) <= 1) & lens.sees(theta)
        return torch.where(inside[..., None], vector_of(theta, direction), torch.nan)

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        aside = length_of(rays[..., :2])
        theta = torch.atan2(aside, rays[..., 2])
        theta = torch.where(lens.sees(theta), theta, torch.nan)
        direction = rays[..., :2] / aside[..., None]
        square = points_at(lens, theta, direction, self.spacing, self.theta_max)
        points = ((square + 1) * self.size[0] - 1) / 2
        return torch.where(square == OUTSIDE, torch.nan, points)

    def extra_repr(self) -> str:
        edge = "" if self.fov is None else f", fov={self.fov:g}"
        return f"{super().extra_repr()}, spacing={self.spacing!r}{edge}"
