"""Lenses of one focal length: the projections that a lens designer aims at."""

import math
from typing import ClassVar

import torch
from torch import Tensor

from darswin.lens.base import MARGIN
from darswin.lens.batch import Number
from darswin.lens.focal import FocalLens


class IdealLens(FocalLens, register=False):
    """Base of the lenses r = f u(θ) that have no other parameter.

    Args:
        focal: f > 0, px. Others: as `Lens`.
    """

    def __init__(
        self,
        focal: Number,
        theta_max: Number | None = None,
        center: Number | None = None,
        **frame: Number | None,
    ):
        super().__init__(theta_max, center, focal=focal, **frame)

    @staticmethod
    def _rise(theta: Tensor) -> Tensor:
        """u(θ)."""
        raise NotImplementedError

    @staticmethod
    def _fall(rise: Tensor) -> Tensor:
        """θ at which u takes a value."""
        raise NotImplementedError

    def project(self, theta: Number) -> Tensor:
        theta, focal = self._aligned(theta, "focal")
        return focal * self._rise(theta)

    def _angle_at(self, radius: Tensor) -> Tensor:
        rise = radius / self._row(self.focal, radius.dim())
        # Rounding can take u above its largest value, which no angle has.
        return self._fall(rise if self._top is None else rise.clamp(max=self._top))

    _end = math.pi  # θ where u stops rising, or becomes infinite
    _top: float | None = None  # u there, if it is finite

    @property
    def theta_limit(self) -> Tensor:
        return torch.full_like(self.focal, self._end - MARGIN)


class Perspective(IdealLens):
    """r = f tan θ, θ < 90°: the pinhole camera. Arguments: `focal`, and those of `Lens`."""

    _end = math.pi / 2

    @staticmethod
    def _rise(theta: Tensor) -> Tensor:
        return torch.tan(theta)

    @staticmethod
    def _fall(rise: Tensor) -> Tensor:
        return torch.atan(rise)


class Equidistant(IdealLens):
    """r = f θ: equal angles are equal steps. Arguments: `focal`, and those of `Lens`."""

    @staticmethod
    def _rise(theta: Tensor) -> Tensor:
        return theta

    @staticmethod
    def _fall(rise: Tensor) -> Tensor:
        return rise


class Equisolid(IdealLens):
    """r = 2 f sin(θ/2): equal solid angles are equal areas. Arguments: `focal`, those of `Lens`."""

    _top = 2.0

    @staticmethod
    def _rise(theta: Tensor) -> Tensor:
        return 2 * torch.sin(theta / 2)

    @staticmethod
    def _fall(rise: Tensor) -> Tensor:
        return 2 * torch.asin(rise / 2)


class Stereographic(IdealLens):
    """r = 2 f tan(θ/2): keeps angles between lines. Arguments: `focal`, and those of `Lens`."""

    @staticmethod
    def _rise(theta: Tensor) -> Tensor:
        return 2 * torch.tan(theta / 2)

    @staticmethod
    def _fall(rise: Tensor) -> Tensor:
        return 2 * torch.atan(rise / 2)


class Orthographic(IdealLens):
    """r = f sin θ, θ < 90°. Arguments: `focal`, and those of `Lens`."""

    _end = math.pi / 2
    _top = 1.0

    @staticmethod
    def _rise(theta: Tensor) -> Tensor:
        return torch.sin(theta)

    @staticmethod
    def _fall(rise: Tensor) -> Tensor:
        return torch.asin(rise)


class FieldOfView(FocalLens):
    """r = f atan(2 tan(ω/2) tan θ) / ω: the FOV model, here also beyond 90°.

    Args:
        omega: ω in (0, π), rad. focal: f > 0, px. Others: as `Lens`.

    Source: Devernay and Faugeras, MVA 2001, sec. 3.1.
    """

    parameters = ("omega", "focal")
    starts: ClassVar = {"omega": (1.0,)}
    bounds: ClassVar = {**FocalLens.bounds, "omega": (1e-3, 3.14)}
    omega: Tensor

    def __init__(
        self,
        omega: Number,
        focal: Number,
        theta_max: Number | None = None,
        center: Number | None = None,
        **frame: Number | None,
    ):
        super().__init__(theta_max, center, omega=omega, focal=focal, **frame)

    def _validate(self) -> None:
        self._require("omega", (self.omega > 0) & (self.omega < math.pi), "in (0, π)")
        super()._validate()

    def project(self, theta: Number) -> Tensor:
        theta, omega, focal = self._aligned(theta, "omega", "focal")
        tangent = 2 * torch.tan(omega / 2)
        return focal / omega * torch.atan2(tangent * torch.sin(theta), torch.cos(theta))

    def _angle_at(self, radius: Tensor) -> Tensor:
        radius, omega, focal = self._aligned(radius, "omega", "focal")
        angle, tangent = radius * omega / focal, 2 * torch.tan(omega / 2)
        return torch.atan2(torch.sin(angle), tangent * torch.cos(angle))

    @property
    def theta_limit(self) -> Tensor:
        return torch.full_like(self.focal, math.pi - MARGIN)
