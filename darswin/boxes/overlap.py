"""Boxes in one picture: what they have in common, and which ones show the same thing."""

from typing import Any

import numpy as np

from darswin.boxes.arrays import Array, floats, like, shape_of, table_of, to_numpy
from darswin.boxes.turned import as_turned, common_area, upright

_HALF = 0.5  # of a box that a view cuts, beyond which another one shows the same thing
_LEAST = 0.3  # of its score, which the other one must have
_ROWS = 128  # boxes that are compared with all worse ones at once


def clip(boxes: Array, size: tuple[int, int]) -> Any:
    """Cuts boxes (K, 4) at the borders of a picture of (H, W); NaN stays NaN."""
    height, width = size
    return like(boxes, np.clip(table_of(boxes, (4,)), 0.0, [width, height, width, height]))


def iou(boxes: Array, others: Array) -> Any:
    """The intersection over the union of each box (K, 4 or 5) with each of the others (L, 4 or 5):
    (K, L), 0 for boxes that are NaN or have no area."""
    a, b = table_of(boxes)[:, None], table_of(others)[None]
    if a.shape[2] != b.shape[2]:
        a, b = as_turned(a), as_turned(b)
    common = _common(a, b)
    return like(boxes, _ratio(common, _area(a) + _area(b) - common))


def merge(
    boxes: Array, scores: Array, labels: Array, *, iou: float = 0.5, inside: float = 0.7
) -> Any:
    """Merges the detections of several views of one picture.

    From the best to the worst, a detection is kept unless a better one of its class that was kept
    has an intersection over union with it above `iou`, or covers more than `inside` of its area,
    as the whole of a thing covers the part that another tile saw.

    Args:
        boxes: (K, 4 or 5). scores: (K,). labels: (K,), the classes.

    Returns:
        The indices of the kept detections, the best first. NaN boxes and scores are left out.

    Raises:
        ValueError: other shapes, or a limit that is not in [0, 1].
    """
    for name, limit in (("iou", iou), ("inside", inside)):
        if not 0 <= limit <= 1:
            raise ValueError(f"{name} must be in [0, 1], got {limit}")
    table, score, label = table_of(boxes), floats(scores), np.asarray(to_numpy(labels))
    for name, values in (("scores", score), ("labels", label)):
        if values.shape != (len(table),):
            raise ValueError(
                f"{name} must have shape ({len(table)},), as the boxes, got {shape_of(values)}"
            )
    order = np.argsort(-score, kind="stable")
    order = order[np.isfinite(table).all(1)[order] & ~np.isnan(score)[order]]
    table, label = table[order], label[order]
    area, kept = _area(table), np.ones(len(order), bool)
    x0, x1 = np.ascontiguousarray(upright(table)[:, ::2].T)
    for start in range(0, len(order), _ROWS):
        rows, rest = np.s_[start : start + _ROWS, None], np.s_[None, start:]
        meet = label[rows] == label[rest]
        meet &= x0[rows] < x1[rest]
        meet &= x1[rows] > x0[rest]
        better, worse = np.nonzero(meet)
        ahead = better < worse
        better, worse = better[ahead] + start, worse[ahead] + start
        common = _common(table[better], table[worse])
        drops = _ratio(common, area[better] + area[worse] - common) > iou
        drops |= _ratio(common, area[worse]) > inside
        better, worse = better[drops], worse[drops]  # sorted by the better one
        starts = np.flatnonzero(np.diff(better, prepend=-1))
        groups = np.split(worse, starts[1:])
        for best, dropped in zip(better[starts].tolist(), groups, strict=False):
            if kept[best]:
                kept[dropped] = False
    return like(boxes, order[kept])


def mend(
    boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, cut: np.ndarray, view: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The boxes (K, 4 or 5) and scores (K,) of detections in several views, whose borders cut some:
    (K,) bool. The scores of parts of things that another detection stands for are NaN.

    A whole box that is larger than a cut one of another view and covers half of it shows the same
    thing, and gets the higher score of both. Other upright boxes that are cut by two views and have
    half of the smaller one in common are joined. In both cases, the box that stays, or joins, has
    at least 0.3 of the score of the better one: much weaker ones are mostly wrong.
    """
    boxes, area = boxes.copy(), _area(boxes)
    scores = np.where(np.isfinite(boxes).all(1), scores, np.nan)
    parts = np.flatnonzero(cut)[np.argsort(-scores[cut], kind="stable")].tolist()
    for k in parts:
        common = _common(boxes[k], boxes)
        shows = (labels == labels[k]) & (view != view[k]) & (scores >= _LEAST * scores[k])
        shows &= ~cut & (area >= area[k]) & (common > _HALF * area[k])
        if shows.any():
            best = np.where(shows, common, 0).argmax()
            scores[best], scores[k] = max(scores[best], scores[k]), np.nan
    for k in parts if boxes.shape[1] == 4 else ():
        joins = cut & (labels == labels[k]) & (view != view[k])
        while True:
            least = np.minimum(_area(boxes[k]), area)
            more = joins & (_common(boxes[k], boxes) > _HALF * least)
            more &= (scores <= scores[k]) & (scores >= _LEAST * scores[k])
            if not more.any():
                break
            low, high = np.vstack((boxes[k], boxes[more])).reshape(-1, 2, 2).swapaxes(0, 1)
            boxes[k], scores[more] = (*low.min(0), *high.max(0)), np.nan
    return boxes, scores


def _area(boxes: np.ndarray) -> np.ndarray:
    if boxes.shape[-1] == 4:
        return _common(boxes, boxes)
    return np.maximum(boxes[..., 2], 0) * np.maximum(boxes[..., 3], 0)


def _common(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The area of the intersection of boxes."""
    if a.shape[-1] == 5:
        near = _common(upright(a), upright(b))
        meet = near > 0
        first, second = (np.broadcast_to(table, (*meet.shape, 5))[meet] for table in (a, b))
        # No more than either, which it is but for rounding.
        near[meet] = np.minimum(common_area(first, second), np.minimum(_area(first), _area(second)))
        return np.where(meet, near, 0)
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    sides = np.maximum(high - low, 0)
    return sides[..., 0] * sides[..., 1]  # several times as fast as `prod`


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.divide(part, whole, out=np.zeros(part.shape), where=whole > 0)
