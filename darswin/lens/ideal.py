"""Lenses with one focal length: the ideal projections of lens design."""

import math
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor

from darswin.lens.base import MARGIN, Lens
from darswin.lens.parameter import Arguments, Number, Parameter


class FocalLens(Lens, register=False):
    """Base of the lenses whose only length is the focal length, f > 0, px: r = f u(θ)."""

    _end = math.pi  # θ where u stops rising or becomes infinite
    focal = Parameter(low=0, open=True, in_pixels=True, bounds=(1e-9, math.inf))

    @classmethod
    def from_fov(cls, *arguments: Any, **named: Any) -> Self:
        """The lens whose full field of view fills a circle.

        Args:
            arguments: the model's parameters without `focal`, in the order of its constructor, then
                `fov`, rad, the full field of view; `radius`, px, of the circle; and `center`.
            named: any of them by name; also `affine`, `image_size` and the optional parameters.

        Raises the constructor's errors.
        """
        rows = cls._expanded(cls._of_fov().bind(f"{cls.__name__}.from_fov", arguments, named))
        theta_max, radius = rows.pop("fov") / 2, rows.pop("radius")
        lens = cls(**rows, focal=torch.ones_like(radius))
        lens._require("radius", (radius > 0) & radius.isfinite(), "finite and above 0", radius)
        lens._set_theta_max(theta_max, "fov")
        lens.focal = lens._scale_to(radius)
        lens._set_theta_max(theta_max, "fov")  # a limit by rounding depends on the focal length
        return lens

    @classmethod
    @cache
    def _of_fov(cls) -> Arguments:
        own = [name for name in cls.parameters if name != "focal"]
        by_name = (*cls.optional, "affine", "image_size")
        return Arguments((*own, "fov", "radius"), ("center",), by_name)

    def _scale_to(self, radius: Tensor) -> Tensor:
        """(N,): the factor by which the lens must grow for θ_max to land at `radius`."""
        return radius / self.r_max

    @property
    def theta_limit(self) -> Tensor:
        return torch.full_like(self.focal, self._end - MARGIN)


class IdealLens(FocalLens, register=False):
    """Base of the lenses r = f u(θ) without other parameters."""

    _rise: ClassVar[Callable[..., Tensor]]  # u(θ)
    _fall: ClassVar[Callable[..., Tensor]]  # the inverse of u
    _top: float | None = None  # the largest u, if it is finite

    def project(self, theta: Number) -> Tensor:
        theta, focal = self._aligned(theta, "focal")
        return focal * self._rise(theta)

    def _angle_at(self, radius: Tensor) -> Tensor:
        rise = radius / self._row(self.focal, radius.dim())
        # Rounding can raise u above its largest value, which has no angle.
        return self._fall(rise if self._top is None else rise.clamp(max=self._top))

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, fov: Number, radius: Number, center: Number | None = None, *,
            affine: Number | None = None, image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip


class Perspective(IdealLens):
    """r = f tan θ, θ < 90°: the pinhole camera. Arguments: `focal`, and those of `Lens`."""

    _end = math.pi / 2
    _rise = staticmethod(torch.tan)
    _fall = staticmethod(torch.atan)


class Equidistant(IdealLens):
    """r = f θ: equal angles are equal steps. Arguments: `focal`, and those of `Lens`."""

    _rise = staticmethod(lambda theta: theta)
    _fall = staticmethod(lambda rise: rise)


class Equisolid(IdealLens):
    """r = 2 f sin(θ/2): preserves solid angles. Arguments: `focal`, and those of `Lens`."""

    _top = 2.0
    _rise = staticmethod(lambda theta: 2 * torch.sin(theta / 2))
    _fall = staticmethod(lambda rise: 2 * torch.asin(rise / 2))


class Stereographic(IdealLens):
    """r = 2 f tan(θ/2): preserves angles. Arguments: `focal`, and those of `Lens`."""

    _rise = staticmethod(lambda theta: 2 * torch.tan(theta / 2))
    _fall = staticmethod(lambda rise: 2 * torch.atan(rise / 2))


class Orthographic(IdealLens):
    """r = f sin θ, θ < 90°. Arguments: `focal`, and those of `Lens`."""

    _end = math.pi / 2
    _top = 1.0
    _rise = staticmethod(torch.sin)
    _fall = staticmethod(torch.asin)


class FieldOfView(FocalLens):
    """r = f atan(2 tan(ω/2) tan θ) / ω: the FOV model, extended beyond 90°.

    Args:
        omega: ω in (0, π), rad. focal: f > 0, px.

    `Lens` describes the other arguments.

    Source: Devernay and Faugeras, MVA 2001, sec. 3.1.
    """

    omega = Parameter(
        low=0, high=math.pi, open=True, angle=True, starts=(1.0,), bounds=(1e-3, 3.14)
    )

    def project(self, theta: Number) -> Tensor:
        theta, omega, focal = self._aligned(theta, "omega", "focal")
        tangent = 2 * torch.tan(omega / 2)
        return focal / omega * torch.atan2(tangent * torch.sin(theta), torch.cos(theta))

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, omega, focal = self._aligned(radius, "omega", "focal")
        angle, tangent = radius * omega / focal, 2 * torch.tan(omega / 2)
        return torch.atan2(torch.sin(angle), tangent * torch.cos(angle))

    if TYPE_CHECKING:

        @classmethod
        def from_fov(
            cls, omega: Number, fov: Number, radius: Number, center: Number | None = None, *,
            affine: Number | None = None, image_size: Number | None = None,
        ) -> Self: ...  # fmt: skip
