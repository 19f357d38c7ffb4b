"""Lenses that bend an ideal plane: radial, tangential and thin-prism terms.

A ray has a place in an ideal plane, w(θ) (cos φ, sin φ). Radial terms stretch it; tangential terms
(elements of the lens that are off centre) and thin-prism terms (tilted ones) move it aside; the
focal length makes pixels of it.
"""

import math

import torch
from torch import Tensor

from darswin.inverse import rising_limit
from darswin.lens.base import MARGIN, Lens, Number, length_of
from darswin.lens.polynomial import horner, slopes
from darswin.lens.sphere import sphere_limit


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
        end = self._plane_limit()
        limit = rising_limit(self._slope, end)
        return torch.where(limit < end, limit - MARGIN, end)

    def project(self, theta: Number) -> Tensor:
        theta, focal = self._aligned(theta, "focal")
        return focal * self._stretch(self._plane(theta))

    def _offset_plane(self, theta: Tensor) -> Tensor:
        """The radius of the plane that tangential and thin-prism terms are functions of."""
        return self._plane(theta)

    def _offset_plane_slope(self, theta: Tensor) -> Tensor:
        return self._plane_slope(theta)

    @property
    def is_radial(self) -> bool:
        return self.tangential is None and self.prism is None

    def offset(self, theta: Tensor, direction: Tensor) -> Tensor:
        w = self._offset_plane(theta)
        x, y = (w[..., None] * direction).unbind(-1)
        square = w * w
        p1, p2, s1, s2, s3, s4 = self._terms(w.dim())
        dx = 2 * p1 * x * y + p2 * (square + 2 * x * x) + square * (s1 + s2 * square)
        dy = p1 * (square + 2 * y * y) + 2 * p2 * x * y + square * (s3 + s4 * square)
        return self._row(self.focal, w.dim() + 1) * torch.stack((dx, dy), -1)

    def _terms(self, dims: int) -> list[Tensor]:
        """p₁, p₂, s₁ … s₄, to broadcast over `dims` dimensions."""
        none = torch.zeros_like(self.focal)
        p = (none, none) if self.tangential is None else self.tangential.unbind(1)
        s = (none,) * 4 if self.prism is None else self.prism.unbind(1)
        return [self._row(term, dims) for term in (*p, *s)]

    def _offset_slopes(self, x: Tensor, y: Tensor) -> Tensor:
        """(..., 2, 2): the derivatives of the offset in its plane, in units of the focal length."""
        p1, p2, s1, s2, s3, s4 = self._terms(x.dim())
        square = x * x + y * y
        across, down = s1 + 2 * s2 * square, s3 + 2 * s4 * square
        mixed = 2 * (p1 * x + p2 * y)
        rows = (
            (2 * p1 * y + 6 * p2 * x + 2 * x * across, mixed + 2 * y * across),
            (mixed + 2 * x * down, 6 * p1 * y + 2 * p2 * x + 2 * y * down),
        )
        return torch.stack([torch.stack(row, -1) for row in rows], -2)

    def _flat_slopes(self, theta: Tensor, direction: Tensor) -> Tensor:
        """(..., 2, 2): the derivatives of where a ray lands in the plane θ (cos φ, sin φ)."""
        w, w_slope = self._offset_plane(theta), self._offset_plane_slope(theta)
        x, y = (w[..., None] * direction).unbind(-1)
        aside = self._offset_slopes(x, y) @ _radial_slopes(w / theta, w_slope, direction)
        straight = _radial_slopes(self.project(theta) / theta, self._slope(theta), direction)
        return straight + self._row(self.focal, w.dim() + 2) * aside

    def _find_rays(self, flat: Tensor, theta: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Newton's method in the plane θ (cos φ, sin φ), from the ray that would land there if
        nothing but the radial curve were. The last step carries the gradients."""

        def step(point: Tensor) -> Tensor:
            theta = length_of(point)
            direction = point / theta[..., None]
            slopes = self._flat_slopes(theta, direction).detach()
            missed = self._flat(theta, direction) - flat
            return point - (torch.linalg.inv_ex(slopes).inverse @ missed[..., None])[..., 0]

        end = self._row(self.theta_max.detach(), theta.dim())
        with torch.no_grad():
            point = torch.where(theta.isnan(), end, theta)[..., None] * direction
            for _ in range(8):
                point = step(point)
                point = point * (end / length_of(point)).clamp(max=1)[..., None]
        point = step(point)
        theta = length_of(point)
        direction = point / theta[..., None]
        with torch.no_grad():
            slack = 1e3 * torch.finfo(flat.dtype).eps
            missed = length_of(self._flat(theta, direction) - flat) > slack * (1 + length_of(flat))
            missed |= ~(theta <= end * (1 + slack))
        return torch.where(missed, torch.nan, theta), direction


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

    def _plane_limit(self) -> Tensor:
        return torch.full_like(self.focal.detach(), math.pi - MARGIN)


class Fisheye624(KannalaBrandt):
    """`KannalaBrandt` whose tangential and thin-prism terms act after the radial ones.

    With six k, two p and four s it is Project Aria's camera and COLMAP's
    RAD_TAN_THIN_PRISM_FISHEYE. Arguments: as `KannalaBrandt`; their p₀ and p₁ are our p₂ and p₁.
    """

    def _offset_plane(self, theta: Tensor) -> Tensor:
        return self._stretch(theta)

    def _offset_plane_slope(self, theta: Tensor) -> Tensor:
        return self._stretch_slope(theta)


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
