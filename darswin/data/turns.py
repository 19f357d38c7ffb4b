"""Random turns of pictures about the optical axis, for augmentation."""

import math
from dataclasses import dataclass

import numpy as np

from darswin.utils.parameters import check
from darswin.views.turn import Turn


@dataclass(frozen=True)
class RandomTurns:
    """Random turns for augmentation.

    Args:
        flip: mirrors half of the images.
        rotate_deg: degrees in [0, 180]; the angle is uniform between minus and plus this value.

    Raises:
        ValueError: an angle out of range.
    """

    flip: bool = False
    rotate_deg: float = 0.0

    def __post_init__(self) -> None:
        check("rotate_deg", self.rotate_deg, 0 <= self.rotate_deg <= 180, "in [0, 180]")

    def draw(self, rng: np.random.Generator) -> Turn:
        """A random turn."""
        angle = rng.uniform(-1, 1) * math.radians(self.rotate_deg)
        return Turn(angle, bool(rng.random() < 0.5) and self.flip)
