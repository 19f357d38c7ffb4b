"""What one would say without looking at the picture: the baselines that a model must beat.

- "zone": the most frequent class of a zone of θ, or its median distance;
- "direction": the same of a direction in the camera's frame, of 9 zones of θ times 16 sectors of
  azimuth. The cameras are nearly upright: below is floor, above is ceiling.

Both are found on the training pictures of "low", with the true lens, and tested with it.
"""

import itertools
import json
import math
from collections.abc import Iterator
from pathlib import Path

import dense_data
import numpy as np
import torch

from darswin.data.scenes import IGNORE, open_scenes
from darswin.lens.pixels import pixel_rays
from darswin.train.pixel_metrics import DistanceSums, LabelSums, distance_scores, label_scores
from darswin.utils.files import replace_file

RINGS, SECTORS = 9, 16  # of 10° and 22.5°; what is further out is of the last ring
TRAINED_ON = "low"
NEVER = -1.0  # of a direction that no training picture has


def trivial(out: Path) -> dict:
    """The baselines' scores on all test sets, {task: {baseline: {set: scores}}}; kept in a file."""
    file = out / "trivial.json"
    if file.exists():
        return json.loads(file.read_text())
    data = out / "data"
    found: dict[str, dict] = {}
    for task, target in (("segmentation", "labels"), ("distance", "distance")):
        pictures = list(_pictures(data / "train" / TRAINED_ON, "train", target))
        found[task] = {}
        for name, sectors in (("zone", 1), ("direction", SECTORS)):
            said = _table(pictures, sectors, task)
            found[task][name] = {
                folder: _tested(data / "test" / folder, target, said, sectors)
                for folder in dense_data.test_sets()
                if not folder.startswith(("wrong", dense_data.SHUFFLED))
            }
    replace_file(file, json.dumps(found, indent=1))
    return found


def _pictures(path: Path, split: str, target: str) -> Iterator[tuple[np.ndarray, ...]]:
    """The targets of known pixels, (P,), and the ring and the sector that they are in."""
    for scene in open_scenes(str(path), split, target):
        theta, way = (r[0].numpy() for r in pixel_rays(scene.lens, scene.target.shape))
        azimuth = np.arctan2(way[..., 1], way[..., 0])
        known = ~np.isnan(theta)
        known &= (scene.target != IGNORE) if target == "labels" else (scene.target > 0)
        ring = np.minimum(np.degrees(theta[known]) // 10, RINGS - 1).astype(int)
        sector = np.floor((azimuth[known] / (2 * math.pi) + 0.5) * SECTORS).astype(int) % SECTORS
        yield scene.target[known], ring, sector


def _cells(ring: np.ndarray, sector: np.ndarray, sectors: int) -> np.ndarray:
    return ring * sectors + (sector if sectors > 1 else 0)


def _table(pictures: list[tuple[np.ndarray, ...]], sectors: int, task: str) -> np.ndarray:
    """What is said in each cell, (RINGS · sectors,): a class, or metres."""
    target = np.concatenate([p[0] for p in pictures])
    cell = np.concatenate([_cells(*p[1:], sectors) for p in pictures])
    order = np.argsort(cell, kind="stable")
    ends = np.searchsorted(cell[order], np.arange(RINGS * sectors + 1))
    parts = [target[order[a:b]] for a, b in itertools.pairwise(ends)]
    said = np.full(RINGS * sectors, NEVER)
    for k, part in enumerate(parts):
        if len(part):
            said[k] = np.bincount(part).argmax() if task == "segmentation" else np.median(part)
    for k in range(sectors, len(said)):  # further out than training: as the ring before
        said[k] = said[k - sectors] if said[k] == NEVER else said[k]
    return said


def _tested(path: Path, target: str, said: np.ndarray, sectors: int) -> dict[str, float]:
    """The scores of a table on a test set."""
    sums = DistanceSums(1)
    if target == "labels":
        sums = LabelSums(len(dense_data.classes(path.parent.parent)), 1)
    for truth, ring, sector in _pictures(path, "test", target):
        answer = torch.from_numpy(said[_cells(ring, sector, sectors)])
        zone = torch.zeros(len(truth), dtype=torch.int64)
        if target == "labels":
            answer = answer.long()
        sums.update(answer, torch.from_numpy(truth.astype(answer.numpy().dtype)), zone, zone + 1.0)
    counts = sums.compute()[0][0]
    scores = label_scores(counts)[0] if target == "labels" else distance_scores(counts)
    return {name: round(value, 5) for name, value in scores.items()}
