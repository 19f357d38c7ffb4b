"""A room and a street with exact colours, labels and distances along any ray, in float64.

Coordinates are in metres in the frame of vehicles: x forward, y left, z up. Every ray is cut with
every thing of which its tile may see a part, by the thing's own formula. The paints have hard
edges, so a picture of one ray a pixel is full of aliasing.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from darswin.lens import Lens

NOTHING = 255  # the label beyond θ_max
CHUNK = 1 << 16  # rays at a time
BRIGHTEST = 240.0  # of 255, so that a camera's gain may be a little more than 1
# A camera that looks ahead: its x (right), y (down) and z (forward) in the scene's frame.
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
Rays = Callable[[np.ndarray], np.ndarray]  # pixels (N, 2) → unit vectors (N, 3), NaN without a ray


@dataclass(frozen=True)
class Paint:
    """Tiles or stripes. side: of a tile or a stripe, m; first, second: colours, of 255; joint: the
    share of a tile's side that is a dark joint; spread: how much tiles differ, of 255."""

    side: float
    first: tuple[int, int, int]
    second: tuple[int, int, int]
    striped: bool = False
    joint: float = 0.08
    spread: float = 40.0

    def __call__(self, at: np.ndarray) -> np.ndarray:
        """The colours (N, 3) at places (N, 2) on a surface, m."""
        cell = np.floor(at / self.side)
        u, v = cell.T
        u, v = cell.T
        if self.striped:
            return np.where(v[:, None] % 2 == 0, self.first, self.second).astype(np.float64)
        noise = np.sin(12.9898 * u + 78.233 * v) * 43758.5453  # differs from tile to tile
        colour = np.where((u + v)[:, None] % 2 == 0, self.first, self.second)
        colour = colour + (self.spread * (noise - np.floor(noise) - 0.5))[:, None]
        (du, dv), joint = (at / self.side - cell).T, self.joint
        dark = ((du < joint) | (dv < joint))[:, None]
        return np.where(dark, 45.0, colour.clip(0, BRIGHTEST))


@dataclass(frozen=True)
class Ball:
    center: tuple[float, float, float]
    radius: float
    paint: Paint
    label: int

    @property
    def reach(self) -> float:
        """The radius of a ball around `center` that holds the thing."""
        return self.radius

    def cut(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """The distances (N,) at which rays first meet it, infinite if they do not."""
        return _in_front(_of_square(rays, origin - self.center, 3, self.radius)[0])

    def places(self, points: np.ndarray) -> np.ndarray:
        """The places (N, 2) on its surface of points (N, 3), m."""
        x, y, z = (points - self.center).T
        angles = np.stack((np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))), 1)
        return self.radius * angles


@dataclass(frozen=True)
class Cylinder:
    """Upright. height: of the whole."""

    center: tuple[float, float, float]
    radius: float
    height: float
    paint: Paint
    label: int

    @property
    def reach(self) -> float:
        return math.hypot(self.radius, self.height / 2)

    def cut(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        start = origin - self.center
        near, far = _of_square(rays, start, 2, self.radius)
        with np.errstate(divide="ignore"):
            a, b = ((end * self.height / 2 - start[2]) / rays[:, 2] for end in (-1, 1))
        enter, leave = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
        return _in_front(np.where(enter < leave, enter, np.inf))

    def places(self, points: np.ndarray) -> np.ndarray:
        x, y, z = (points - self.center).T
        return np.stack((self.radius * np.arctan2(y, x), z), 1)


@dataclass(frozen=True)
class Box:
    """With sides (x, y, z) in m, turned about the vertical by `yaw` (rad). inside: it is a room."""

    center: tuple[float, float, float]
    sides: tuple[float, float, float]
    paint: Paint
    label: int
    yaw: float = 0.0
    inside: bool = False

    @property
    def reach(self) -> float:
        return math.inf if self.inside else float(np.linalg.norm(self.sides)) / 2

    @property
    def _turn(self) -> np.ndarray:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])

    def cut(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        start, along = (origin - self.center) @ self._turn, rays @ self._turn
        half = np.array(self.sides)[:, None] / 2
        with np.errstate(divide="ignore"):
            slope = 1 / along.T
        low, high = (-half - start[:, None]) * slope, (half - start[:, None]) * slope
        (a, b, c), (d, e, f) = np.minimum(low, high), np.maximum(low, high)
        enter, leave = np.maximum(np.maximum(a, b), c), np.minimum(np.minimum(d, e), f)
        return leave if self.inside else _in_front(np.where(enter < leave, enter, np.inf))

    def faces(self, points: np.ndarray) -> np.ndarray:
        """The axis (0, 1, 2) across the face that has each point (N,), plus 3 on its far side."""
        local = (points - self.center) @ self._turn / self.sides
        axis = np.abs(local).argmax(1)
        return axis + 3 * (np.take_along_axis(local, axis[:, None], 1)[:, 0] > 0)

    def places(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.center) @ self._turn
        axis = self.faces(points) % 3
        other = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        return np.take_along_axis(local, other, 1)


@dataclass(frozen=True)
class Ground:
    """The plane z = 0, with white lines of parking lots on it."""

    paint: Paint
    label: int
    reach = math.inf

    def cut(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return np.where(rays[:, 2] < 0, -origin[2] / rays[:, 2], np.inf)

    def places(self, points: np.ndarray) -> np.ndarray:
        return points[:, :2]

    def colours(self, at: np.ndarray) -> np.ndarray:
        x, y = at.T
        across = (np.abs((x + 1.3) % 2.6 - 1.3) < 0.06) & (np.abs(np.abs(y) - 4.4) < 2)
        along = np.abs(np.abs(y) - 2.4) < 0.06
        return np.where((across | along)[:, None], 235.0, self.paint(at))


class Hits(NamedTuple):
    """The ends of N rays. colour: (N, 3), 0 to 255; label: (N,) uint8; distance: (N,) m, infinite
    in the sky."""

    colour: np.ndarray
    label: np.ndarray
    distance: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Things and a sky. origin: the place from which pictures are taken, if none is given."""

    things: Sequence[Ball | Cylinder | Box | Ground]
    origin: tuple[float, float, float]
    sky: int = 254

    def cast(self, origin: np.ndarray, rays: np.ndarray) -> Hits:
        """What unit rays (N, 3) from a point (3,) meet first."""
        distance, first = np.full(len(rays), np.inf), np.full(len(rays), -1)
        for number, thing in enumerate(self._near(origin, rays)):
            if thing is None:
                continue
            cut = thing.cut(origin, rays)
            nearer = cut < distance
            distance[nearer], first[nearer] = cut[nearer], number
        colour, label = np.full((len(rays), 3), (150.0, 190, 235)), np.full(len(rays), self.sky)
        for number in np.unique(first[first >= 0]):
            of, thing = np.flatnonzero(first == number), self.things[number]
            points = origin + distance[of, None] * rays[of]
            at = thing.places(points)
            colour[of] = thing.colours(at) if isinstance(thing, Ground) else thing.paint(at)
            is_room = isinstance(thing, Box) and thing.inside
            label[of] = thing.label + (thing.faces(points) if is_room else 0)
        return Hits(colour, label.astype(np.uint8), distance)

    def _near(self, origin: np.ndarray, rays: np.ndarray) -> list:
        """The things, and None in place of those that none of the rays can meet."""
        middle = rays.sum(0)
        middle /= np.linalg.norm(middle) or 1
        spread = math.acos(np.clip((rays @ middle).min(), -1, 1))
        near = []
        for thing in self.things:
            meets = math.isinf(thing.reach)
            if not meets:
                away = np.array(thing.center) - origin
                far = float(np.linalg.norm(away))
                angle = math.acos(np.clip(middle @ away / far, -1, 1))
                meets = far <= thing.reach or angle < spread + math.asin(thing.reach / far) + 1e-6
            near.append(thing if meets else None)
        return near


class Picture(NamedTuple):
    """colour: (H, W, 3) float32, the mean of the rays of each pixel that the lens has; label:
    (H, W) uint8 and distance: (H, W), of the ray through the centre, NOTHING and NaN without one;
    labels, distances: of all rays, (H, W, k²), or None."""

    colour: np.ndarray
    label: np.ndarray
    distance: np.ndarray
    labels: np.ndarray | None = None
    distances: np.ndarray | None = None


def picture(
    scene: Scene, rays: Rays, size: tuple[int, int], samples: int = 1, *, pose: np.ndarray | None
    = None, keep: bool = False,
) -> Picture:  # fmt: skip
    """What a camera sees of a scene, with samples × samples rays a pixel, in its middle of one.

    Args:
        rays: of the camera's pixels, in its frame.
        pose: (4, 4), the camera's in the scene; None looks ahead from the scene's origin.
        keep: whether the labels and distances of all rays are kept.
    """
    turn, origin = AHEAD, np.array(scene.origin)
    if pose is not None:
        turn, origin = pose[:3, :3], pose[:3, 3]

    def shoot(count: int) -> tuple[np.ndarray, ...]:
        colour = np.zeros((*size, 3), np.float32)
        label = np.full((*size, count**2), NOTHING, np.uint8)
        distance = np.full((*size, count**2), np.nan, np.float32 if count > 1 else np.float64)
        side = max(1, math.isqrt(CHUNK) // count)
        part = (np.arange(count) + 0.5) / count - 0.5
        dy, dx = (d.ravel() for d in np.meshgrid(part, part, indexing="ij"))
        for top in range(0, size[0], side):
            for left in range(0, size[1], side):
                y, x = np.mgrid[top : min(top + side, size[0]), left : min(left + side, size[1])]
                tile = np.s_[top : top + side, left : left + side]
                at = np.stack((x[..., None] + dx, y[..., None] + dy), -1)
                way = rays(at.reshape(-1, 2))
                seen = ~np.isnan(way[:, 0])
                if not seen.any():
                    continue
                hits = scene.cast(origin, way[seen] @ turn.T)
                colours = np.zeros((len(way), 3))
                colours[seen] = hits.colour
                number = seen.reshape(at.shape[:3]).sum(-1)[..., None]
                colour[tile] = colours.reshape(*at.shape[:3], 3).sum(2) / np.maximum(number, 1)
                for whole, values in ((label, hits.label), (distance, hits.distance)):
                    flat = whole[tile].reshape(-1)  # a copy
                    flat[seen] = values
                    whole[tile] = flat.reshape(at.shape[:3])
        return colour, label, distance

    colour, labels, distances = shoot(samples)
    label, distance = (labels, distances) if samples == 1 else shoot(1)[1:]
    label, distance = label[..., 0], distance[..., 0]
    colour[label == NOTHING] = 0
    return Picture(colour, label, distance, *((labels, distances) if keep else ()))


def rays_of(lens: Lens, size: tuple[int, int]) -> Rays:
    """Of a lens, beyond which there are none."""

    def rays(pixels: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return lens.unproject_points(torch.from_numpy(pixels)[None], size)[0].numpy()

    return rays


def sphere_rays(size: tuple[int, int]) -> Rays:
    """Of a picture of all directions (H, 2 H): the middle looks ahead, the top up."""

    def rays(pixels: np.ndarray) -> np.ndarray:
        azimuth = ((pixels[:, 0] + 0.5) / size[1] - 0.5) * 2 * np.pi
        down = ((pixels[:, 1] + 0.5) / size[0] - 0.5) * np.pi
        across = np.cos(down)
        return np.stack((across * np.sin(azimuth), np.sin(down), across * np.cos(azimuth)), 1)

    return rays


def room(seed: int = 74) -> Scene:
    """A room of 9 × 6.5 × 3.1 m with four poles of 8 cm and twelve things, at 1 to 6 m."""
    rng = np.random.default_rng(seed)
    wall = Paint(0.25, (205, 190, 150), (120, 140, 170), spread=70)
    things: list = [Box((0.53, -0.31, 0.07), (9.0, 6.5, 3.1), wall, 0, inside=True)]
    stripes = Paint(0.1, (240, 240, 240), (25, 25, 25), striped=True)
    for angle, far in ((-92, 1.6), (-50, 2.2), (25, 1.3), (88, 2.4)):
        x, y = far * math.cos(math.radians(angle)), far * math.sin(math.radians(angle))
        things.append(Cylinder((x, y, 0.07), 0.04, 3.1, stripes, len(things) + 6))
    for number in range(12):
        angle = 2 * math.pi * (number + rng.uniform(0.2, 0.8)) / 12
        far, size = rng.uniform(1.1, 2.6), rng.uniform(0.18, 0.35)
        place = (far * math.cos(angle), far * math.sin(angle), rng.uniform(-1.0, 1.0))
        light, dark = rng.integers(120, 250, 3), rng.integers(10, 110, 3)
        paint = Paint(rng.uniform(0.05, 0.12), tuple(light), tuple(dark), number % 2 == 0)
        label = len(things) + 6
        things.append((
            Ball(place, size, paint, label),
            Box(place, (2 * size, size, 1.5 * size), paint, label, rng.uniform(0, math.pi)),
            Cylinder(place, size / 1.5, 2 * size, paint, label),
        )[number % 3])  # fmt: skip
    return Scene(things, (0.0, 0.0, 0.0))


def street() -> Scene:
    """Paving with lots for cars, four parked ones, and poles, around a car whose rear axle is above
    the origin."""
    paving = Paint(0.4, (120, 118, 112), (150, 146, 138), joint=0.1, spread=70)
    stripes = Paint(0.2, (220, 40, 30), (240, 240, 240), striped=True)
    things: list = [Ground(paving, 0)]
    for x, y, colour in ((6.5, 4.6, 60), (-4, 4.9, 200), (1.3, -5.2, 110), (6.4, -4.8, 160)):
        paint = Paint(0.5, (colour, 80, 90), (colour, 160, 190), spread=20)
        things.append(Box((x, y, 0.75), (1.8, 4.2, 1.5), paint, len(things)))
    for x, y in ((6.3, 1.2), (5.0, -2.9), (-3.2, 0.8), (-2.5, -3.1), (0.6, 3.2), (3.4, 2.9)):
        things.append(Cylinder((x, y, 0.6), 0.06, 1.2, stripes, len(things)))
    return Scene(things, (0.0, 0.0, 1.5))


def empty(scene: Scene) -> Scene:
    """The same scene without things that stand on its ground."""
    return replace(scene, things=[of for of in scene.things if isinstance(of, Ground)])


def _of_square(rays: np.ndarray, start: np.ndarray, axes: int, radius: float) -> tuple:
    """Where rays enter and leave a ball (3 axes) or an endless upright cylinder (2)."""
    along = rays[:, :axes]
    a = (along * along).sum(1)
    b = along @ start[:axes]
    inside = b * b - a * (start[:axes] @ start[:axes] - radius**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(np.where(inside > 0, inside, np.nan))
        near, far = (-b - root) / a, (-b + root) / a
    return np.where(np.isnan(near), np.inf, near), np.where(np.isnan(far), -np.inf, far)


def _in_front(distance: np.ndarray) -> np.ndarray:
    return np.where(distance > 0, distance, np.inf)
