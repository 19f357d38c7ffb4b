"""Spacings: functions of θ that rings, samples and the concentric square divide equally.

- "theta": θ itself, as in the paper's text. Works beyond 90°.
- "tan": tan θ, as in the authors' released code. Only for θ_max < 90°.
- "g": DarSwin-Unet's compromise between the two.
- "radius": r, equal steps in the image; it uses no more of the lens than its image circle.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from darswin.lens.base import Lens
from darswin.lens.solve import inverse
from darswin.ops.checks import readable
from darswin.utils.angles import degrees_hint

Spacing = Literal["theta", "tan", "g", "radius"]
SPACINGS: tuple[Spacing, ...] = ("theta", "tan", "g", "radius")

# g(t) = c b t^n + (1 - c) (1 - (1 - t)^m), t = θ/θ_max: constants of the released DarSwin-Unet.
G_M, G_N, G_B, G_C = 2.288135593220339, 5, 8.31578947368421, 1 / 3


def check_tan(lens: Lens) -> None:
    """Raises ValueError if θ_max is `readable` and not below 90°, where tan θ ends."""
    if not readable(lens.theta_max):
        return
    largest = lens.theta_max.max().item() if len(lens) else 0.0
    if largest >= math.pi / 2:
        raise ValueError(
            "spacing='tan' needs lenses with θ_max below 90°, where tan θ ends; got "
            f"{math.degrees(largest):.1f}°. Use 'theta', 'g' or 'radius'."
        )


def check_fixed_theta_max(theta_max: float, *spacings: Spacing) -> None:
    """Raises ValueError unless a fixed θ_max is in (0, π) and the spacings are "theta"."""
    if not 0 < theta_max < math.pi:
        hint = degrees_hint(theta_max)
        raise ValueError(f"theta_max must be in (0, π), got {theta_max}{hint}")
    for spacing in spacings:
        if spacing != "theta":
            raise ValueError(f"a fixed theta_max needs spacing='theta', got {spacing!r}")


class Rings:
    """The rings of N lenses, equal steps of a spacing from θ = 0 on, and points inside them.

    Args:
        lens: N lenses. rings: R.
        steps: the points inside a ring, (S,), as fractions of it, in [0, 1].
        spacing: of the borders. inner: the spacing of the points.
        theta_max: θ of the last border, rad; both spacings must then be "theta". None means θ_max
            of each lens. Beyond θ_max of a lens, r rises in proportion to θ.

    Raises:
        ValueError: a spacing is "tan" and a lens has θ_max ≥ 90°.
    """

    def __init__(
        self, lens: Lens, rings: int, steps: Tensor, spacing: Spacing, inner: Spacing,
        theta_max: float | None,
    ):  # fmt: skip
        self._lens, self._spacing, self._inner, self._end = lens, spacing, inner, theta_max
        if inner == "tan":
            check_tan(lens)
        first, last = span(lens, spacing)
        if theta_max is not None:
            last = torch.full_like(last, theta_max)
        fractions = torch.linspace(0, 1, rings + 1, dtype=steps.dtype, device=steps.device)
        self._borders = first + (last - first) * fractions
        edges = self._borders
        if inner != spacing:
            edges = to_spacing(lens, to_theta(lens, edges, spacing), inner)
        begin, end = edges[:, :-1, None], edges[:, 1:, None]
        self._points = (begin + (end - begin) * steps).flatten(1)

    @property
    def borders(self) -> Tensor:
        """r of the borders, (N, R+1) px."""
        return self._radii(self._borders, self._spacing)

    @property
    def border_angles(self) -> Tensor:
        """θ of the borders, (N, R+1) rad."""
        return to_theta(self._lens, self._borders, self._spacing)

    @property
    def radii(self) -> Tensor:
        """r of the points, (N, R·S) px."""
        return self._radii(self._points, self._inner)

    @property
    def angles(self) -> Tensor:
        """θ of the points, (N, R·S) rad."""
        return to_theta(self._lens, self._points, self._inner)

    def _radii(self, values: Tensor, spacing: Spacing) -> Tensor:
        lens = self._lens
        if spacing == "radius":
            return values
        theta = to_theta(lens, values, spacing)
        if self._end is None:
            return lens.project(theta)
        last = lens.theta_max[:, None]
        beyond = (theta - last).clamp(min=0) * (lens.r_max[:, None] / last)
        return lens.project(torch.minimum(theta, last)) + beyond


def span(lens: Lens, spacing: Spacing) -> tuple[Tensor, Tensor]:
    """The values of a spacing at θ = 0 and θ_max, (N, 1) each. Raises the errors of `check_tan`."""
    if spacing == "tan":
        check_tan(lens)
    last = lens.theta_max[:, None]
    return to_spacing(lens, torch.zeros_like(last), spacing), to_spacing(lens, last, spacing)


def to_spacing(lens: Lens, theta: Tensor, spacing: Spacing) -> Tensor:
    """The values of a spacing at θ (N, ...), rad, in [0, θ_max]."""
    if spacing == "theta":
        return theta
    if spacing == "tan":
        return torch.tan(theta)
    if spacing == "radius":
        return lens.project(theta)
    return _g(theta / lens._row(lens.theta_max, theta.dim()))


def to_theta(lens: Lens, value: Tensor, spacing: Spacing) -> Tensor:
    """θ, rad, at values of a spacing (N, ...): the inverse of `to_spacing`."""
    if spacing == "theta":
        return value
    if spacing == "tan":
        return torch.atan(value)
    if spacing == "radius":
        return lens.unproject(value)
    t = inverse(_g, _g_slope, value, value.new_ones(()))
    return t * lens._row(lens.theta_max, value.dim())


def _g(t: Tensor) -> Tensor:
    """DarSwin-Unet's g(t) for t = θ/θ_max in [0, 1]; it rises from 0 to c b + 1 - c."""
    t = t.clamp(max=1)  # rounding must not take (1 - t) below 0
    return G_C * G_B * t**G_N + (1 - G_C) * (1 - (1 - t) ** G_M)


def _g_slope(t: Tensor) -> Tensor:
    return G_C * G_B * G_N * t ** (G_N - 1) + (1 - G_C) * G_M * (1 - t) ** (G_M - 1)
