"""Lenses whose curve is a polynomial of the angle or of the radius."""

import math

import torch
from torch import Tensor

from darswin.lens.base import MARGIN, Lens
from darswin.lens.parameter import Number, Parameter
from darswin.lens.solve import inverse, rising_limit

MOST_LOST = 1.0  # px, by rounding


def horner(x: Tensor, coefficients: Tensor) -> Tensor:
    """c₀ + c₁ x + c₂ x² + …, for coefficients (N, n) and x (N or 1, ...)."""
    rows = [Lens._row(column, x.dim()) for column in coefficients.unbind(1)]
    value, _ = torch.broadcast_tensors(rows.pop() if rows else torch.zeros_like(x), x)
    for row in reversed(rows):
        value = value * x + row
    return value


def slopes(coefficients: Tensor, first: int, step: int = 1) -> Tensor:
    """(N, n): coefficients of the powers first, first + step, …, times these powers."""
    powers = first + step * torch.arange(coefficients.shape[1], device=coefficients.device)
    return coefficients * powers


class PolynomialLens(Lens, register=False):
    """Base of the lenses with coefficients only, (n,) or (N, n), lowest power first."""

    coefficients = Parameter(shape=(None,), in_pixels=True)

    def _validate(self) -> None:
        if self.coefficients.shape[1] < 1:
            raise ValueError("coefficients must be at least one per lens, got none")

    @property
    def theta_limit(self) -> Tensor:
        end = torch.full_like(self.coefficients[:, 0].detach(), math.pi)
        return rising_limit(self._slope, end) - MARGIN

    @classmethod
    def closest(cls, theta: Tensor, radius: Tensor, slope: Tensor, terms: int) -> Tensor:
        """(1, n): the coefficients of the polynomial with `terms` terms that is closest to radii
        (K,) with slopes (K,) at θ (K,)."""
        return _least_squares(cls._powers(theta, terms), radius)

    @staticmethod
    def _powers(theta: Tensor, terms: int) -> Tensor:
        """(K, n): the factors of the coefficients in r."""
        raise NotImplementedError


class Polynomial(PolynomialLens):
    """r = k₁ θ + k₂ θ² + … + k_n θⁿ, of any degree; WoodScape's `radial_poly` has four terms.

    OpenCV's fisheye coefficients are of another kind: they belong to `KannalaBrandt`.

    Args:
        coefficients: (n,) or (N, n): k₁ … k_n, in px.

    `Lens` describes the other arguments.

    Source: DarSwin, ICCV 2023, eq. 4.
    """

    def _slope(self, theta: Tensor) -> Tensor:
        return horner(theta, slopes(self.coefficients, 1))

    def project(self, theta: Number) -> Tensor:
        (theta,) = self._aligned(theta)
        return theta * horner(theta, self.coefficients)

    @staticmethod
    def _powers(theta: Tensor, terms: int) -> Tensor:
        return theta[:, None] ** torch.arange(1, terms + 1, dtype=theta.dtype)


class OCam(PolynomialLens):
    """tan θ = -r / (a₀ + a₁ r + a₂ r² + …): Scaramuzza's model, with a closed-form inverse.

    Args:
        coefficients: (n,) or (N, n): a₀ < 0, a₁, … in px, 1, px⁻¹, …

    `Lens` describes the other arguments.

    Source: Scaramuzza, Martinelli and Siegwart, ICVS 2006; the OCamCalib toolbox.
    """

    def _validate(self) -> None:
        super()._validate()
        self._require("coefficients", self.coefficients[:, 0] < 0, "such that a₀ is below 0")

    def _angle_at(self, radius: Tensor) -> Tensor:
        return torch.atan2(radius, -horner(radius, self.coefficients))

    def _angle_slope(self, radius: Tensor) -> Tensor:
        depth = horner(radius, self.coefficients)
        deepens = horner(radius, slopes(self.coefficients, 0)[:, 1:])
        return (radius * deepens - depth) / (radius * radius + depth * depth)

    def _slope(self, theta: Tensor) -> Tensor:
        return 1 / self._angle_slope(self.project(theta))

    @property
    def _last_radius(self) -> Tensor:
        """(N,) px: the radius up to which θ rises, at most 20 |a₀|."""
        return rising_limit(self._angle_slope, -20 * self.coefficients[:, 0].detach())

    @property
    def theta_limit(self) -> Tensor:
        return self._angle_at(self._last_radius[:, None])[:, 0].detach() - MARGIN

    def project(self, theta: Number) -> Tensor:
        (theta,) = self._aligned(theta)
        end = self._row(self._last_radius, theta.dim())
        return inverse(self._angle_at, self._angle_slope, theta, end)

    def _scaled(self, scale: Tensor) -> "OCam":
        power = 1 - torch.arange(self.coefficients.shape[1], device=scale.device)
        return self.replace(coefficients=self.coefficients * scale[:, None] ** power)

    @classmethod
    def closest(cls, theta: Tensor, radius: Tensor, slope: Tensor, terms: int) -> Tensor:
        # a₀ + a₂ r² + … = -r / tan θ; a₁ would be a kink at the centre, so the toolbox omits it.
        # The weights turn each row's error into pixels, to first order.
        powers = torch.arange(terms + 1, dtype=theta.dtype)
        used = powers != 1
        scale, weight = radius.max(), slope * torch.sin(theta) / radius
        matrix = torch.sin(theta)[:, None] * (radius / scale)[:, None] ** powers
        depth = -weight * radius * torch.cos(theta)
        coefficients = radius.new_zeros(1, terms + 1)
        solved = _least_squares(weight[:, None] * matrix[:, used], depth)
        coefficients[:, used] = solved / scale ** powers[used]
        return coefficients


class OCamInverse(PolynomialLens):
    """r = b₀ + b₁ (θ - π/2) + b₂ (θ - π/2)² + …: OCamCalib's polynomial for projection.

    The toolbox fits it to the inverse of an `OCam` lens, to about 0.01 px.

    Args:
        coefficients: (n,) or (N, n): b₀, b₁, … in px.

    `Lens` describes the other arguments.

    Raises:
        ValueError: coefficients so large that sums of them in their dtype may be a pixel off, as
            those of 20 terms in float32.

    Source: the OCamCalib toolbox, world2cam.
    """

    def _validate(self) -> None:
        super()._validate()
        value = self.coefficients.detach()
        # Rounding is 6 to 10 times smaller than this bound.
        lost = horner(torch.full_like(value[:, :1], math.pi / 2), value.abs())[:, 0]
        fits = lost * torch.finfo(value.dtype).eps < 5 * MOST_LOST
        name = str(value.dtype).removeprefix("torch.")
        self._require("coefficients", fits, f"such that {name} rounds r by less than a pixel")

    def _set_theta_max(self, wanted: Tensor | None, argument: str = "theta_max") -> None:
        super()._set_theta_max(wanted, argument)
        self._require("coefficients", self.r_max > 0, "such that r at theta_max is above 0")

    def _slope(self, theta: Tensor) -> Tensor:
        return horner(theta - math.pi / 2, slopes(self.coefficients, 0)[:, 1:])

    def project(self, theta: Number) -> Tensor:
        (theta,) = self._aligned(theta)
        return horner(theta - math.pi / 2, self.coefficients)

    @staticmethod
    def _powers(theta: Tensor, terms: int) -> Tensor:
        return (theta - math.pi / 2)[:, None] ** torch.arange(terms + 1, dtype=theta.dtype)


def _least_squares(matrix: Tensor, value: Tensor) -> Tensor:
    """(1, n): x that minimizes |matrix @ x - value|."""
    return torch.linalg.lstsq(matrix, value[:, None]).solution.T
