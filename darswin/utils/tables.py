"""Values between the entries of a table, read with NumPy alone."""

import numpy as np


def read_table(table: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The values of a table (H, W, K) at points x, y (..., 2), bilinearly: (..., K) float64.

    The entries are at whole numbers. The table goes on in a straight line for half a step beyond
    its border. It is NaN farther outside, and beside entries that are NaN. ValueError for points of
    another shape.
    """
    points = np.asarray(points, np.float64)
    if points.shape[-1:] != (2,):
        raise ValueError(f"points must have shape (..., 2), got {points.shape}")
    height, width, count = table.shape
    x, y = np.moveaxis(points, -1, 0).reshape(2, -1)
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)  # not for NaN
    if not inside.all():
        x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    left = np.clip(x.astype(np.intp), 0, max(width - 2, 0))
    top = np.clip(y.astype(np.intp), 0, max(height - 2, 0))
    corner, right, below = top * width + left, int(width > 1), width * int(height > 1)
    # Contiguous rows of numbers are several times as fast as many short ones.
    across, down = np.repeat(x - left, count), np.repeat(y - top, count)
    entries = table.reshape(-1, count)

    def row(start: np.ndarray) -> np.ndarray:
        first, last = (entries.take(place, 0).ravel() for place in (start, start + right))
        return first * (1 - across) + last * across

    found = (row(corner) * (1 - down) + row(corner + below) * down).reshape(-1, count)
    if not inside.all():
        found[~inside] = np.nan
    return found.reshape(*points.shape[:-1], count)
