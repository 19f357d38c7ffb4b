"""Turned boxes (K, 5): the middle x and y, the sides w and h, and the angle of w, rad, from x to y.

Wherever turned boxes are taken, upright ones (K, 4) have the angle 0.
"""

from typing import Any

import numpy as np

from darswin.boxes.arrays import Array, like, table_of

_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
_ROUND = 1e-6  # of the squares of the half axes: an ellipse that is a circle but for rounding


def turned(boxes: Array) -> Any:
    """Upright boxes (K, 4) as turned ones, (K, 5), with the angle 0; turned ones as they are."""
    return like(boxes, as_turned(table_of(boxes)))


def corners(boxes: Array) -> Any:
    """The corners of upright or turned boxes, (K, 4, 2): clockwise, from the upper left one of a
    box that is not turned."""
    middle, axes = frames_of(table_of(boxes))
    return like(boxes, middle[:, None] + 2 * _CORNERS @ axes.mT)


def as_turned(table: np.ndarray) -> np.ndarray:
    """`turned` of an array (..., 4 or 5)."""
    if table.shape[-1] == 5:
        return table
    low, high = table[..., :2], table[..., 2:]
    return np.concatenate(((low + high) / 2, high - low, np.zeros_like(table[..., :1])), -1)


def frames_of(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middles (..., 2) of boxes, and the halves of their sides, the columns of (..., 2, 2); NaN
    for boxes that are not finite."""
    table = as_turned(np.where(np.isfinite(table).all(-1, keepdims=True), table, np.nan))
    return table[..., :2], rotation(table[..., 4]) * (table[..., None, 2:4] / 2)


def rotation(angle: np.ndarray) -> np.ndarray:
    """The matrices (..., 2, 2) that turn points by an angle (...) from x to y."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack((np.stack((cos, -sin), -1), np.stack((sin, cos), -1)), -2)


def angle_around(axes: np.ndarray) -> np.ndarray:
    """The angle of the box around an ellipse, (K,).

    An ellipse is the unit circle, moved by a matrix of `axes` (K, 2, 2). The side w of the box is
    along that axis of the ellipse which is nearer to the first column, or along the column itself
    if the ellipse is a circle.
    """
    w, h = (axes[:, 0] + 1j * axes[:, 1]).T
    ahead = w * w - h * h  # twice the angle of w, where h is at right angles to it
    longer = w * w + h * h  # twice the angle of the longer axis
    longer = np.where((longer * ahead.conj()).real < 0, -longer, longer)
    side = np.sqrt(longer + _ROUND * ahead)
    return np.angle(np.where((side * w.conj()).real < 0, -side, side))


def upright(table: np.ndarray) -> np.ndarray:
    """The upright boxes around boxes (..., 4 or 5), (..., 4)."""
    if table.shape[-1] == 4:
        return table
    middle, axes = frames_of(table)
    half = np.abs(axes).sum(-1)
    return np.concatenate((middle - half, middle + half), -1)


def common_area(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The areas of the intersections of turned boxes (P, 5) with others, pair by pair.

    By Green's theorem, in the frame of the other box: the integral of y dx along the outline, as
    far as x is inside the other box, with y clamped to it. Between the points where a side of the
    outline crosses those of the other box, y is linear, so the trapezoids are exact.
    """
    middle = (a[:, :2] - b[:, :2])[:, None] @ rotation(b[:, 4])
    outline = middle + (_CORNERS * a[:, None, 2:4]) @ rotation(a[:, 4] - b[:, 4]).mT
    side = np.roll(outline, -1, 1) - outline  # (P, 4, 2)
    half = b[:, None, 2:4, None] / 2
    gap = half * [-1, 1] - outline[..., None]  # (P, 4, 2, 2)
    moves = side[..., None] != 0
    share = np.divide(gap, side[..., None], out=np.zeros(gap.shape), where=moves)
    share = np.sort(share.clip(0, 1), -1)
    first, last = share[:, :, 0, :1], share[:, :, 0, 1:]
    place = np.concatenate((first, share[:, :, 1].clip(first, last), last), -1)  # (P, 4, 4)
    y = (outline[..., 1:] + place * side[..., 1:]).clip(-half[..., 1, :], half[..., 1, :])
    below = (np.diff(place) * (y[..., 1:] + y[..., :-1])).sum(-1) / 2
    area = -(side[..., 0] * below).sum(-1)
    return np.maximum(area, 0)
