"""Lenses that bend an ideal plane: radial, tangential and thin-prism terms.

A ray has a place in an ideal plane, w(θ) (cos φ, sin φ). Radial terms stretch it; tangential terms
(elements of the lens that are off centre) and thin-prism terms (tilted ones) move it aside; the
focal length makes pixels of it.
"""

import math

import torch
from torch import Tensor

from darswin.lens.base import MARGIN, Lens, Number, length_of
from darswin.lens.inverse import Function, rising_limit
from darswin.lens.polynomial import horner, slopes
from darswin.lens.sphere import sphere_angle, sphere_limit


class DistortedLens(Lens):
    """Base of the lenses with radial, tangential and thin-prism terms in a plane of radius w(θ).

    r = f w (1 + k₁ w² + k₂ w⁴ + …), and with (x, y) = w (cos φ, sin φ) the offset is

        f (2 p₁ x y + p₂ (w² + 2 x²) + s₁ w² + s₂ w⁴,
           p₁ (w² + 2 y²) + 2 p₂ x y + s₃ w² + s₄ w⁴).

    Args:
        focal: f > 0, px. radial: (n,) or (N, n): k₁, k₂, …, or None.
        tangential: (2,) or (N, 2): p₁, p₂, or None. prism: (4,) or (N, 4): s₁ … s₄, or None.
        Others: as `Lens`.
    """

    parameters = ("focal",)
    optional = ("radial", "tangential", "prism")
    lengths = ("focal",)
    focal: Tensor
    radial: Tensor | None
    tangential: Tensor | None
    prism: Tensor | None

    def __init__(
        self,
        focal: Number,
        radial: Number | None = None,
        theta_max: Number | None = None,
        center: Number | None = None,
        **others: Number | None,
    ):
        super().__init__(theta_max, center, focal=focal, radial=radial, **others)

    def _validate(self) -> None:
        self._require("focal", (self.focal > 0) & self.focal.isfinite(), "finite and above 0")
        for name in self.optional:
            if getattr(self, name) is not None:
                self._require(name, getattr(self, name).isfinite().all(1), "finite")
        for name, count in (("tangential", 2), ("prism", 4)):
            value = getattr(self, name)
            if value is not None and value.shape[1] != count:
                raise ValueError(f"{name} must be {count} numbers a lens, got {value.shape[1]}")

    def _plane(self, theta: Tensor) -> Tensor:
        """w(θ)."""
        raise NotImplementedError

    def _plane_slope(self, theta: Tensor) -> Tensor:
        raise NotImplementedError

    def _plane_angle(self, w: Tensor) -> Tensor:
        """θ at which w takes a value."""
        raise NotImplementedError

    def _plane_limit(self) -> Tensor:
        """(N,) rad: up to where w rises."""
        raise NotImplementedError

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
        # In the lens's own dtype: where the high powers of w overflow, it ends too.
        end = self._plane_limit()
        limits = [rising_limit(self._slope, end)]
        if not self.is_radial:
            limits.append(rising_limit(self._least_area, limits[0]))
        limit = limits[-1]
        return torch.where(limit < end, limit - MARGIN, end)

    def project(self, theta: Number) -> Tensor:
        theta, focal = self._aligned(theta, "focal")
        return focal * self._stretch(self._plane(theta))

    def _offset_plane(self, w: Tensor) -> Tensor:
        """The radius of the plane that tangential and thin-prism terms are functions of."""
        return w

    def _offset_plane_slope(self, w: Tensor) -> Tensor:
        return torch.ones_like(w)

    @property
    def is_radial(self) -> bool:
        return self.tangential is None and self.prism is None

    def offset(self, theta: Tensor, direction: Tensor) -> Tensor:
        w = self._offset_plane(self._plane(theta))
        return self._row(self.focal, w.dim() + 1) * self._aside(w[..., None] * direction)

    def _aside(self, point: Tensor) -> Tensor:
        """(..., 2): the offset at a point of its plane, in units of the focal length."""
        x, y = point.unbind(-1)
        square = x * x + y * y
        p1, p2, s1, s2, s3, s4 = self._terms(x.dim())
        dx = 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
        dy = p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
        return torch.stack((dx, dy), -1)

    def _terms(self, dims: int) -> list[Tensor]:
        """p₁, p₂, s₁ … s₄, to broadcast over `dims` dimensions."""
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

    def _bent(self, point: Tensor) -> Tensor:
        """(..., 2): where a point w (cos φ, sin φ) of the ideal plane lands, in focal lengths."""
        w = length_of(point)
        direction = point / w[..., None]
        aside = self._aside(self._offset_plane(w)[..., None] * direction)
        return self._stretch(w)[..., None] * direction + aside

    def _bent_slopes(self, point: Tensor) -> Tensor:
        """(..., 2, 2): the derivatives of `_bent`."""
        w = length_of(point)
        direction = point / w[..., None]
        u, slope = self._offset_plane(w), self._offset_plane_slope(w)
        aside = self._aside_slopes(u[..., None] * direction)
        straight = _radial_slopes(self._stretch(w) / w, self._stretch_slope(w), direction)
        return straight + aside @ _radial_slopes(u / w, slope, direction)

    def _least_area(self, theta: Tensor) -> Tensor:
        """(N, K): by how much the bent plane makes an area larger at θ, least of all azimuths.

        It is a trigonometric polynomial of degree 3 in φ, so that 8 azimuths tell all others.
        """
        azimuth = torch.arange(8, dtype=theta.dtype, device=theta.device) * (math.pi / 4)
        direction = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
        area = _determinant(self._bent_slopes(self._plane(theta)[..., None, None] * direction))
        terms = torch.fft.rfft(area, norm="forward")[..., :4]
        area = torch.fft.irfft(terms, 256, norm="forward")
        # The least between the samples: that of the parabola through the three around the least.
        place = area.argmin(-1, keepdim=True)
        before, least, after = (area.gather(-1, (place + k) % 256) for k in (-1, 0, 1))
        bend = (before - 2 * least + after).clamp(min=torch.finfo(theta.dtype).tiny)
        return (least - (after - before) ** 2 / (8 * bend))[..., 0]

    @staticmethod
    def _slack(goal: Tensor) -> Tensor:
        """(...): by how much rounding may let a ray miss points of the bent plane."""
        return 1e3 * torch.finfo(goal.dtype).eps * (1 + length_of(goal))

    def _find_points(self, goal: Tensor, start: Tensor, last: Tensor) -> Tensor:
        """(N, ..., 2): points of the ideal plane whose place in the bent one is `goal`, if there is
        one within `last`; from half as far out as `start`, where nothing is about to fold."""
        if torch.compiler.is_compiling():
            return _newton(self._bent, self._bent_slopes, goal, start / 2, 1.1 * last, rounds=30)
        azimuth = torch.arange(256, dtype=goal.dtype, device=goal.device) * (math.pi / 128)
        circle = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
        # A lens at a time, whatever the shape of its pixels.
        shape, start = goal.shape, start.expand_as(goal).reshape(len(self), -1, 2)
        goal, points = goal.reshape(len(self), -1, 2), start.clone()
        for k, end in enumerate(last.flatten()):
            lens = self[k]
            # Most pixels that no ray reaches lie beyond the rim: they are not looked for.
            near = length_of(goal[k]) < 1.01 * length_of(lens._bent(end * circle)).max()
            for share in (0.5, 0.0):  # where one way is blocked, another is not
                points[k][near] = _newton(
                    lens._bent, lens._bent_slopes, goal[k][near], share * start[k][near], 1.1 * end
                )
                near &= length_of(lens._bent(points[k]) - goal[k]) > self._slack(goal[k])
        return points.reshape(shape)

    def _find_rays(self, flat: Tensor, theta: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """The rays that land at points before `affine`, by Newton's method in the ideal plane, from
        where they would be if nothing but the radial curve were. The last steps carry the
        gradients, as in `inverse`."""
        end = self._row(self.theta_max.detach(), theta.dim())
        goal = flat / self._row(self.focal, flat.dim())
        with torch.no_grad():
            last = self._plane(end)
            start = self._plane(torch.where(theta.isnan(), end, theta))[..., None] * direction
            point = self._find_points(goal, start, last)
            lands = length_of(self._bent(point) - goal) < self._slack(goal)
            # Where the map is about to fold, rounding moves a ray by the root of what it is.
            lands &= length_of(point) <= last * (1 + math.sqrt(torch.finfo(flat.dtype).eps))
        # The principal point in place of what has no ray: NaN would reach the gradients.
        goal, point = (torch.where(lands[..., None], x, 0.0) for x in (goal, point))
        for _ in range(2):
            point = point - _solve(self._bent_slopes(point), self._bent(point) - goal)
        w = length_of(point)
        theta = torch.where(lands, self._plane_angle(w), torch.nan)
        return theta, torch.where(lands[..., None], point / w[..., None], direction)


def _newton(
    function: Function,
    slopes: Function,
    goal: Tensor,
    point: Tensor,
    end: Tensor,
    rounds: int = 60,
) -> Tensor:
    """Where a map of the plane takes the value `goal`.

    Newton's steps, shortened until they come nearer and stay where the map does not turn over: from
    a point where it does not, that ends at the goal, or where the map is about to fold.

    Args:
        function: (..., 2) → (..., 2). slopes: (..., 2) → (..., 2, 2), its derivatives.
        goal, point: (n, 2), or any shape while compiling. end: how far from the origin to look.
    """
    found, places = point.clone(), torch.arange(len(point), device=point.device)
    error = function(point) - goal
    step, missed, part = (
        _solve(slopes(point), error),
        length_of(error),
        torch.ones_like(error[..., 0]),
    )
    for _ in range(rounds):
        trial = point - part[..., None] * step
        error, slope = function(trial) - goal, slopes(trial)
        better = (length_of(error) < missed) & (_determinant(slope) > 0) & (length_of(trial) <= end)
        point = torch.where(better[..., None], trial, point)
        step = torch.where(better[..., None], _solve(slope, error), step)
        missed = torch.where(better, length_of(error), missed)
        part = torch.where(better, (2 * part).clamp(max=1), part / 4)
        if torch.compiler.is_compiling():
            continue  # no shape in a graph depends on values
        found[places] = point
        going = missed > 16 * torch.finfo(goal.dtype).eps * (1 + length_of(goal))
        going &= part > 1e-6
        if not going.any():
            return found
        places, goal, point, step, missed, part = (
            x[going] for x in (places, goal, point, step, missed, part)
        )
    found[places] = point
    return found


def _determinant(matrix: Tensor) -> Tensor:
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    return a * d - b * c


def _solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """(..., 2, 2)⁻¹ @ (..., 2)."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    solved = torch.stack((d * x - b * y, a * y - c * x), -1)
    return solved / _determinant(matrix)[..., None]


def _radial_slopes(ratio: Tensor, slope: Tensor, direction: Tensor) -> Tensor:
    """(..., 2, 2): the derivatives of a radial map, `ratio` across and `slope` along a radius."""
    along = direction[..., :, None] * direction[..., None, :]
    across = torch.eye(2, dtype=ratio.dtype, device=ratio.device) - along
    return ratio[..., None, None] * across + slope[..., None, None] * along


class KannalaBrandt(DistortedLens):
    """r = f (θ + k₁ θ³ + k₂ θ⁵ + …): OpenCV's fisheye model, Kalibr's and ROS's "equidistant".

    Args: `focal`, `radial`, then as `DistortedLens`, with w = θ.

    Source: Kannala and Brandt, PAMI 2006; OpenCV, cv::fisheye.
    """

    def _plane(self, theta: Tensor) -> Tensor:
        return theta

    def _plane_slope(self, theta: Tensor) -> Tensor:
        return torch.ones_like(theta)

    def _plane_angle(self, w: Tensor) -> Tensor:
        return w

    def _plane_limit(self) -> Tensor:
        return torch.full_like(self.focal.detach(), math.pi - MARGIN)


class Fisheye624(KannalaBrandt):
    """`KannalaBrandt` whose tangential and thin-prism terms act after the radial ones.

    With six k, two p and four s it is Project Aria's camera and COLMAP's
    RAD_TAN_THIN_PRISM_FISHEYE. Arguments: as `KannalaBrandt`; their p₀ and p₁ are our p₂ and p₁.
    """

    def _offset_plane(self, w: Tensor) -> Tensor:
        return self._stretch(w)

    def _offset_plane_slope(self, w: Tensor) -> Tensor:
        return self._stretch_slope(w)


class Mei(DistortedLens):
    """The unified model with radial and tangential terms: w = sin θ / (ξ + cos θ).

    OpenCV's omnidir, Kalibr's omni-radtan, KITTI-360's fisheyes; at ξ = 0 a pinhole with radtan.

    Args: `xi`, ξ ≥ 0, `focal`, `radial`, then as `DistortedLens`.

    Source: Mei and Rives, ICRA 2007.
    """

    parameters = ("xi", "focal")
    xi: Tensor

    def __init__(
        self,
        xi: Number,
        focal: Number,
        radial: Number | None = None,
        theta_max: Number | None = None,
        center: Number | None = None,
        **others: Number | None,
    ):
        super().__init__(focal, radial, theta_max, center, xi=xi, **others)

    def _validate(self) -> None:
        self._require("xi", (self.xi >= 0) & self.xi.isfinite(), "finite and at least 0")
        super()._validate()

    def _plane(self, theta: Tensor) -> Tensor:
        return torch.sin(theta) / (self._row(self.xi, theta.dim()) + torch.cos(theta))

    def _plane_slope(self, theta: Tensor) -> Tensor:
        xi, cos = self._row(self.xi, theta.dim()), torch.cos(theta)
        return (1 + xi * cos) / (xi + cos) ** 2

    def _plane_angle(self, w: Tensor) -> Tensor:
        return sphere_angle(w, self._row(self.xi, w.dim()))

    def _plane_limit(self) -> Tensor:
        return sphere_limit(self.xi)


class BrownConrady(DistortedLens):
    """A pinhole camera with distortion: w = tan θ, θ < 90°. OpenCV's standard model.

    Args: `focal`, `radial`, then as `DistortedLens`; and
        denominator: (n,) or (N, n): k₄, k₅, … of OpenCV's rational model, by which r is divided:
            1 + k₄ w² + k₅ w⁴ + …, or None.

    Source: Brown, 1966; OpenCV, calib3d.
    """

    optional = ("radial", "denominator", "tangential", "prism")
    denominator: Tensor | None

    def _plane(self, theta: Tensor) -> Tensor:
        return torch.tan(theta)

    def _plane_slope(self, theta: Tensor) -> Tensor:
        return torch.cos(theta) ** -2

    def _plane_angle(self, w: Tensor) -> Tensor:
        return torch.atan(w)

    def _plane_limit(self) -> Tensor:
        return torch.full_like(self.focal.detach(), math.pi / 2 - MARGIN)

    def _divisor(self, w: Tensor) -> Tensor:
        return 1 + w * w * horner(w * w, self.denominator)

    def _stretch(self, w: Tensor) -> Tensor:
        stretched = super()._stretch(w)
        return stretched if self.denominator is None else stretched / self._divisor(w)

    def _stretch_slope(self, w: Tensor) -> Tensor:
        slope = super()._stretch_slope(w)
        if self.denominator is None:
            return slope
        divisor, grows = self._divisor(w), w * horner(w * w, slopes(self.denominator, 2, 2))
        slope = (slope * divisor - super()._stretch(w) * grows) / divisor**2
        return torch.where(divisor > 0, slope, -1)  # beyond a pole nothing lands
