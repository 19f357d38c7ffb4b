"""Writes the views of random poses through one or more lenses, as folders that darswin reads."""

import json
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from darswin.lens import to_dict
from darswin.utils.files import replace_file
from worlds.geometry import CLASSES, COLORS
from worlds.lenses import draw_lens, is_one
from worlds.poses import poses_of
from worlds.render import View, rays_of, render
from worlds.scene import Scene
from worlds.textures import Textures
from worlds.wad import load_map, map_names

DISTANCE_UNIT = 256  # steps a metre in the PNGs of 16 bits
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Target:
    """A data set: its folder, and its lenses by a name of `draw_lens` and a field of view (rad)."""

    folder: str
    lenses: str
    fov: float = math.radians(165)


def write_map(name: str, split: str, targets: Sequence[Target], size: int, count: int, seed: int):
    """Writes the pictures of one map into `split` of each target; all see the same poses.

    A finished map is left as it is. Its `done/MAP.json` is written last and records its options.

    Raises:
        ValueError: the map was made with other options.
    """
    made = {
        # Only a file's name, so that a data set stays valid if the file's folder moves.
        t: dict(lenses=Path(t.lenses).name, fov=t.fov, size=size, count=count, seed=seed)
        for t in targets
    }
    open_targets = [t for t in targets if not is_done(_done(t, split, name), made[t])]
    if not open_targets:
        return {}
    wad, world = load_map(name)
    scene = Scene(world, Textures(wad))
    poses = poses_of(scene, name, count, seed)
    for target in open_targets:
        folder = Path(target.folder) / split
        for kind in ("images", "labels", "distance", "done", *_lens_folder(target)):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        rays = None
        for k, pose in enumerate(poses):
            stem = f"{name}-{k:03d}"
            if rays is None or not is_one(target.lenses):
                key = zlib.crc32(f"{target.lenses} {stem}".encode())
                rng = np.random.default_rng([seed, key])
                lens = draw_lens(target.lenses, size, target.fov, rng)
                file = f"lenses/{stem}.json" if _lens_folder(target) else "lens.json"
                (folder / file).write_text(json.dumps(to_dict(lens), allow_nan=False) + "\n")
                rays = rays_of(lens)
            write_view(render(scene, pose, rays), folder, stem)
        replace_file(_done(target, split, name), json.dumps(made[target]) + "\n")
    return {}


def write_view(view: View, folder: Path, stem: str) -> None:
    """Writes `images/`, `labels/` and `distance/STEM.png`; distances above 255 m are unknown."""
    steps = np.round(view.distance * DISTANCE_UNIT)
    distance = np.where(steps < 2**16, steps, 0).astype(np.uint16)
    pictures = dict(images=view.image[..., ::-1], labels=view.labels, distance=distance)
    for kind, picture in pictures.items():
        _, data = cv2.imencode(".png", picture)
        (folder / kind / f"{stem}.png").write_bytes(data)


def jobs_of(
    targets: Sequence[Target], split: str, pictures: int, size: int, seed: int
) -> list[tuple]:
    """The arguments of `write_map` for the pictures of a split, spread evenly over its maps; also
    writes the targets' classes.json."""
    for target in targets:
        Path(target.folder).mkdir(parents=True, exist_ok=True)
        classes = dict(names=CLASSES, colors=COLORS)
        replace_file(Path(target.folder) / "classes.json", json.dumps(classes) + "\n")
    return [(name, split, targets, size, count, seed) for name, count in shares(split, pictures)]


def shares(split: str, pictures: int) -> list[tuple[str, int]]:
    """The maps of a split that show a number of pictures, and how many of them each shows."""
    names = map_names(split)
    counts = [len(part) for part in np.array_split(np.arange(pictures), len(names))]
    return [(name, count) for name, count in zip(names, counts, strict=True) if count]


def _lens_folder(target: Target) -> tuple[str, ...]:
    return () if is_one(target.lenses) else ("lenses",)


def _done(target: Target, split: str, name: str) -> Path:
    return Path(target.folder) / split / "done" / f"{name}.json"


def is_done(file: Path, made: dict) -> bool:
    """True if `file` says that a map was made with these options; ValueError if with others."""
    if not file.exists():
        return False
    before = json.loads(file.read_text())
    if before != made:
        raise ValueError(f"{file} was made with {before}, not {made}: remove its folder")
    return True
