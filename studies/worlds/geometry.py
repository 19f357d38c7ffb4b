"""A map as surfaces: planes with a texture, a light and a label, and triangles of them in metres.

x points east, y north, z up.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from worlds.textures import Textures
from worlds.wad import METRE, NOBODY, Map, text

CLASSES = ("floor", "ceiling", "wall", "step", "door", "liquid", "sky", "object")
COLORS = (
    (128, 96, 64), (160, 160, 176), (200, 170, 120), (230, 140, 30),
    (180, 40, 60), (60, 200, 90), (110, 170, 240), (230, 60, 220),
)  # fmt: skip
LABEL = {name: k for k, name in enumerate(CLASSES)}

SKY_FLAT = "F_SKY1"
LIQUIDS = ("NUKAGE", "FWATER", "SWATER", "LAVA", "BLOOD", *(f"SLIME0{k}" for k in range(1, 9)))
STEP = 24  # map units, the highest step that the player climbs without jumping

# Textures that show a door; other textures with DOOR in their names are door frames.
DOORS = ("BIGDOOR", "DOOR1", "DOOR3", "EXITDOOR", "SPCDOOR", "WOODDOOR")

# Flags of lines.
TWO_SIDED, UPPER_UNPEGGED, LOWER_UNPEGGED = 0x04, 0x08, 0x10
# Specials of lines that open a door: the line's own back sector, or all of its tag.
OWN_DOORS = (1, 26, 27, 28, 31, 32, 33, 34, 117, 118)
TAGGED_DOORS = (
    2, 3, 4, 16, 29, 42, 46, 50, 61, 63, 75, 76, 86, 90, 99, 103, 105, 106, 107, 108, 109, 110, 111,
    112, 113, 114, 115, 116, 133, 134, 135, 136, 137,
)  # fmt: skip


@dataclass(frozen=True)
class Surfaces:
    """Planes, and the triangles on them.

    Attributes: triangles: (T, 3, 3) m; surface: (T,), the plane of each; normal (S, 3) and offset
    (S,): of points p with normal · p = offset; u, v: (S, 4), texels, as (p, 1) · u; material,
    label: (S,); light: (S,) in 0..1; cut: (S,), whether texels without anything are holes.
    """

    triangles: np.ndarray
    surface: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    u: np.ndarray
    v: np.ndarray
    material: np.ndarray
    label: np.ndarray
    light: np.ndarray
    cut: np.ndarray


@dataclass
class Surface:
    """One plane: points (T, 3, 3) of its triangles in map units; other fields as in `Surfaces`."""

    triangles: np.ndarray
    normal: np.ndarray
    u: tuple[float, float, float, float]  # texels from map units
    v: tuple[float, float, float, float]
    material: int
    label: int
    light: float
    cut: bool = False


def join(found: Sequence[Surface]) -> Surfaces:
    """All surfaces together, in metres."""
    scale = np.array([METRE, METRE, METRE, 1])
    normal = np.array([s.normal for s in found])
    triangles = np.concatenate([s.triangles for s in found]) / METRE
    first = np.array([s.triangles[0, 0] for s in found]) / METRE
    surface = np.repeat(np.arange(len(found)), [len(s.triangles) for s in found])
    columns = {
        name: np.array([getattr(s, name) for s in found])
        for name in ("u", "v", "material", "label", "light", "cut")
    }
    columns["u"], columns["v"] = columns["u"] * scale, columns["v"] * scale
    return Surfaces(triangles, surface, normal, (normal * first).sum(1), **columns)


def surfaces_of(map: Map, textures: Textures) -> Surfaces:
    """All static surfaces of a map, with closed doors as at the start."""
    return join([*_flats(map, textures), *_walls(map, textures)])


# -- floors and ceilings ----------------------------------------------------------------------


def _flats(map: Map, textures: Textures) -> Iterator[Surface]:
    for number, outline in enumerate(outlines(map)):
        sector = map.sectors[number]
        if sector["ceiling"] <= sector["floor"] or not len(outline):
            continue
        flat = triangulate(outline)
        for side, up in (("floor", 1.0), ("ceiling", -1.0)):
            name = text(sector[f"{side}_flat"])
            label = "liquid" if side == "floor" and name.startswith(LIQUIDS) else side
            label = "sky" if name == SKY_FLAT else label
            heights = np.full((*flat.shape[:2], 1), float(sector[side]))
            if len(flat):
                yield Surface(
                    np.concatenate((flat, heights), -1),
                    np.array([0.0, 0.0, up]),
                    (1, 0, 0, 0),
                    (0, -1, 0, 0),
                    textures.number("flat", name),
                    LABEL[label],
                    sector["light"] / 255,
                )


def outlines(map: Map) -> list[np.ndarray]:
    """The borders of each sector, (N, 2, 2): lines with the sector on one side only."""
    front = map.sides["sector"][map.lines["front"]]
    has_back = map.lines["back"] != NOBODY
    back = np.where(has_back, map.sides["sector"][np.where(has_back, map.lines["back"], 0)], NOBODY)
    ends = np.stack((map.vertices[map.lines["start"]], map.vertices[map.lines["end"]]), 1)
    border = front != back
    return [ends[border & ((front == k) | (back == k))] for k in range(len(map.sectors))]


def triangulate(outline: np.ndarray) -> np.ndarray:
    """The triangles (T, 3, 2) inside closed polygons (N, 2, 2), with holes and islands.

    The inside is cut into trapezoids at the height of each corner; inside and outside alternate
    along each slab. Some maps have open outlines: these spoil only their own slabs.
    """
    low_first = outline[:, 0, 1] <= outline[:, 1, 1]
    low = np.where(low_first[:, None], outline[:, 0], outline[:, 1])
    high = np.where(low_first[:, None], outline[:, 1], outline[:, 0])
    low, high = low[low[:, 1] < high[:, 1]], high[low[:, 1] < high[:, 1]]
    slope = (high[:, 0] - low[:, 0]) / (high[:, 1] - low[:, 1])
    levels, made = np.unique(np.concatenate((low[:, 1], high[:, 1]))), []
    for bottom, top in itertools.pairwise(levels):
        across = (low[:, 1] <= bottom) & (high[:, 1] >= top)
        at = (np.array([[bottom], [top]]) - low[across, 1]) * slope[across] + low[across, 0]
        at = at[:, np.argsort(at.sum(0), kind="stable")]
        for k in range(0, at.shape[1] - 1, 2):
            (a, b), (d, c) = at[:, k : k + 2]
            corners = np.array([[a, bottom], [b, bottom], [c, top], [d, top]])
            made += [corners[[0, 1, 2]]] if b > a else []
            made += [corners[[0, 2, 3]]] if c > d else []
    return np.array(made).reshape(-1, 3, 2)


# -- walls ------------------------------------------------------------------------------------


def door_sectors(map: Map) -> set[int]:
    """The sectors that are closed doors."""
    lines, has_back = map.lines, map.lines["back"] != NOBODY
    own = lines["back"][has_back & np.isin(lines["special"], OWN_DOORS)]
    tags = set(lines["tag"][np.isin(lines["special"], TAGGED_DOORS)].tolist()) - {0}
    closed = map.sectors["ceiling"] <= map.sectors["floor"]
    doors = set(map.sides["sector"][own].tolist())
    doors |= {k for k, tag in enumerate(map.sectors["tag"].tolist()) if tag in tags}
    return {k for k in doors if closed[k]}


def _walls(map: Map, textures: Textures) -> Iterator[Surface]:
    doors = door_sectors(map)
    for line in map.lines:
        start, end = map.vertices[line["start"]], map.vertices[line["end"]]
        if (start == end).all():
            continue
        front = map.sides[line["front"]]
        if line["back"] == NOBODY:
            yield from _Side(map, textures, line, start, end, front).one_sided()
            continue
        back = map.sides[line["back"]]
        one = _Side(map, textures, line, start, end, front, back)
        other = _Side(map, textures, line, end, start, back, front)
        yield from one.two_sided(doors)
        yield from other.two_sided(doors)
        # Only one of the two, because both are at the same place.
        yield from (one if text(front["middle"]) != "-" else other).grating()


class _Side:
    """One side of a line, from `start` on its left to `end` on its right."""

    def __init__(self, map: Map, textures: Textures, line, start, end, side, beyond=None):
        self.textures, self.line, self.side, self.beyond = textures, line, side, beyond
        self.start, self.end, self.length = start, end, float(np.hypot(*(end - start)))
        self.sector = map.sectors[side["sector"]]
        self.floor, self.ceiling = int(self.sector["floor"]), int(self.sector["ceiling"])
        if beyond is not None:
            self.other = map.sectors[beyond["sector"]]
            self.other_floor, self.other_ceiling = (
                int(self.other["floor"]),
                int(self.other["ceiling"]),
            )

    def one_sided(self) -> Iterator[Surface]:
        """A wall from floor to ceiling."""
        name = text(self.side["middle"])
        material, height = self._material("middle")
        top = self.floor + height if self.line["flags"] & LOWER_UNPEGGED else self.ceiling
        label = "door" if name.startswith(DOORS) else "wall"
        yield from self._quad(self.floor, self.ceiling, top, material, label)

    def two_sided(self, doors: set[int]) -> Iterator[Surface]:
        """The steps to a higher floor or a lower ceiling beyond the line."""
        flags = self.line["flags"]
        if self.other_floor > self.floor:
            top = self.ceiling if flags & LOWER_UNPEGGED else self.other_floor
            high, rise = min(self.other_floor, self.ceiling), self.other_floor - self.floor
            label = "step" if rise <= STEP else "wall"
            yield from self._quad(self.floor, high, top, self._material("lower")[0], label)
        if self.other_ceiling < self.ceiling:
            low = max(self.other_ceiling, self.floor)
            skies = {text(self.sector["ceiling_flat"]), text(self.other["ceiling_flat"])}
            if skies == {SKY_FLAT}:  # nothing is drawn between two skies
                material = self.textures.number("flat", SKY_FLAT)
                yield from self._quad(low, self.ceiling, self.ceiling, material, "sky")
                return
            material, height = self._material("upper")
            top = self.ceiling if flags & UPPER_UNPEGGED else self.other_ceiling + height
            door = int(self.beyond["sector"]) in doors
            yield from self._quad(low, self.ceiling, top, material, "door" if door else "wall")

    def grating(self) -> Iterator[Surface]:
        """The texture in the middle of an opening, with holes, not repeated upwards."""
        name = text(self.side["middle"])
        if name == "-" or not self.textures.has("wall", name):
            return
        material = self.textures.number("wall", name)
        height, shift = self.textures.size(material)[0], int(self.side["y"])
        floor = max(self.floor, self.other_floor)
        ceiling = min(self.ceiling, self.other_ceiling)
        top = floor + height if self.line["flags"] & LOWER_UNPEGGED else ceiling
        low, high = max(floor, top + shift - height), min(ceiling, top + shift)
        yield from self._quad(low, high, top, material, "wall", cut=True)

    def _material(self, part: str) -> tuple[int, int]:
        """The material and the height of a part, or of another part if it has none."""
        parts = [self.side[name] for name in (part, "upper", "lower", "middle")]
        if self.beyond is not None:
            parts += [self.beyond[name] for name in ("lower", "upper")]
        names = [name for name in map(text, parts) if name != "-"]
        number = self.textures.number("wall", names[0] if names else "-")
        return number, self.textures.size(number)[0]

    def _quad(self, low, high, top, material, label, cut=False) -> Iterator[Surface]:
        """A wall from `low` to `high`; its texture begins at the height `top`."""
        if high <= low:
            return
        a, b, c, d = (
            np.array([*end, z])
            for end, z in ((self.start, low), (self.end, low), (self.end, high), (self.start, high))
        )
        along = (self.end - self.start) / self.length
        # As in the game, walls along x are a little darker and walls along y a little lighter.
        contrast = 16 * (float(along[0] == 0) - float(along[1] == 0))
        u0 = float(self.side["x"]) - float(along @ self.start)
        yield Surface(
            np.array([[a, b, c], [a, c, d]]),
            np.array([along[1], -along[0], 0.0]),
            (along[0], along[1], 0, u0),
            (0, 0, -1, top + float(self.side["y"])),
            material,
            LABEL[label],
            (self.sector["light"] + contrast) / 255,
            cut,
        )
