"""Boxes, points, polygons and masks through a map of points."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from darswin.boxes.arrays import (
    Array,
    PointMap,
    floats,
    like,
    shape_of,
    table_of,
    through,
    to_numpy,
)
from darswin.boxes.overlap import clip
from darswin.boxes.regions import Part, box_of, shown_parts
from darswin.boxes.turned import angle_around, frames_of, rotation

_COUNT, FINELY = 72, 288  # points of an ellipse, and of one that is cut
_BETWEEN = 33  # points at which the end of a curve is looked for


def _circle(angles: np.ndarray) -> np.ndarray:
    return np.stack((np.cos(angles), np.sin(angles)), -1)


def _shares(count: int) -> np.ndarray:
    """The points of an ellipse are the product of its half axes and its middle, the rows of (2, 3),
    and this, (6, 2·count)."""
    circle = _circle(np.linspace(0, 2 * np.pi, count, endpoint=False))
    each = np.concatenate((circle.T, np.ones((1, count))))
    return (np.eye(2)[:, None, None] * each[..., None]).reshape(6, 2 * count)


_ELLIPSE = _shares(_COUNT)
_CIRCLE = _circle(np.linspace(0, 2 * np.pi, _COUNT, endpoint=False))
_STEP = 4.0  # px: a curve differs less than 0.1 px from its chords, if its radius is above 20 px
_MOST_POINTS = 100_000  # of a polygon: a corner that is far away must not fill the memory


def carry(
    boxes: Array, points_map: PointMap, size: tuple[int, int] | None = None
) -> tuple[Any, Any]:
    """Warps boxes by a point map, as the ellipses inside them.

    An ellipse is cut where the map ends and at the borders of the new picture. The new box is that
    of what is left. A rotated box becomes the rotated box of its new ellipse.

    Args:
        boxes: (K, 4 or 5).
        points_map: called twice for all boxes, and more often if boxes are cut.
        size: (H, W) of the new picture. Without it, boxes may go on beyond the picture.

    Returns:
        The boxes of what is seen, (K, 4 or 5), NaN if nothing is; and the visible shares of the
        areas of the ellipses, (K,), 0 to 1.

    Raises:
        ValueError: boxes of another shape.
    """
    table = table_of(boxes)
    # Reductions along a contiguous axis are several times as fast.
    curves = through(points_map, ellipses(table))
    x, y = np.ascontiguousarray(np.moveaxis(curves, -1, 0))
    carried = np.zeros((0, 4))
    if len(table):
        carried = np.stack((x.min(1), y.min(1), x.max(1), y.max(1)), 1)
    whole = ~np.isnan(carried[:, 0])
    if size is not None:
        whole &= (clip(carried, size) == carried).all(1)
        whole &= (np.abs(np.diff(x, append=x[:, :1])) <= size[1] / 2).all(1)  # not at a seam
    turn = None
    if table.shape[1] == 5:
        axes = (curves - curves[:, :1]).mT @ _CIRCLE  # of the affine map that is nearest
        turn = np.where(axes.any((1, 2)), angle_around(axes), table[:, 4])
        x, y = np.moveaxis(curves @ rotation(turn), -1, 0)
    if whole.any():
        frame = None if turn is None else turn[whole]
        carried[whole] = _ends(table[whole], points_map, x[whole], y[whole], frame)
    visible = np.ones(len(table))
    cut = np.flatnonzero(~whole)
    outlines = [*ellipses(table[cut], FINELY)]
    shown = shown_parts(outlines, lambda points: through(points_map, points), size)
    for k, (parts, share) in zip(cut, shown, strict=True):
        new = [part.new for part in parts]
        if turn is not None:
            turn[k] = _turn_of(parts, table[k])
            new = [points @ rotation(turn[k]) for points in new]
        carried[k], visible[k] = box_of(new), share
    if turn is not None:
        low, high = carried[:, None, :2], carried[:, None, 2:]
        middle = (low + high) / 2 @ rotation(turn).mT
        carried = np.concatenate((middle[:, 0], (high - low)[:, 0], turn[:, None]), 1)
    return like(boxes, carried), like(boxes, visible)


def _turn_of(parts: Sequence[Part], box: np.ndarray) -> float:
    """The angle of the ellipse in a turned box, (5,), of which a map shows parts."""
    if not parts:
        return np.nan
    old, new = (np.concatenate(of) for of in zip(*parts, strict=True))
    moves, *_ = np.linalg.lstsq(old - old.mean(0), new - new.mean(0))
    return angle_around(moves.T @ frames_of(box)[1][None]).item()


def _ends(
    table: np.ndarray, points_map: PointMap, x: np.ndarray, y: np.ndarray, turn: np.ndarray | None
) -> np.ndarray:
    """The boxes of curves whose points are x and y (K, P), turned by the angles `turn`: each of
    the four ends is looked for between the neighbours of the outermost point, since a curve may
    have corners."""
    outermost = np.stack((x, y, -x, -y)).argmin(2)  # (4, K)
    around = outermost[..., None] + np.linspace(-1, 1, _BETWEEN)
    angle = 2 * np.pi / x.shape[1] * around
    middle, axes = frames_of(table)
    circle, (w, h) = _circle(angle), np.moveaxis(axes, -1, 0)[:, :, None]
    points = through(points_map, middle[:, None] + circle[..., :1] * w + circle[..., 1:] * h)
    if turn is not None:
        points = points @ rotation(turn)
    x, y = np.moveaxis(np.where(np.isnan(points), np.inf, points), -1, 0)
    x_high, y_high = np.moveaxis(np.where(np.isnan(points), -np.inf, points), -1, 0)
    return np.stack((_least(x[0]), _least(y[1]), -_least(-x_high[2]), -_least(-y_high[3])), 1)


def _least(values: np.ndarray) -> np.ndarray:
    """The least value of curves (K, P), between the points too: that of the parabola through the
    least one and its neighbours."""
    row, k = np.arange(len(values)), values.argmin(1).clip(1, values.shape[1] - 2)
    last, least, ahead = (values[row, k + step] for step in (-1, 0, 1))
    bend = last - 2 * least + ahead
    bends = (bend > 0) & (bend < np.inf)  # with neighbours that are seen
    below = np.divide((ahead - last) ** 2, 8 * bend, out=np.zeros(len(row)), where=bends)
    best = np.minimum(np.minimum(last, ahead), least)
    return np.where(below < 0.1 * (values.max(1) - best), least - below, best)  # not at a seam


def ellipses(boxes: Array, count: int = _COUNT) -> np.ndarray:
    """Points of the ellipses inside boxes, (K, count, 2); NaN for boxes that are not finite."""
    middle, axes = frames_of(table_of(boxes))
    rows = np.concatenate((axes, middle[..., None]), -1).reshape(-1, 6)
    return (rows @ (_ELLIPSE if count == _COUNT else _shares(count))).reshape(-1, count, 2)


def carry_points(points: Array, points_map: PointMap) -> Any:
    """Carries points (..., 2) through a point map; NaN where nothing is seen."""
    table = floats(points)
    if table.shape[-1:] != (2,):
        raise ValueError(f"points must have shape (..., 2), got {shape_of(table)}")
    return like(points, through(points_map, table))


def carry_polygon(polygon: Array, points_map: PointMap, step: float = _STEP) -> Any:
    """Carries a polygon (P, 2) through a point map, its sides cut into pieces of at most `step` px.

    Returns:
        The polygon (Q, 2) of the points that are seen; Q = 0 if none is.
    """
    moved = carry_points(cut_polygon(floats(polygon), step), points_map)
    return like(polygon, moved[~np.isnan(moved[:, 0])])


def cut_polygon(polygon: np.ndarray, step: float = _STEP) -> np.ndarray:
    """The corners (P, 2) of a polygon, and points between them at most `step` px apart, (Q, 2)."""
    if polygon.ndim != 2 or polygon.shape[1] != 2:
        raise ValueError(f"a polygon must have shape (P, 2), got {shape_of(polygon)}")
    if not step > 0:
        raise ValueError(f"step must be above 0 px, got {step}")
    sides = np.roll(polygon, -1, 0) - polygon
    lengths = np.nan_to_num(np.hypot(*sides.T), posinf=0)  # a side to nowhere stays as it is
    step = max(step, lengths.sum() / _MOST_POINTS)
    pieces = np.maximum(np.ceil(lengths / step), 1).astype(int)
    side = np.repeat(np.arange(len(polygon)), pieces)
    piece = np.arange(len(side)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (piece / pieces[side])[:, None]
    return np.where(share > 0, polygon[side] + share * sides[side], polygon[side])


def carry_mask(mask: Array, to_old: PointMap, size: tuple[int, int]) -> Any:
    """Carries a mask: each new pixel has the value of the nearest old one, or 0 beyond.

    Args:
        mask: (H, W), of any dtype. size: (H', W') of the new mask.
        to_old: the point map from the pixels of the *new* mask to those of the old one.
    """
    old = np.asarray(to_numpy(mask))
    if old.ndim != 2:
        raise ValueError(f"a mask must have shape (H, W), got {shape_of(old)}")
    x, y = np.meshgrid(np.arange(size[1], dtype=float), np.arange(size[0], dtype=float))
    places = np.rint(to_old(np.stack((x, y), -1)))
    x, y = places[..., 0], places[..., 1]
    inside = (x >= 0) & (x < old.shape[1]) & (y >= 0) & (y < old.shape[0])  # not for NaN
    new = np.zeros(size, old.dtype)
    new[inside] = old[y[inside].astype(np.intp), x[inside].astype(np.intp)]
    return like(mask, new)
