"""Turns of pictures about the optical axis."""

import math
from typing import NamedTuple

import numpy as np


class Turn(NamedTuple):
    """A rotation by `angle` (rad, from x to y, so clockwise on a screen), then a swap of left and
    right if `mirrored`."""

    angle: float = 0.0
    mirrored: bool = False

    @property
    def matrix(self) -> np.ndarray:
        """The matrix (2, 2) for points relative to the principal point of a lens without affine."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        across = -1.0 if self.mirrored else 1.0
        return np.array([[across * cos, -across * sin], [sin, cos]])


STILL = Turn()


def as_turn(turn: object) -> Turn:
    """The turn, checked; TypeError for others."""
    if not isinstance(turn, Turn):
        raise TypeError(f"turn must be a darswin.views.Turn, got {turn!r}")
    return turn
