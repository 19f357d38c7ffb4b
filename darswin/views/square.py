"""The image disc as a square."""

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
from darswin.lens.spacing import SPACINGS, Spacing, check_fixed_theta_max
from darswin.views.base import Pair, PerChannel
from darswin.views.pixels import PixelView
from darswin.views.registry import register_view


@register_view("square")
class SquareView(PixelView):
    """The image disc as a square, by the concentric map of Shirley and Chiu (JGT 1997).

    Equal steps of `spacing` become equal distances in the square. Pixels that no ray reaches get 0.

    Args:
        size: (S, S) of the view.
        spacing: the spacing from the centre of the square to its edge; see `darswin.lens.spacing`.
        theta_max: θ at the edge of the square, rad. None means θ_max of each lens. The size of a
            thing in the square then depends on the lens, and the network is not told. If sizes
            matter, as for distances, give the widest θ_max of your lenses. The square is 0 beyond
            θ_max of a lens.
        mean, std: the arguments of `View`.

    Raises:
        ValueError: the view is not square, the spacing is unknown, or theta_max is not in (0, π) or
            has another spacing than "theta".
    """

    size: Pair

    def __init__(
        self,
        size: Pair,
        spacing: Spacing = "theta",
        theta_max: float | None = None,
        *,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(size, mean=mean, std=std)
        if spacing not in SPACINGS:
            raise ValueError(f"spacing must be one of {SPACINGS}, got {spacing!r}")
        if size[0] != size[1]:
            raise ValueError(f"image_size must be square, got {size}")
        if theta_max is not None:
            check_fixed_theta_max(theta_max, spacing)
        self.spacing, self.theta_max = spacing, theta_max

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
        edge = "" if self.theta_max is None else f", theta_max={self.theta_max:g}"
        return f"{super().extra_repr()}, spacing={self.spacing!r}{edge}"
