"""Baselines that ignore the picture; a model must beat them.

- "zone": the most frequent class of a zone of θ, or its median distance;
- "direction": the same for a direction in the camera's frame, one of 9 zones of θ times 16 sectors
  of azimuth. The cameras are nearly upright: the floor is below, and the ceiling is above.

Both are computed from some of the training pictures of "low", and training and tests use the true
lens.
"""

import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path

import dense_data
import numpy as np
import torch

from darswin.data import IGNORE, open_scenes
from darswin.lens.pixels import pixel_rays
from darswin.train.distance import DistanceSums
from darswin.train.segmentation import LabelSums
from darswin.utils.files import replace_file

RINGS, SECTORS = 9, 16  # of 10° and 22.5°; the last ring has all that is further out
BASELINES = {"zone": 1, "direction": SECTORS}  # sectors
TARGETS = {"segmentation": "labels", "distance": "distance"}
LEARNED_FROM = 300  # training pictures


def trivial(out: Path) -> dict:
    """The scores of the baselines, {task: {baseline: {set: scores}}}; a file keeps them."""
    file = out / "trivial.json"
    if file.exists():
        return json.loads(file.read_text())
    data = out / "data"
    sets = [name for name in dense_data.test_sets() if not is_control(name)]
    found: dict[str, dict] = {}
    for task, target in TARGETS.items():
        trained = data / "train" / dense_data.TRAINED_ON
        seen = list(_pictures(trained, "train", target, LEARNED_FROM))
        said = {name: _table(seen, sectors, task) for name, sectors in BASELINES.items()}
        found[task] = {name: {} for name in BASELINES}
        for folder in sets:
            tested = list(_pictures(data / "test" / folder, "test", target))
            for name, sectors in BASELINES.items():
                found[task][name][folder] = _scores(tested, said[name], sectors, task, data)
    replace_file(file, json.dumps(found, indent=1, allow_nan=False))
    return found


def is_control(name: str) -> bool:
    return name.startswith(("wrong", dense_data.SHUFFLED))


def _pictures(
    path: Path, split: str, target: str, limit: int | None = None
) -> Iterator[tuple[np.ndarray, ...]]:
    """The targets of the known pixels, (P,), with their rings and sectors."""
    scenes = open_scenes(str(path), split, target)
    lens = None
    count = min(len(scenes), limit or len(scenes))
    for k in np.arange(count) * len(scenes) // count:  # spread over all maps
        scene = scenes[k]
        if scene.lens is not lens:  # most sets have only one lens
            lens = scene.lens
            theta, way = (rays[0].numpy() for rays in pixel_rays(lens, scene.target.shape))
            azimuth = np.arctan2(way[..., 1], way[..., 0])
            sector = np.floor((azimuth / (2 * math.pi) + 0.5) * SECTORS) % SECTORS
            ring = np.minimum(np.degrees(theta) // 10, RINGS - 1)
        known = (scene.target != IGNORE) if target == "labels" else (scene.target > 0)
        known &= ~np.isnan(theta)
        yield scene.target[known], ring[known].astype(int), sector[known].astype(int)


def _cells(ring: np.ndarray, sector: np.ndarray, sectors: int) -> np.ndarray:
    return ring * sectors + (sector if sectors > 1 else 0)


def _table(pictures: list[tuple[np.ndarray, ...]], sectors: int, task: str) -> np.ndarray:
    """The answer for each cell, (RINGS · sectors,): a class, or metres."""
    target = np.concatenate([p[0] for p in pictures])
    cell = np.concatenate([_cells(*p[1:], sectors) for p in pictures])
    order = np.argsort(cell, kind="stable")
    ends = np.searchsorted(cell[order], np.arange(RINGS * sectors + 1))
    usual = (lambda part: np.bincount(part).argmax()) if task == "segmentation" else np.median
    said = np.full(RINGS * sectors, float(usual(target)))
    for k, (a, b) in enumerate(itertools.pairwise(ends)):
        if b > a:
            said[k] = usual(target[order[a:b]])
        elif k >= sectors:  # further out than in training: as the ring before
            said[k] = said[k - sectors]
    return said


def _scores(
    pictures: list[tuple[np.ndarray, ...]], said: np.ndarray, sectors: int, task: str, data: Path
) -> dict[str, float]:
    """The scores of a table on a test set."""
    of_labels = task == "segmentation"
    sums = LabelSums(len(dense_data.classes(data)), 1) if of_labels else DistanceSums(1)
    kind = torch.int64 if of_labels else torch.float64
    for truth, ring, sector in pictures:
        answer = torch.from_numpy(said[_cells(ring, sector, sectors)]).to(kind)
        zone = torch.zeros(len(truth), dtype=torch.int64)
        sums.update(answer, torch.from_numpy(truth).to(kind), zone, zone.double())
    scores = sums.scores(sums.compute()[0][0])
    return {name: round(value, 5) for name, value in scores.items()}
