"""The pictures on surfaces: one array of the texels of all materials in use."""

import itertools
import struct

import numpy as np
from omg import WAD

from worlds.wad import text

GREY = "(none)"  # for a surface whose texture is missing


class Textures:
    """The materials of one WAD, made from its lumps when they are requested.

    A material is a wall's texture ("wall", NAME), a flat ("flat", NAME) or a sprite
    ("sprite", NAME); `number` gives its number.
    """

    def __init__(self, wad: WAD):
        self._wad = wad
        self._palette = np.frombuffer(wad.data["PLAYPAL"].data[:768], np.uint8).reshape(256, 3)
        self._definitions = _definitions(wad)
        self._numbers: dict[tuple[str, str], int] = {}
        self._pictures: list[np.ndarray] = []

    def number(self, kind: str, name: str) -> int:
        """The number of a material, or of plain grey if the WAD lacks the material."""
        key = kind, name
        if key not in self._numbers:
            self._numbers[key] = len(self._pictures)
            self._pictures.append(self._make(kind, name))
        return self._numbers[key]

    def size(self, number: int) -> tuple[int, int]:
        """The size (H, W) in texels."""
        return self._pictures[number].shape[:2]

    def picture(self, number: int) -> np.ndarray:
        """The picture (H, W, 4) uint8: sRGB, and opacity 0 or 255."""
        return self._pictures[number]

    def has(self, kind: str, name: str) -> bool:
        """True if the WAD has a material."""
        groups = {"wall": self._definitions, "flat": self._wad.flats, "sprite": self._wad.sprites}
        return name in groups[kind]

    def sprite_offset(self, name: str) -> tuple[int, int]:
        """The left and upper border of a sprite: texels left of its foot and above it."""
        x, y = self._wad.sprites[name].offsets
        return x, y

    def sampler(self) -> "Sampler":
        """A table of the texels of all materials requested so far."""
        return Sampler(self._pictures)

    def _make(self, kind: str, name: str) -> np.ndarray:
        if not self.has(kind, name):
            return np.full((64, 64, 4), (96, 96, 96, 255), np.uint8)
        if kind == "flat":
            index = np.frombuffer(self._wad.flats[name].data, np.uint8)[:4096].reshape(64, 64)
            return self._coloured(index.astype(np.int16))
        if kind == "sprite":
            return self._coloured(_indices(self._wad.sprites[name]))
        return self._wall(*self._definitions[name])

    def _wall(self, width: int, height: int, patches: list[tuple[int, int, str]]) -> np.ndarray:
        index = np.full((height, width), -1, np.int16)
        for x, y, name in patches:
            lump = self._wad.patches.get(name) or self._wad.graphics.get(name)
            if lump is None:
                continue
            patch = _indices(lump)
            rows = slice(max(y, 0), min(y + patch.shape[0], height))
            columns = slice(max(x, 0), min(x + patch.shape[1], width))
            part = patch[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]
            place = index[rows, columns]
            place[part >= 0] = part[part >= 0]
        return self._coloured(index)

    def _coloured(self, index: np.ndarray) -> np.ndarray:
        alpha = np.where(index >= 0, 255, 0).astype(np.uint8)
        return np.dstack((self._palette[np.maximum(index, 0)], alpha))


class Sampler:
    """A table of texels; it returns the nearest one, repeated in both directions."""

    def __init__(self, pictures: list[np.ndarray]):
        sizes = np.array([picture.shape[:2] for picture in pictures], np.int32)
        counts = sizes.prod(1)
        self._texels = np.concatenate([picture.reshape(-1, 4) for picture in pictures])
        self._start = np.concatenate(([0], np.cumsum(counts)[:-1])).astype(np.int32)
        self._height, self._width = sizes[:, 0], sizes[:, 1]

    def __call__(self, material: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The texels (N, 4) at u (right) and v (down), in texels, of materials (N,)."""
        width = self._width[material]
        column = np.floor(u).astype(np.int32) % width
        row = np.floor(v).astype(np.int32) % self._height[material]
        return self._texels[self._start[material] + row * width + column]


def _indices(lump: object) -> np.ndarray:
    """The palette indices of a graphic (H, W), -1 for transparent."""
    width, height = lump.dimensions
    pixels = [-1 if pixel is None else pixel for pixel in lump.to_pixels()]
    return np.array(pixels, np.int16).reshape(height, width)


def _definitions(wad: WAD) -> dict[str, tuple[int, int, list[tuple[int, int, str]]]]:
    """The textures of walls: width, height, and patches with their x and y."""
    names = wad.txdefs["PNAMES"].data
    patches = [text(names[k : k + 8]) for k in range(4, len(names), 8)]
    found = {}
    for lump in sorted(name for name in wad.txdefs if name.startswith("TEXTURE")):
        data = wad.txdefs[lump].data
        (count,) = struct.unpack_from("<i", data)
        for start in struct.unpack_from(f"<{count}i", data, 4):
            name, width, height, parts = struct.unpack_from("<8s4xhh4xh", data, start)
            places = itertools.islice(
                struct.iter_unpack("<hhh4x", data[start + 22 :][: 10 * parts]), parts
            )
            found.setdefault(
                text(name), (width, height, [(x, y, patches[k]) for x, y, k in places])
            )
    return found
