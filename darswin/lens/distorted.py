"""Lenses with radial, tangential and thin-prism distortion.

A ray has a place in an ideal plane, w(θ) (cos φ, sin φ). Radial terms scale its radius. Tangential
terms (from decentred lens elements) and thin-prism terms (from tilted ones) shift it. The focal
length turns the distorted plane into pixels.
"""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ClassVar, Self

import torch
from torch import Tensor

from darswin.lens.base import MARGIN, Lens
from darswin.lens.ideal import Equidistant, FocalLens, Perspective
from darswin.lens.parameter import Number, Parameter
from darswin.lens.polynomial import horner, slopes
from darswin.lens.solve import (
    determinant,
    direction_of,
    gradient_steps,
    length_of,
    newton,
    radial_slopes,
    rising_limit,
    solve,
)
from darswin.lens.sphere import XI_STARTS, Spherical, sphere_angle, sphere_limit
from darswin.ops._library import no_gradients
from darswin.ops.checks import readable


class DistortedLens(FocalLens, register=False):
    """Base of the lenses with radial, tangential and thin-prism terms in a plane of radius w(θ).

    r = f w (1 + k₁ w² + k₂ w⁴ + …), and with (x, y) = w (cos φ, sin φ) the offset is

        f (2 p₁ x y + p₂ (w² + 2 x²) + s₁ w² + s₂ w⁴,
           p₁ (w² + 2 y²) + 2 p₂ x y + s₃ w² + s₄ w⁴).

    Args:
        focal: f > 0, px.
        radial: (n,) or (N, n): k₁, k₂, …, or None.
        tangential: (2,) or (N, 2): p₁, p₂, or None.
        prism: (4,) or (N, 4): s₁ … s₄, or None.

    `Lens` describes the other arguments.

    A class defines w(θ), its slope and its inverse: `_plane`, `_plane_slope` and `_plane_angle`.
    """

    radial = Parameter(shape=(None,), optional=True, by_place=True)
    tangential = Parameter(shape=(2,), optional=True)
    prism = Parameter(shape=(4,), optional=True)
    plain: ClassVar[type[Lens]]  # the model without terms
    aside_last: ClassVar[bool] = False  # True if the offset is computed after the radial terms
    _plane: ClassVar[Callable[..., Tensor]]
    _plane_slope: ClassVar[Callable[..., Tensor]]
    _plane_angle: ClassVar[Callable[..., Tensor]]

    @classmethod
    def _rows(cls, values: Mapping[str, Number]) -> dict[str, Tensor]:
        rows = super()._rows(values)
        varied = [name for name, tensor in rows.items() if len(tensor) > 1]
        if varied == ["radial"] and rows["radial"].shape[1] == 1:  # a column, as in OpenCV
            count = len(rows["radial"])
            raise ValueError(
                f"radial of shape ({count}, 1) means {count} lenses with one coefficient each: "
                f"give shape ({count},) for one lens, or another parameter with {count} numbers"
            )
        return rows

    def _plane_limit(self) -> Tensor:
        """(N,) rad: the angle up to which w rises."""
        return super().theta_limit

    def _stretch(self, w: Tensor) -> Tensor:
        """w with the radial terms."""
        return w if self.radial is None else w + w**3 * horner(w * w, self.radial)

    def _stretch_slope(self, w: Tensor) -> Tensor:
        if self.radial is None:
            return torch.ones_like(w)
        return 1 + w * w * horner(w * w, slopes(self.radial, 3, 2))

    def _slope(self, theta: Tensor) -> Tensor:
        focal = self._row(self.focal, theta.dim())
        return focal * self._stretch_slope(self._plane(theta)) * self._plane_slope(theta)

    @property
    def theta_limit(self) -> Tensor:
        # The lens also ends where high powers of w overflow in its dtype.
        end = self._plane_limit()
        limits = [rising_limit(self._slope, end)]
        if not self.is_radial:
            limits.append(rising_limit(self._least_area, limits[0]))
        limit = limits[-1]
        return torch.where(limit < end, limit - MARGIN, end)

    def project(self, theta: Number) -> Tensor:
        theta, focal = self._aligned(theta, "focal")
        return focal * self._stretch(self._plane(theta))

    @property
    def is_radial(self) -> bool:
        return self.tangential is None and self.prism is None

    def offset(self, theta: Tensor, direction: Tensor) -> Tensor:
        w = self._plane(theta)
        w = self._stretch(w) if self.aside_last else w
        return self._row(self.focal, w.dim() + 1) * self._aside(w[..., None] * direction)

    def _aside(self, point: Tensor) -> Tensor:
        """(..., 2): the offset at a point of the plane, in focal lengths."""
        x, y = point.unbind(-1)
        square = x * x + y * y
        p1, p2, s1, s2, s3, s4 = self._terms(x.dim())
        dx = 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
        dy = p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
        return torch.stack((dx, dy), -1)

    def _terms(self, dims: int) -> list[Tensor]:
        """p₁, p₂, s₁ … s₄, each with `dims` dimensions."""
        none = torch.zeros_like(self.focal)
        p = (none, none) if self.tangential is None else self.tangential.unbind(1)
        s = (none,) * 4 if self.prism is None else self.prism.unbind(1)
        return [self._row(term, dims) for term in (*p, *s)]

    def _aside_slopes(self, point: Tensor) -> Tensor:
        """(..., 2, 2): the derivatives of `_aside`."""
        x, y = point.unbind(-1)
        p1, p2, s1, s2, s3, s4 = self._terms(x.dim())
        square = x * x + y * y
        across, down = s1 + 2 * s2 * square, s3 + 2 * s4 * square
        mixed = 2 * (p1 * x + p2 * y)
        rows = (
            (2 * p1 * y + 6 * p2 * x + 2 * x * across, mixed + 2 * y * across),
            (mixed + 2 * x * down, 6 * p1 * y + 2 * p2 * x + 2 * y * down),
        )
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def _distort(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """(..., 2) and (..., 2, 2): the image of a point w (cos φ, sin φ) of the ideal plane, in
        focal lengths, and its derivatives."""
        w = length_of(point)
        ratio = self._stretch(w) / w
        direction, stretched = point / w[..., None], ratio[..., None] * point
        straight = radial_slopes(ratio, self._stretch_slope(w), direction)
        if self.aside_last:
            slope = straight + self._aside_slopes(stretched) @ straight
            return stretched + self._aside(stretched), slope
        return stretched + self._aside(point), straight + self._aside_slopes(point)

    def _least_area(self, theta: Tensor) -> Tensor:
        """(N, K): the factor by which the distortion enlarges an area at θ, at its smallest over φ.

        The factor is a trigonometric polynomial of degree 3 in φ: 8 azimuths determine it.
        """
        points = self._plane(theta)[..., None, None] * _circle(8, theta)
        area = determinant(self._distort(points)[1])
        terms = torch.fft.rfft(area, norm="forward")[..., :4]
        area = torch.fft.irfft(terms, 256, norm="forward")
        # The minimum of the parabola through the smallest sample and its neighbours.
        place = area.argmin(-1, keepdim=True)
        before, least, after = (area.gather(-1, (place + k) % 256) for k in (-1, 0, 1))
        bend = (before - 2 * least + after).clamp(min=torch.finfo(theta.dtype).tiny)
        return (least - (after - before) ** 2 / (8 * bend))[..., 0]

    @staticmethod
    def _slack(goal: Tensor) -> Tensor:
        """(...): the largest error by rounding at points of the distorted plane."""
        return 1e3 * torch.finfo(goal.dtype).eps * (1 + length_of(goal))

    def _find_points(self, goal: Tensor, start: Tensor, last: Tensor) -> Tensor:
        """(N, ..., 2): points of the ideal plane that `_distort` maps to `goal`, if there are any
        within `last`. The search begins at half of `start`, far from any fold."""
        if not readable(goal):  # no shape depends on values
            return newton(self._distort, goal, start / 2, 1.1 * last, rounds=30)
        circle = _circle(256, goal)
        # One lens at a time: each selects another number of pixels.
        shape, start = goal.shape, self._by_lens(start.expand_as(goal)).unflatten(1, (-1, 2))
        goal, points = self._by_lens(goal).unflatten(1, (-1, 2)), start.clone()
        for k, end in enumerate(last.flatten()):
            lens = self[k]
            # Most pixels without a ray lie beyond the rim; they are skipped. A rim that overflows
            # is NaN and beyond all pixels.
            near = ~(length_of(goal[k]) >= 1.01 * length_of(lens._distort(end * circle)[0]).max())
            for share in (0.5, 0.0):  # the second time from the axis, as a fold may block the way
                begin = share * start[k][near]
                points[k][near] = newton(lens._distort, goal[k][near], begin, 1.1 * end)
                near &= length_of(lens._distort(points[k])[0] - goal[k]) > self._slack(goal[k])
        return points.reshape(shape)

    def _rotated_terms(self, turn: Tensor) -> dict[str, Tensor]:
        # The terms are vectors of the image plane: (p₂, p₁), (s₁, s₃) and (s₂, s₄).
        changed = {}
        if self.tangential is not None:
            changed["tangential"] = (self.tangential.flip(1) @ turn.T).flip(1)
        if self.prism is not None:
            changed["prism"] = (turn @ self.prism.unflatten(1, (2, 2))).flatten(1)
        return changed

    def _find_rays(self, flat: Tensor, theta: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Newton's method in the ideal plane, from the ray's place without the offset. As in
        `inverse`, the last steps carry the gradients."""
        end = self._row(self.theta_max.detach(), theta.dim())
        goal = flat / self._row(self.focal, flat.dim())
        with no_gradients():
            last = self._plane(end)
            start = self._plane(torch.where(theta.isnan(), end, theta))[..., None] * direction
            point = self._find_points(goal, start, last)
            lands = length_of(self._distort(point)[0] - goal) < self._slack(goal)
            # Near a fold of the map, rounding a pixel by ε moves its ray by √ε.
            lands &= length_of(point) <= last * (1 + math.sqrt(torch.finfo(flat.dtype).eps))
        # Pixels without a ray become the principal point: NaN would reach the gradients.
        goal, point = (torch.where(lands[..., None], x, 0.0) for x in (goal, point))
        for _ in range(gradient_steps()):
            image, slope = self._distort(point)
            point = point - solve(slope, image - goal)
        w = length_of(point)
        theta = torch.where(lands, self._plane_angle(w), torch.nan)
        return theta, torch.where(lands[..., None], point / w[..., None], direction)

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, fov: Number, radius: Number, center: Number | None = None, *,
            radial: Number | None = None, tangential: Number | None = None,
            prism: Number | None = None, affine: Number | None = None,
            image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip


def _circle(count: int, like: Tensor) -> Tensor:
    """(count, 2): unit vectors at equal angles."""
    steps = torch.arange(count, dtype=like.dtype, device=like.device)
    return direction_of(steps * (2 * math.pi / count))


class KannalaBrandt(DistortedLens):
    """r = f (θ + k₁ θ³ + k₂ θ⁵ + …): OpenCV's fisheye model, Kalibr's and ROS's "equidistant".

    `DistortedLens` describes the arguments; here w = θ.

    Source: Kannala and Brandt, PAMI 2006; OpenCV, cv::fisheye.
    """

    plain = Equidistant
    _plane = staticmethod(lambda theta: theta)
    _plane_slope = staticmethod(torch.ones_like)
    _plane_angle = staticmethod(lambda w: w)


class Fisheye624(KannalaBrandt):
    """`KannalaBrandt` with tangential and thin-prism terms that act after the radial ones.

    With six k, two p and four s, this is Project Aria's camera and COLMAP's
    RAD_TAN_THIN_PRISM_FISHEYE. Aria's p₀ and p₁ are our p₂ and p₁. The arguments are those of
    `KannalaBrandt`.
    """

    aside_last = True


class Mei(DistortedLens):
    """The unified model with radial and tangential terms: w = sin θ / (ξ + cos θ).

    OpenCV's omnidir, Kalibr's omni-radtan, KITTI-360's fisheyes. At ξ = 0, a pinhole with radtan.

    Args:
        xi: ξ ≥ 0.

    `DistortedLens` describes the other arguments.

    Source: Mei and Rives, ICRA 2007.
    """

    xi = Parameter(low=0, starts=XI_STARTS)
    terms = 2
    plain = Spherical

    def _plane(self, theta: Tensor) -> Tensor:
        return torch.sin(theta) / (self._row(self.xi, theta.dim()) + torch.cos(theta))

    def _plane_slope(self, theta: Tensor) -> Tensor:
        xi, cos = self._row(self.xi, theta.dim()), torch.cos(theta)
        return (1 + xi * cos) / (xi + cos) ** 2

    def _plane_angle(self, w: Tensor) -> Tensor:
        return sphere_angle(w, self._row(self.xi, w.dim()))

    def _plane_limit(self) -> Tensor:
        return sphere_limit(self.xi)

    if TYPE_CHECKING:

        @classmethod
        def from_fov(  # type: ignore[override]
            cls, xi: Number, fov: Number, radius: Number, center: Number | None = None, *,
            radial: Number | None = None, tangential: Number | None = None,
            prism: Number | None = None, affine: Number | None = None,
            image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip


class BrownConrady(DistortedLens):
    """A pinhole camera with distortion: w = tan θ, θ < 90°. OpenCV's standard model.

    Args:
        denominator: (n,) or (N, n): k₄, k₅, … of OpenCV's rational model, or None. r is divided by
            1 + k₄ w² + k₅ w⁴ + ….

    `DistortedLens` describes the other arguments.

    Source: Brown, 1966; OpenCV, calib3d.
    """

    radial = DistortedLens.declared["radial"]  # placed before the denominator
    denominator = Parameter(shape=(None,), optional=True)
    terms = 3
    plain = Perspective
    _plane = staticmethod(torch.tan)
    _plane_slope = staticmethod(lambda theta: torch.cos(theta) ** -2)
    _plane_angle = staticmethod(torch.atan)
    _end = math.pi / 2

    def _stretch(self, w: Tensor) -> Tensor:
        stretched = super()._stretch(w)
        if self.denominator is None:
            return stretched
        return stretched / (1 + w * w * horner(w * w, self.denominator))

    def _stretch_slope(self, w: Tensor) -> Tensor:
        slope = super()._stretch_slope(w)
        if self.denominator is None:
            return slope
        divisor = 1 + w * w * horner(w * w, self.denominator)
        grows = w * horner(w * w, slopes(self.denominator, 2, 2))
        slope = (slope * divisor - super()._stretch(w) * grows) / divisor**2
        return torch.where(divisor > 0, slope, -1)  # beyond a pole nothing lands

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, fov: Number, radius: Number, center: Number | None = None, *,
            radial: Number | None = None, denominator: Number | None = None,
            tangential: Number | None = None, prism: Number | None = None,
            affine: Number | None = None, image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip
