"""Lenses that bend an ideal plane: radial, tangential and thin-prism terms.

A ray has a place in an ideal plane, w(θ) (cos φ, sin φ). Radial terms stretch it; tangential terms
(elements of the lens that are off centre) and thin-prism terms (tilted ones) move it aside; the
focal length makes pixels of it.
"""

import math

import torch
from torch import Tensor

from darswin.inverse import rising_limit
from darswin.lens.base import MARGIN, Lens, Number
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

    @property
    def is_radial(self) -> bool:
        return self.tangential is None and self.prism is None

    def offset(self, theta: Tensor, direction: Tensor) -> Tensor:
        w = self._offset_plane(theta)
        x, y = (w[..., None] * direction).unbind(-1)
        square = w * w
        dx, dy = torch.zeros_like(x), torch.zeros_like(y)
        if self.tangential is not None:
            p1, p2 = (self._row(p, w.dim()) for p in self.tangential.unbind(1))
            dx = dx + 2 * p1 * x * y + p2 * (square + 2 * x * x)
            dy = dy + p1 * (square + 2 * y * y) + 2 * p2 * x * y
        if self.prism is not None:
            s1, s2, s3, s4 = (self._row(s, w.dim()) for s in self.prism.unbind(1))
            dx = dx + square * (s1 + s2 * square)
            dy = dy + square * (s3 + s4 * square)
        return self._row(self.focal, w.dim() + 1) * torch.stack((dx, dy), -1)


class KannalaBrandt(DistortedLens):
    """r = f (θ + k₁ θ³ + k₂ θ⁵ + …): OpenCV's fisheye model, Kalibr's and ROS's "equidistant".

    Args: `focal`, `radial`, then as `DistortedLens`, with w = θ.

    Source: Kannala and Brandt, PAMI 2006; OpenCV, cv::fisheye.
    """

    def __init__(
        self,
        focal: Number,
        radial: Number | None = None,
        theta_max: Number | None = None,
        center: Number | None = None,
        *,
        tangential: Number | None = None,
        prism: Number | None = None,
        **frame: Number | None,
    ):
        super().__init__(
            theta_max, center, focal=focal, radial=radial, tangential=tangential, prism=prism,
            **frame,
        )  # fmt: skip

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
        *,
        tangential: Number | None = None,
        prism: Number | None = None,
        **frame: Number | None,
    ):
        super().__init__(
            theta_max, center, xi=xi, focal=focal, radial=radial, tangential=tangential,
            prism=prism, **frame,
        )  # fmt: skip

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

    def __init__(
        self,
        focal: Number,
        radial: Number | None = None,
        theta_max: Number | None = None,
        center: Number | None = None,
        *,
        denominator: Number | None = None,
        tangential: Number | None = None,
        prism: Number | None = None,
        **frame: Number | None,
    ):
        super().__init__(
            theta_max, center, focal=focal, radial=radial, denominator=denominator,
            tangential=tangential, prism=prism, **frame,
        )  # fmt: skip

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
