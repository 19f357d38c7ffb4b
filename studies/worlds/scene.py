"""Rays in a world: the first surface on each ray, its distance and its colour."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from worlds.geometry import LABEL, Surfaces, surfaces_of
from worlds.textures import Sampler, Textures
from worlds.things import MEDIUM, MULTIPLAYER, SPRITES
from worlds.wad import METRE, Map

NOTHING = 255  # the label of a ray that meets nothing
LAYERS = 16  # the number of gratings and sprites that a ray may pass
PASSED = 1e-4  # m behind a hole, where a ray goes on
SIGHT = 80.0  # m: things further away are not drawn


class Hits(NamedTuple):
    """The ends of N rays. label: (N,) uint8; distance: (N,) m, infinite for sky and nothing;
    colour: (N, 3) uint8, sRGB, of the texel; light: (N,) in 0..1, of the place; normal: (N, 3),
    unit."""

    label: np.ndarray
    distance: np.ndarray
    colour: np.ndarray
    light: np.ndarray
    normal: np.ndarray


class Body:
    """Surfaces for rays. Embree finds the surface; the plane gives the distance in float64."""

    def __init__(self, surfaces: Surfaces):
        self.surfaces = surfaces
        self._scene = EmbreeScene(robust=True)
        corners = surfaces.triangles.reshape(-1, 3).astype(np.float32)
        self._mesh = TriangleMesh(
            self._scene, corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
        )

    def first(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """The surface that each ray (N, 3) meets first, (N,), or -1."""
        triangle = self._scene.run(origins.astype(np.float32), directions.astype(np.float32))
        return np.where(triangle >= 0, self.surfaces.surface[triangle], -1)

    def distance(
        self, surface: np.ndarray, origin: np.ndarray, direction: np.ndarray
    ) -> np.ndarray:
        """The distances (N,), m, along rays (N, 3) from a point (3,) to the planes of surfaces."""
        normal = self.surfaces.normal[surface]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = (self.surfaces.offset[surface] - normal @ origin) / (normal * direction).sum(1)
        return np.where(surface >= 0, found, np.inf)


@dataclass(frozen=True)
class Things:
    """The things in a map. Attributes: foot: (K, 3) m; material: (K,), of sprites; size: (K, 2),
    width and height in texels; left: (K,) texels from the left border to the foot; light: (K,)."""

    foot: np.ndarray
    material: np.ndarray
    size: np.ndarray
    left: np.ndarray
    light: np.ndarray

    def facing(self, eye: np.ndarray) -> Surfaces | None:
        """Upright pictures of the visible things, facing the eye."""
        away = self.foot[:, :2] - eye[:2]
        range_ = np.hypot(*away.T)
        seen = (range_ > 0.2) & (range_ < SIGHT)
        if not seen.any():
            return None
        away, foot = (away / range_[:, None])[seen], self.foot[seen]
        width, height = self.size[seen].T / METRE
        count, level = len(foot), np.zeros(len(foot))
        right = np.stack((away[:, 1], -away[:, 0], level), 1)
        lower = foot - right * (self.left[seen] / METRE)[:, None]
        up = np.stack((level, level, height), 1)
        a, b = lower, lower + right * width[:, None]
        c, d = b + up, a + up
        normal = np.stack((-away[:, 0], -away[:, 1], level), 1)
        down = np.array([0.0, 0.0, -METRE])
        return Surfaces(
            np.stack((np.stack((a, b, c), 1), np.stack((a, c, d), 1)), 1).reshape(-1, 3, 3),
            np.repeat(np.arange(count), 2),
            normal,
            (normal * foot).sum(1),
            np.column_stack((right * METRE, -(right * lower).sum(1) * METRE)),
            np.column_stack((np.tile(down, (count, 1)), METRE * d[:, 2])),
            self.material[seen],
            np.full(count, LABEL["object"]),
            self.light[seen],
            np.ones(count, bool),
        )


class Scene:
    """A map with its things, for casting rays."""

    def __init__(self, map: Map, textures: Textures):
        self._world = Body(surfaces_of(map, textures))
        self._sky = textures.number("wall", map.sky)
        self._things = self._place(map, textures)
        self._look: Sampler = textures.sampler()
        self._eye, self._sprites = None, None

    @property
    def surfaces(self) -> Surfaces:
        """All but the things."""
        return self._world.surfaces

    def cast(self, eye: np.ndarray, directions: np.ndarray) -> Hits:
        """The hits of rays from a point (3,), m, along unit vectors (N, 3)."""
        count = len(directions)
        hits = Hits(
            np.full(count, NOTHING, np.uint8),
            np.full(count, np.inf),
            np.zeros((count, 3), np.uint8),
            np.zeros(count),
            np.zeros((count, 3)),
        )
        bodies = [self._world, *self._facing(eye)]
        rays, passed = np.arange(count), np.zeros(count)
        for _ in range(LAYERS):
            way = directions[rays]
            origins = eye + passed[rays, None] * way
            surface = [body.first(origins, way) for body in bodies]
            distance = np.stack(
                [b.distance(s, eye, way) for b, s in zip(bodies, surface, strict=True)]
            )
            nearest = distance.argmin(0)
            again = []
            for k, body in enumerate(bodies):
                mine = (nearest == k) & (surface[k] >= 0)
                solid = self._meet(
                    hits,
                    body.surfaces,
                    rays[mine],
                    surface[k][mine],
                    distance[k][mine],
                    eye,
                    way[mine],
                )
                again.append(rays[mine][~solid])
                passed[again[-1]] = distance[k][mine][~solid] + PASSED
            rays = np.sort(np.concatenate(again))
            if not len(rays):
                break
        return hits

    def _meet(self, hits, surfaces, rays, surface, distance, eye, way) -> np.ndarray:
        """Records the hits of rays; True for rays that are not at a hole, (N,)."""
        point = np.column_stack((eye + distance[:, None] * way, np.ones(len(rays))))
        u, v = ((point * axis[surface]).sum(1) for axis in (surfaces.u, surfaces.v))
        texel = self._look(surfaces.material[surface], u, v)
        solid = ~surfaces.cut[surface] | (texel[:, 3] > 0)
        label, light = surfaces.label[surface], surfaces.light[surface]
        sky = label == LABEL["sky"]
        texel[sky] = self._sky_texels(way[sky])
        rays, sky = rays[solid], sky[solid]
        hits.label[rays] = label[solid]
        hits.distance[rays] = np.where(sky, np.inf, distance[solid])
        hits.colour[rays] = texel[solid, :3]
        hits.light[rays] = np.where(sky, 1.0, light[solid])
        hits.normal[rays] = surfaces.normal[surface][solid]
        return solid

    def _sky_texels(self, way: np.ndarray) -> np.ndarray:
        """The sky goes around four times, as in the game; its horizon is at row 100."""
        azimuth = np.arctan2(way[:, 1], way[:, 0])
        height = np.arcsin(np.clip(way[:, 2], -1, 1)) / (np.pi / 2)
        row = np.clip(100 - 100 * height, 0, 127)
        return self._look(np.full(len(way), self._sky), -azimuth * 512 / np.pi, row)

    def _facing(self, eye: np.ndarray) -> list[Body]:
        """The things as seen from an eye; the next call reuses them."""
        if self._eye is None or (self._eye != eye).any():
            found = self._things.facing(eye)
            self._eye, self._sprites = eye.copy(), [] if found is None else [Body(found)]
        return self._sprites

    def _place(self, map: Map, textures: Textures) -> Things:
        """The things of the game for one player at the middle skill, on their floors."""
        found, below = [], -40_000 / METRE
        for thing in map.things:
            name = SPRITES.get(int(thing["type"]))
            flags = int(thing["flags"])
            if name is None or not flags & MEDIUM or flags & MULTIPLAYER:
                continue
            # The picture of a thing without sides, or the picture of its front.
            name = next((n for n in (f"{name}A0", f"{name}A1") if textures.has("sprite", n)), None)
            if name is None:
                continue
            # The first hit from below is the floor.
            place = np.array([thing["x"] / METRE, thing["y"] / METRE, below])
            up = np.array([[0.0, 0.0, 1.0]])
            floor = self._world.first(place[None], up)
            if floor[0] < 0:
                continue
            place[2] += self._world.distance(floor, place, up)[0]
            material = textures.number("sprite", name)
            height, width = textures.size(material)
            left = textures.sprite_offset(name)[0]
            light = self._world.surfaces.light[floor[0]]
            found.append((place, material, (width, height), left, light))
        columns = zip(*found, strict=True) if found else ([], [], [], [], [])
        foot, material, size, left, light = map_arrays(columns)
        return Things(foot.reshape(-1, 3), material, size.reshape(-1, 2), left, light)


def map_arrays(columns) -> list[np.ndarray]:
    """Each column as an array."""
    return [np.array(list(column)) for column in columns]
