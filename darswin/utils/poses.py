"""Poses of cameras and frames of views: matrices that take points of one frame to another."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from darswin.utils.angles import unit_vector

PICTURE_TOP = (0.0, -1.0, 0.0)
AXIS = (0.0, 0.0, 1.0)
# Of R Rᵀ from the identity, if the entries of R were rounded to four digits.
_ROUNDED = 2e-4
_EXACT = 1e-9


def to_pose(what: str, values: Any) -> np.ndarray:
    """A pose (4, 4) from (3 or 4, 4) numbers. A rotation that was rounded, to four digits or more,
    becomes the nearest one. ValueError: there is no rotation, or a number is not finite."""
    values = np.asarray(values, np.float64)
    if values.shape not in ((3, 4), (4, 4)) or not np.isfinite(values).all():
        raise ValueError(f"{what}: a pose is (3, 4) or (4, 4) finite numbers, got {values}")
    pose = np.eye(4)
    pose[: len(values)] = values
    rotation = pose[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        apart = np.abs(rotation @ rotation.T - np.eye(3)).max()
        turns = apart < _ROUNDED and np.linalg.det(rotation) > 0
    if not turns or not np.allclose(pose[3], (0, 0, 0, 1)):
        raise ValueError(f"{what}: its pose holds no rotation, got {values.tolist()}")
    if apart > _EXACT:
        left, _, right = np.linalg.svd(rotation)
        pose[:3, :3] = left @ right
    return pose


def inverse(pose: np.ndarray) -> np.ndarray:
    """The pose (4, 4) the other way."""
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -found[:3, :3] @ pose[:3, 3]
    return found


def from_quaternion(name: str, w: float, x: float, y: float, z: float) -> np.ndarray:
    """The rotation (3, 3) of a quaternion of any length but 0."""
    length = math.hypot(w, x, y, z)
    if not 0 < length < math.inf:
        raise ValueError(f"{name} must not be zero")
    w, x, y, z = (value / length for value in (w, x, y, z))
    cross = np.array(((0, -z, y), (z, 0, -x), (-y, x, 0)))
    return np.asarray(np.eye(3) + 2 * (w * cross + cross @ cross))


def from_rotation_vector(vector: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) about a vector by its length, rad, as of cv2.Rodrigues."""
    half = np.linalg.norm(vector) / 2
    return from_quaternion("", math.cos(half), *(vector / 2 * np.sinc(half / math.pi)))


def frame_of(up: Sequence[float], direction: Sequence[float], upright: bool) -> list[list[float]]:
    """The rotation (3, 3) from the frame of a view to the camera's: its columns are the view's x, y
    and z.

    z is `direction`, and x is level. If the view is `upright`, y is straight down, and z is the
    level part of `direction`. Where `direction` is straight up or down, the picture's top is level.
    """
    # Arrays: on torch's "meta" device, tensors have no values.
    above, ahead = np.array([up, direction], np.float64)
    right = np.cross(ahead, above)
    if np.linalg.norm(right) < 1e-6:
        ahead_of_level = np.array(PICTURE_TOP)
        if np.linalg.norm(np.cross(ahead_of_level, above)) < 1e-6:
            ahead_of_level = np.array(AXIS)
        right = np.cross(ahead_of_level, above)
    axis = above if upright else ahead
    right = right - (right @ axis) * axis  # exactly, also if they are almost parallel
    right = right / np.linalg.norm(right)
    down = -above if upright else np.cross(ahead, right)
    forward = np.cross(right, down) if upright else ahead
    return np.stack((right, down, forward), 1).tolist()


def ahead_of(up: Any) -> tuple[float, float, float]:
    """The direction in a camera's frame that counts as ahead: its axis, or the picture's top if the
    axis is within 10° of the vertical."""
    level = abs(unit_vector("up", up)[2]) < math.cos(math.radians(10))
    return AXIS if level else PICTURE_TOP
