"""Distributions of random lenses, for warping images.

The field of view of every lens fills a circle of a given radius. So all lenses see the same, and
they differ only in how they spread the angles over the radius.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from darswin.lens import Lens, Polynomial, Spherical
from darswin.utils.angles import degrees_hint

# The paper's four levels of distortion, as ranges of ξ of the Spherical lens (sec. 5.1).
LEVELS = {
    "very low": (0.0, 0.05),
    "low": (0.2, 0.35),
    "medium": (0.5, 0.7),
    "high": (0.85, 1.0),
}


class LensDistribution:
    """A distribution of lenses."""

    def draw(self, rng: np.random.Generator, fov: float, radius: float) -> Lens:
        """A random lens whose full field of view `fov` (rad) fills a circle of `radius` px.

        Raises ValueError for a field of view that no such lens has.
        """
        raise NotImplementedError


@dataclass(frozen=True)
class SphericalLenses(LensDistribution):
    """Spherical lenses with ξ uniform in [low, high]."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0 <= self.low <= self.high < math.inf:
            raise ValueError(f"ξ must be 0 ≤ low ≤ high, got {self.low} to {self.high}")

    def draw(self, rng: np.random.Generator, fov: float, radius: float) -> Lens:
        return Spherical.from_fov(rng.uniform(self.low, self.high), fov, radius)


@dataclass(frozen=True)
class PolynomialLenses(LensDistribution):
    """Polynomial lenses, r ∝ k₁ θ + … + k₄ θ⁴, where (k₁, …, k₄) is a random positive direction.

    Source: the test set of DarSwin, ICCV 2023, table 5. Its coefficients are positive and have a
    random direction; their magnitude follows from the field of view and the radius.
    """

    def draw(self, rng: np.random.Generator, fov: float, radius: float) -> Lens:
        if not 0 < fov < 2 * math.pi:
            raise ValueError(f"fov must be in (0, 2π) rad, got {fov}{degrees_hint(fov)}")
        direction = np.abs(rng.standard_normal(4))
        theta_max = fov / 2
        scale = radius / sum(k * theta_max**power for power, k in enumerate(direction, start=1))
        return Polynomial(torch.tensor(direction * scale, dtype=torch.float32), theta_max)


def parse_lenses(text: str | float) -> LensDistribution:
    """A distribution by its name in configurations.

    Args:
        text: a level of the paper ("very low", "low", "medium", "high"), one ξ, a range of ξ such
            as "0.2..0.35", or "polynomial".

    Raises:
        ValueError: any other text.
    """
    text = str(text).strip()
    if text in LEVELS:
        return SphericalLenses(*LEVELS[text])
    if text == "polynomial":
        return PolynomialLenses()
    try:
        ends = [float(end) for end in text.split("..")]
        if len(ends) <= 2:
            return SphericalLenses(ends[0], ends[-1])
    except ValueError as error:
        if "ξ must" in str(error):
            raise
    raise ValueError(
        f"lenses must be one of {list(LEVELS)}, 'polynomial', a number ξ, or a range 'low..high', "
        f"got {text!r}"
    )


def parse_sweep(text: str | float | list) -> list[str]:
    """The names of several distributions; "start:stop:step" means equally spaced ξ."""
    if isinstance(text, list):
        return [name for part in text for name in parse_sweep(part)]
    parts = str(text).split(":")
    if len(parts) == 1:
        names = [part.strip() for part in parts[0].split(",")]
    elif len(parts) == 3:
        start, stop, step = (float(part) for part in parts)
        if step <= 0 or stop < start:
            raise ValueError(f"a sweep start:stop:step must rise, got {text!r}")
        count = math.floor((stop - start) / step + 1e-6) + 1
        names = [f"{start + k * step:.6g}" for k in range(count)]
    else:
        raise ValueError(f"a sweep must be start:stop:step, got {text!r}")
    for name in names:
        parse_lenses(name)
    return names
