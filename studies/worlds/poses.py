"""Random poses of a camera in a map, at places with enough to see."""

import zlib
from dataclasses import dataclass

import numpy as np

from worlds.geometry import LABEL
from worlds.scene import NOTHING, Scene
from worlds.wad import METRE

EYE, EYE_SPREAD = (
    41 / METRE,
    8 / METRE,
)  # m above the floor, as for the player, with a uniform spread
HEADROOM = 56 / METRE  # m, the height that the player needs
CLEARANCE = 0.4  # m to all surfaces except the floor, at the height of the eye
PITCH, ROLL = 10.0, 5.0  # degrees, standard deviations
NEAR, NEAR_SHARE = 0.75, 0.4  # m; at most this share of the view is nearer
ONE_CLASS = 0.7  # at most this share of the view is of one class
TRIES = 10_000


@dataclass(frozen=True)
class Pose:
    """A camera. Attributes: position: (3,) m; rotation: (3, 3), from the camera's frame (x right, y
    down, z forward) to the world's (x east, y north, z up)."""

    position: np.ndarray
    rotation: np.ndarray


def look(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """The rotation of a camera by yaw (from east to north), pitch (upwards) and roll (clockwise
    about its axis), rad."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    forward = np.array([cos * np.cos(pitch), sin * np.cos(pitch), np.sin(pitch)])
    right = np.array([sin, -cos, 0.0])
    down = np.cross(forward, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    return np.column_stack((turned, np.cross(forward, turned), forward))


def poses_of(scene: Scene, name: str, count: int, seed: int) -> list[Pose]:
    """`count` poses in a map; they depend only on its name and the seed.

    Raises:
        RuntimeError: a map in which too few places are fit.
    """
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    triangles, weight = _floors(scene)
    sphere, found = _sphere(2000), []
    for _ in range(TRIES):
        if len(found) == count:
            return found
        corners = triangles[rng.choice(len(triangles), p=weight)]
        a, b = np.sort(rng.uniform(size=2))
        position = np.array([a, b - a, 1 - b]) @ corners
        position[2] += EYE + rng.uniform(-EYE_SPREAD, EYE_SPREAD)
        angles = rng.uniform(-np.pi, np.pi), *np.radians(rng.normal(0, (PITCH, ROLL)))
        pose = Pose(position, look(*angles))
        if is_fit(scene, pose, sphere):
            found.append(pose)
    raise RuntimeError(f"{name}: only {len(found)} of {TRIES} random poses are good, not {count}")


def is_fit(scene: Scene, pose: Pose, sphere: np.ndarray) -> bool:
    """True if a pose has headroom, clearance and variety, for any lens.

    Args:
        sphere: (N, 3), unit vectors in all directions.
    """
    hits = scene.cast(pose.position, sphere)
    label, distance = hits.label, hits.distance
    if (label == NOTHING).any() or distance[sphere[:, 2] > 0.99].min() < HEADROOM - EYE:
        return False
    level = np.abs(sphere[:, 2]) < 0.5
    if distance[level].min() < CLEARANCE:
        return False
    ahead = sphere @ pose.rotation[:, 2] > 0  # the view of a lens of 180°
    counts = np.bincount(label[ahead], minlength=len(LABEL))
    near = (distance[ahead] < NEAR).mean()
    return counts.max() <= ONE_CLASS * counts.sum() and near <= NEAR_SHARE


def _floors(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The triangles (T, 3, 3) on which one can stand, and the probability of each.

    Large places are drawn by the root of their area: else most pictures would be of a few yards.
    """
    s = scene.surfaces
    stand = np.isin(s.label, (LABEL["floor"], LABEL["liquid"]))[s.surface]
    triangles, surface = s.triangles[stand], s.surface[stand]
    edges = triangles[:, 1:, :2] - triangles[:, :1, :2]
    area = np.abs(np.linalg.det(edges)) / 2
    whole = np.bincount(surface, area)[surface]
    weight = area / np.sqrt(whole)
    return triangles, weight / weight.sum()


def _sphere(count: int) -> np.ndarray:
    """Directions that fill the sphere evenly, on a spiral, (N, 3)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    aside = np.sqrt(1 - z * z)
    return np.stack((aside * np.cos(turn), aside * np.sin(turn), z), 1)
