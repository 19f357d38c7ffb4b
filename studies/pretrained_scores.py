"""Scores of detections in the pretrained study: average precision, recall and their intervals."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pretrained_methods import SURE, Found
from pretrained_scenes import COCO, Thing

from darswin import boxes

OVERLAP = 0.5  # the least IoU of a hit
DRAWS = 1000  # resamples of the scenes
ZONES = (0, 30), (30, 50), (50, 70), (70, 85)  # of θ, degrees


@dataclass
class Rows:
    """The detections of all scenes, best first, and the things of all scenes."""

    scene: np.ndarray  # (K,), the scene of each detection
    score: np.ndarray  # (K,)
    label: np.ndarray  # (K,)
    hit: np.ndarray  # (K,), bool
    sure: np.ndarray  # (K,), bool: the score is high
    thing_scene: np.ndarray  # (T,)
    thing_label: np.ndarray  # (T,)
    thing_found: np.ndarray  # (T,), bool, by a detection with a high score


def match(found: Found, things: Sequence[Thing]) -> tuple[np.ndarray, np.ndarray]:
    """The order of the detections, best first, and for each the thing that it hits, or -1.

    From the best down, a detection hits the thing of its class with the largest IoU among those
    that no better one hit.
    """
    order = np.argsort(-found.scores, kind="stable")
    hits = np.full(len(order), -1)
    truth = np.array([thing.box for thing in things], float).reshape(-1, 4)
    labels = np.array([COCO.index(thing.label) for thing in things])
    overlaps = boxes.iou(found.boxes[order].astype(float), truth)
    free = np.ones(len(things), bool)
    for row, (overlap, label) in enumerate(zip(overlaps, found.labels[order], strict=True)):
        overlap = np.where(free & (labels == label), overlap, 0)
        if overlap.max(initial=0) >= OVERLAP:
            hits[row] = overlap.argmax()
            free[hits[row]] = False
    return order, hits


def rows_of(found: Sequence[Found], things: Sequence[Sequence[Thing]]) -> Rows:
    """The detections of scenes and the things in them."""
    parts, thing_found = [], []
    for number, (of_scene, in_scene) in enumerate(zip(found, things, strict=True)):
        order, hits = match(of_scene, in_scene)
        scores = of_scene.scores[order]
        parts.append((np.full(len(order), number), scores, of_scene.labels[order], hits >= 0))
        sure_hits = set(hits[scores >= SURE].tolist())
        thing_found += [k in sure_hits for k in range(len(in_scene))]
    scene, score, label, hit = (np.concatenate(of) for of in zip(*parts, strict=True))
    order = np.argsort(-score, kind="stable")
    return Rows(
        scene[order], score[order], label[order], hit[order], score[order] >= SURE,
        np.repeat(np.arange(len(things)), [len(of) for of in things]),
        np.array([COCO.index(thing.label) for of in things for thing in of], int),
        np.array(thing_found, bool),
    )  # fmt: skip


def average_precision(hits: np.ndarray, weights: np.ndarray, things: float) -> float:
    """The exact area under the interpolated precision of detections (K,), best first.

    Each detection counts `weights` times, and there are `things` to find.
    """
    true = np.cumsum(weights * hits)
    precision = true / np.maximum(np.cumsum(weights), 1e-12)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(weights * hits * precision) / things)


def scores(rows: Rows, weights: np.ndarray) -> dict[str, float]:
    """mAP, recall, precision and false positives in an image, where scene k counts weights[k]
    times."""
    of_row, of_thing = weights[rows.scene], weights[rows.thing_scene]
    means = []
    for label in np.unique(rows.thing_label):
        things = of_thing[rows.thing_label == label].sum()
        if things:
            own = rows.label == label
            means.append(average_precision(rows.hit[own], of_row[own], things))
    sure = of_row * rows.sure
    return dict(
        map=float(np.mean(means)) if means else 0.0,
        recall=float((of_thing * rows.thing_found).sum() / max(of_thing.sum(), 1e-12)),
        precision=float((sure * rows.hit).sum() / max(sure.sum(), 1e-12)),
        false=float((sure * ~rows.hit).sum() / weights.sum()),
    )


def drawn_weights(scenes: int) -> np.ndarray:
    """How often each scene is in each resample, (DRAWS, scenes): the same for all methods."""
    rng = np.random.default_rng(0)
    return np.stack([
        np.bincount(rng.integers(scenes, size=scenes), minlength=scenes) for _ in range(DRAWS)
    ])  # fmt: skip


def interval(values: np.ndarray) -> list[float]:
    """The middle 95 % of resamples."""
    return [round(float(end), 4) for end in np.quantile(values, (0.025, 0.975))]


class Resampled:
    """The scores of a method, also for every resample of the scenes."""

    def __init__(self, rows: Rows, draws: np.ndarray) -> None:
        self.rows = rows
        self.whole = scores(rows, np.ones(draws.shape[1]))
        drawn = [scores(rows, weights) for weights in draws]
        self.drawn = {name: np.array([of[name] for of in drawn]) for name in ("map", "recall")}

    def summary(self, things: Sequence[Thing], found_flat: np.ndarray | None) -> dict:
        """What the record keeps: scores, intervals, and recalls by zone.

        `found_flat` says which things the network finds in flat pictures of their own. Then the
        ratio of the two counts, and the share of these things that are found, are kept too.
        """
        kept: dict = {name: round(value, 4) for name, value in self.whole.items()}
        kept |= {f"{name}_interval": interval(values) for name, values in self.drawn.items()}
        theta = np.array([thing.theta_deg for thing in things])
        kept["zones"] = [
            round(float(self.rows.thing_found[(theta >= low) & (theta < high)].mean()), 4)
            if ((theta >= low) & (theta < high)).any() else None
            for low, high in ZONES
        ]  # fmt: skip
        if found_flat is not None:
            own = self.rows.thing_found
            flat = max(found_flat.sum(), 1)
            kept["of_flat"] = round(float(own.sum() / flat), 4)
            kept["same_as_flat"] = round(float((own & found_flat).sum() / flat), 4)
        return kept


def difference(one: Resampled, other: Resampled) -> dict:
    """The differences of two methods on the same scenes, with intervals."""
    kept: dict = {}
    for name in ("map", "recall"):
        kept[name] = round(one.whole[name] - other.whole[name], 4)
        kept[f"{name}_interval"] = interval(one.drawn[name] - other.drawn[name])
    mine, others = one.rows.thing_found, other.rows.thing_found
    kept["only"] = [int((mine & ~others).sum()), int((others & ~mine).sum())]
    return kept


def subset(rows: Rows, wanted: Callable[[int], bool]) -> Rows:
    """The rows of the scenes whose number is wanted."""
    of_row = np.array([wanted(k) for k in rows.scene.tolist()], bool)
    of_thing = np.array([wanted(k) for k in rows.thing_scene.tolist()], bool)
    return Rows(
        *(of[of_row] for of in (rows.scene, rows.score, rows.label, rows.hit, rows.sure)),
        *(of[of_thing] for of in (rows.thing_scene, rows.thing_label, rows.thing_found)),
    )
