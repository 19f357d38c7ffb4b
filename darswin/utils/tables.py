"""Values between the entries of a table, read with NumPy alone."""

import numpy as np


def read_table(table: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The values of a table (H, W, K) at points x, y (..., 2), bilinearly: (..., K) float64.

    The entries are at whole numbers. The table goes on in a straight line for half a step beyond
    its border. It is NaN farther outside, and beside entries that are NaN.
    """
    points = np.asarray(points, np.float64)
    height, width = table.shape[:2]
    x, y = points[..., 0], points[..., 1]
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)  # not for NaN
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    left = np.clip(np.floor(x), 0, max(width - 2, 0)).astype(np.intp)
    top = np.clip(np.floor(y), 0, max(height - 2, 0)).astype(np.intp)
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left)[..., None], (y - top)[..., None]
    upper = table[top, left] * (1 - across) + table[top, right] * across
    lower = table[below, left] * (1 - across) + table[below, right] * across
    return np.where(inside[..., None], upper * (1 - down) + lower * down, np.nan)
