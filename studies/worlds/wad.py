"""The maps of the game's files (WADs), as arrays."""

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from omg import WAD

FOLDER = Path("/usr/share/games/doom")
WADS = ("freedoom1", "freedoom2")
METRE = 32.0  # map units; the player, 56 of them, is 1.75 m tall
NOBODY = 0xFFFF  # the sidedef of a side without one

_NAME = "S8"
_LINES = [(n, "<u2") for n in ("start", "end", "flags", "special", "tag", "front", "back")]
_SIDES = [("x", "<i2"), ("y", "<i2"), ("upper", _NAME), ("lower", _NAME), ("middle", _NAME)]
_SECTORS = [("floor", "<i2"), ("ceiling", "<i2"), ("floor_flat", _NAME), ("ceiling_flat", _NAME)]
_THINGS = [("x", "<i2"), ("y", "<i2"), ("angle", "<u2"), ("type", "<u2"), ("flags", "<u2")]


@dataclass(frozen=True)
class Map:
    """Attributes: vertices: (N, 2) map units; lines, sides, sectors, things: structured arrays, as
    the game has them: https://doomwiki.org/wiki/WAD; sky: the texture of its sky."""

    name: str
    vertices: np.ndarray
    lines: np.ndarray
    sides: np.ndarray
    sectors: np.ndarray
    things: np.ndarray
    sky: str


def text(name: bytes) -> str:
    """A name in a WAD: the text before the first zero byte, in capitals."""
    return name.split(b"\0")[0].decode("ascii", "replace").upper()


@cache
def open_wad(path: Path) -> WAD:
    """The WAD in a file; SystemExit with a message if the game is not installed."""
    if not path.is_file():
        raise SystemExit(f"{path} is missing: apt-get install freedoom")
    return WAD(str(path))


def read_map(wad: WAD, name: str, called: str) -> Map:
    """A map of a WAD; `called` is its name in data sets."""
    lumps = wad.maps[name]

    def records(lump: str, fields: list) -> np.ndarray:
        return np.frombuffer(lumps[lump].data, np.dtype(fields))

    vertices = np.frombuffer(lumps["VERTEXES"].data, "<i2").reshape(-1, 2)
    return Map(
        called,
        vertices.astype(np.float64),
        records("LINEDEFS", _LINES),
        records("SIDEDEFS", [*_SIDES, ("sector", "<u2")]),
        records("SECTORS", [*_SECTORS, ("light", "<i2"), ("special", "<u2"), ("tag", "<u2")]),
        records("THINGS", _THINGS),
        _sky(name),
    )


def _sky(name: str) -> str:
    """The sky of an episode (E2M3), or of a third of the second game (MAP14)."""
    if name.startswith("E"):
        return f"SKY{name[1]}"
    number = int(name[3:])
    return f"SKY{1 + (number > 11) + (number > 20)}"


def map_names(split: str | None = None, folder: Path = FOLDER) -> list[str]:
    """The maps of both games, or of a split, as "freedoom2-MAP07"."""
    names = [f"{wad}-{name}" for wad in WADS for name in open_wad(folder / f"{wad}.wad").maps]
    return sorted(name for name in names if split in (None, split_of(name)))


def split_of(name: str) -> str:
    """ "train", "val" or "test": 70, 10 and 20 % of the maps, by a hash of the name."""
    percent = int(hashlib.sha256(name.encode()).hexdigest(), 16) % 100
    return "test" if percent < 20 else "val" if percent < 30 else "train"


def load_map(name: str, folder: Path = FOLDER) -> tuple[WAD, Map]:
    """A map of `map_names`, and the WAD that has its textures."""
    file, lump = name.split("-")
    wad = open_wad(folder / f"{file}.wad")
    return wad, read_map(wad, lump, name)
