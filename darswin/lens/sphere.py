"""Lenses that project through a sphere or an ellipsoid, with closed-form inverses."""

import math
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from darswin.lens.base import MARGIN
from darswin.lens.ideal import FocalLens
from darswin.lens.parameter import Number, Parameter
from darswin.ops._library import no_gradients

# Initial values for `fit`.
XI_STARTS = (1.0, -0.2, 0.5, 2.0)
ALPHA_STARTS = (0.5, 0.7)


class Spherical(FocalLens):
    """r = f sin θ / (ξ + cos θ): the unified model, perspective at ξ = 0, stereographic at ξ = 1.

    Args:
        xi: ξ ≥ 0. focal: f > 0, px.

    r rises while cos θ > -min(ξ, 1/ξ). `Lens` describes the other arguments.

    Source: DarSwin, ICCV 2023, eq. 5; Barreto, CVIU 2006.
    """

    xi = Parameter(low=0, starts=XI_STARTS)

    @property
    def theta_limit(self) -> Tensor:
        return sphere_limit(self.xi)

    def project(self, theta: Number) -> Tensor:
        theta, xi, focal = self._aligned(theta, "xi", "focal")
        return focal * torch.sin(theta) / (xi + torch.cos(theta))

    def _scale_to(self, radius: Tensor) -> Tensor:
        # radius / r_max would round differently, but data sets must stay the same to the bit.
        return radius * (self.xi + torch.cos(self.theta_max)) / torch.sin(self.theta_max)

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, xi, focal = self._aligned(radius, "xi", "focal")
        return sphere_angle(radius / focal, xi)

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, xi: Number, fov: Number, radius: Number, center: Number | None = None, *,
            affine: Number | None = None, image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip


class EnhancedUnified(FocalLens):
    """r = f sin θ / (α √(β sin² θ + cos² θ) + (1 - α) cos θ): EUCM; β = 1 is the unified model.

    Args:
        alpha: α in [0, 1]. beta: β > 0; or β < 0, for θ up to atan(1 / √-β). focal: f > 0, px.

    `Lens` describes the other arguments.

    Source: Khomutenko, Garcia and Martinet, RA-L 2016.
    """

    alpha = Parameter(low=0, high=1, starts=ALPHA_STARTS)
    beta = Parameter(starts=(1.0,), bounds=(1e-6, math.inf))

    def _validate(self) -> None:
        self._require("beta", self.beta != 0, "finite and above 0, or below")

    @property
    def theta_limit(self) -> Tensor:
        # The limit is where cos θ = -w √(β sin² θ + cos² θ).
        w, beta = _cone(self.alpha.detach()), self.beta.detach()
        last = torch.atan2(root(1 - w * w), -w * root(beta))
        # For β below 0, it is where the square root becomes 0.
        return torch.where(beta > 0, last, torch.atan(root(-beta).reciprocal())) - MARGIN

    def project(self, theta: Number) -> Tensor:
        theta, alpha, beta, focal = self._aligned(theta, "alpha", "beta", "focal")
        sin, cos = torch.sin(theta), torch.cos(theta)
        square = beta * sin * sin + cos * cos
        radius = focal * sin / (alpha * root(square) + (1 - alpha) * cos)
        return torch.where(square >= 0, radius, torch.nan)

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, alpha, beta, focal = self._aligned(radius, "alpha", "beta", "focal")
        rho = radius / focal
        square = beta * rho * rho
        rest = 1 - (2 * alpha - 1) * square
        z = (1 - alpha * alpha * square) / (alpha * root(rest) + (1 - alpha))
        return torch.atan2(rho, z)

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, alpha: Number, beta: Number, fov: Number, radius: Number,
            center: Number | None = None, *, affine: Number | None = None,
            image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip


class DoubleSphere(FocalLens):
    """r = f sin θ / (α √(sin² θ + (ξ + cos θ)²) + (1 - α) (ξ + cos θ)).

    Args:
        xi: ξ > -1. alpha: α in [0, 1]. focal: f > 0, px.

    `Lens` describes the other arguments.

    Source: Usenko, Demmel and Cremers, 3DV 2018.
    """

    xi = Parameter(low=-1, open=True, starts=XI_STARTS, bounds=(-0.999, math.inf))
    alpha = Parameter(low=0, high=1, starts=ALPHA_STARTS)

    @property
    def theta_limit(self) -> Tensor:
        # The angle ψ from the second sphere's center, tan ψ = sin θ / (ξ + cos θ), ends at
        # cos ψ = -w. For ξ above 1, it stops rising at cos θ = -1/ξ.
        w, xi = _cone(self.alpha.detach()), self.xi.detach()
        psi = torch.atan2(root(1 - w * w), -w)
        # θ from ψ, in a triangle with sides 1 and ξ.
        theta = psi + torch.asin((xi * torch.sin(psi)).clamp(-1, 1))
        return torch.minimum(theta - MARGIN, sphere_limit(xi.clamp(min=1)))

    def project(self, theta: Number) -> Tensor:
        theta, xi, alpha, focal = self._aligned(theta, "xi", "alpha", "focal")
        sin, cos = torch.sin(theta), xi + torch.cos(theta)
        return focal * sin / (alpha * torch.sqrt(sin * sin + cos * cos) + (1 - alpha) * cos)

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, xi, alpha, focal = self._aligned(radius, "xi", "alpha", "focal")
        rho = radius / focal
        square = rho * rho
        rest = 1 - (2 * alpha - 1) * square
        z = (1 - alpha * alpha * square) / (alpha * root(rest) + (1 - alpha))
        second = z * z + (1 - xi * xi) * square
        scale = (z * xi + root(second)) / (z * z + square)
        return torch.atan2(scale * rho, scale * z - xi)

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, xi: Number, alpha: Number, fov: Number, radius: Number,
            center: Number | None = None, *, affine: Number | None = None,
            image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip


def sphere_angle(rho: Tensor, xi: Tensor) -> Tensor:
    """θ with sin θ / (ξ + cos θ) = ρ."""
    # tan ψ = ρ, θ = ψ + asin(ξ sin ψ). atan2 is exact also where the sine is near 1.
    square = 1 + (1 - xi * xi) * rho * rho
    return torch.atan(rho) + torch.atan2(xi * rho, root(square))


def sphere_limit(xi: Tensor) -> Tensor:
    """The θ up to which sin θ / (ξ + cos θ) rises."""
    with no_gradients():
        return torch.acos(-torch.minimum(xi, xi.reciprocal())) - MARGIN


def _cone(alpha: Tensor) -> Tensor:
    """w: the unified model with α ends at the angle with cosine -w."""
    return torch.where(alpha <= 0.5, alpha / (1 - alpha), (1 - alpha) / alpha.clamp(min=0.5))


def root(square: Tensor) -> Tensor:
    """√square, but nearly 0 where rounding made the square negative, as at a lens's last ray."""
    eps = torch.finfo(square.dtype).eps
    return square.clamp(min=eps * eps).sqrt()
