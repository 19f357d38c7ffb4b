"""Mirrored images, and images turned about the optical axis, with their lenses."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from darswin.lens import Lens
from darswin.lens.orientation import rotated, upright

_MIRRORED = 2  # the EXIF orientation of a picture whose left and right are swapped


class Turn(NamedTuple):
    """A turn by `angle` (rad, from x to y: clockwise as images are shown), then, if `mirrored`,
    left and right swapped."""

    angle: float
    mirrored: bool

    @property
    def matrix(self) -> np.ndarray:
        """(2, 2): what it makes of points around the principal point of a lens without affine."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        across = -1.0 if self.mirrored else 1.0
        return np.array([[across * cos, -across * sin], [sin, cos]])


@dataclass(frozen=True)
class RandomTurns:
    """The turns of an augmentation.

    Args:
        flip: mirrors half of the images.
        rotate_deg: degrees in [0, 180]: the angle is uniform in ± this.

    Raises:
        ValueError: an angle out of range.
    """

    flip: bool = False
    rotate_deg: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.rotate_deg <= 180:
            raise ValueError(f"rotate_deg must be in [0, 180], got {self.rotate_deg}")

    def draw(self, rng: np.random.Generator) -> Turn:
        """A turn, drawn from `rng`."""
        angle = rng.uniform(-1, 1) * math.radians(self.rotate_deg)
        return Turn(angle, bool(rng.random() < 0.5) and self.flip)


def turned_lens(lens: Lens, turn: Turn) -> tuple[Lens, np.ndarray]:
    """The lens of a picture after a turn about the lens's optical axis.

    Args:
        lens: one that has the picture's image_size.

    Returns:
        The lens; and (2, 3) float64: what takes a pixel (x, y, 1) to its new place.
    """
    lens, matrix = rotated(lens, turn.angle)
    moves = matrix.numpy()
    if turn.mirrored:
        assert lens.image_size is not None
        moves = moves * [[-1.0], [1.0]]
        moves[0, 2] += lens.image_size[0, 1].item() - 1
        lens = upright(lens, _MIRRORED)
    return lens, moves


def turned_picture(image: np.ndarray, lens: Lens, turn: Turn) -> tuple[np.ndarray, Lens]:
    """A picture (H, W, C) uint8 and its lens after a turn about the lens's optical axis.

    The picture keeps its size; what turns in from beyond it is black. Exact for every lens: where
    pixels are oblong the picture is sheared so that it looks turned through that lens, and
    tangential terms turn with it.

    Args:
        lens: one that has the picture's image_size.
    """
    if turn.angle:
        lens, matrix = rotated(lens, turn.angle)
        height, width = image.shape[:2]
        shape = image.shape
        image = cv2.warpAffine(image, matrix.numpy(), (width, height)).reshape(shape)
    if turn.mirrored:
        image, lens = np.ascontiguousarray(image[:, ::-1]), upright(lens, _MIRRORED)
    return image, lens
