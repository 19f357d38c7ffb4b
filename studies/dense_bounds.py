"""Upper bounds for distances: medians that know more than the direction in the camera's frame.

- "gravity": the median distance of an elevation above the horizon;
- "labels": the median of an elevation and a class, with the true class of each pixel;
- "heights": as "labels", but floors and ceilings are planes at the true heights below and above the
  camera.

None of them sees the picture, and a model must find out all that they know. They are computed from
the first pictures of each training map of "low".
"""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import dense_data
import numpy as np
import torch
from dense_trivial import is_control
from worlds.geometry import LABEL
from worlds.poses import poses_of
from worlds.scene import Scene
from worlds.textures import Textures
from worlds.wad import load_map, map_names

from darswin.data import open_scenes
from darswin.lens.pixels import pixel_rays
from darswin.lens.solve import vector_of
from darswin.train.distance import DistanceSums
from darswin.utils.files import replace_file

BOUNDS = ("gravity", "labels", "heights")
BINS = 90  # of elevation, 2° each
LEARNED_FROM = 6  # pictures of each training map
SEED = 0  # of the pictures


class Eye(NamedTuple):
    """The rotation of a camera, (3, 3), and its heights in m above the floor and below the ceiling,
    infinite below the sky."""

    rotation: np.ndarray
    above: float
    below: float


def bounds(out: Path) -> dict[str, dict]:
    """The scores of the bounds, {bound: {set: scores}}; a file keeps them."""
    file = out / "bounds.json"
    if file.exists():
        return json.loads(file.read_text())
    data = out / "data"
    sets = [name for name in dense_data.test_sets() if not is_control(name)]
    learned = _pictures(data / "train" / dense_data.TRAINED_ON, "train", LEARNED_FROM)
    truth, elevation, label, _ = (np.concatenate(part) for part in zip(*learned, strict=True))
    tables = {
        "gravity": _medians(truth, _bin(elevation), BINS),
        "labels": _medians(truth, _cell(elevation, label), BINS * len(LABEL)),
    }
    found: dict[str, dict] = {name: {} for name in BOUNDS}
    for name in sets:
        sums = {bound: DistanceSums(1) for bound in BOUNDS}
        for truth, elevation, label, plane in _pictures(data / "test" / name, "test"):
            of_label = tables["labels"][_cell(elevation, label)]
            said = {
                "gravity": tables["gravity"][_bin(elevation)],
                "labels": of_label,
                "heights": np.where(np.isfinite(plane), plane, of_label),
            }
            zone = torch.zeros(len(truth), dtype=torch.int64)
            for bound, distance in said.items():
                pair = torch.from_numpy(distance), torch.from_numpy(truth)
                sums[bound].update(*pair, zone, zone.double())
        for bound, summed in sums.items():
            scores = summed.scores(summed.compute()[0][0])
            found[bound][name] = {key: round(value, 5) for key, value in scores.items()}
    replace_file(file, json.dumps(found, indent=1, allow_nan=False))
    return found


def _bin(elevation: np.ndarray) -> np.ndarray:
    return np.minimum((elevation / np.pi + 0.5) * BINS, BINS - 1).astype(int)


def _cell(elevation: np.ndarray, label: np.ndarray) -> np.ndarray:
    return _bin(elevation) * len(LABEL) + label


def _medians(truth: np.ndarray, cell: np.ndarray, count: int) -> np.ndarray:
    """The median distance of each cell, (count,); that of all pixels for an empty cell."""
    order = np.argsort(cell, kind="stable")
    parts = np.split(truth[order], np.searchsorted(cell[order], np.arange(1, count)))
    return np.array([np.median(part if len(part) else truth) for part in parts])


def _pictures(
    folder: Path, split: str, of_each_map: int | None = None
) -> Iterator[tuple[np.ndarray, ...]]:
    """Of the pixels of known distance of each picture: the distance, the elevation (rad), the class
    and the distance of the plane of a floor or a ceiling, infinite for other classes."""
    scenes = open_scenes(str(folder), split, "distance")
    files = [Path(scenes.file(k)) for k in range(len(scenes))]
    for name in map_names(split):
        mine = [k for k, file in enumerate(files) if file.stem.rpartition("-")[0] == name]
        mine = mine[:of_each_map]
        if not mine:
            continue
        for k, eye in zip(mine, eyes(name, len(mine)), strict=True):
            scene = scenes[k]
            theta, direction = pixel_rays(scene.lens, scene.target.shape)
            rays = vector_of(theta, direction)[0].numpy()
            label = cv2.imread(str(folder / split / "labels" / files[k].name), cv2.IMREAD_GRAYSCALE)
            known = (scene.target > 0) & ~np.isnan(rays[..., 2]) & (label < len(LABEL))
            label = label[known].astype(int)
            up = (rays[known] @ eye.rotation.T)[:, 2].clip(-1, 1)
            height = np.full(len(up), math.inf)
            height[(label == LABEL["floor"]) & (up < 0)] = eye.above
            height[(label == LABEL["ceiling"]) & (up > 0)] = eye.below
            plane = height / np.maximum(np.abs(up), 1e-6)
            yield scene.target[known].astype(np.float64), np.arcsin(up), label, plane


def eyes(name: str, count: int) -> list[Eye]:
    """The first `count` cameras of a map, as `write_map` places them."""
    wad, world = load_map(name)
    scene = Scene(world, Textures(wad))
    vertical = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    return [
        Eye(pose.rotation, *scene.cast(pose.position, vertical).distance)
        for pose in poses_of(scene, name, count, SEED)
    ]
