"""The edges of a picture as curves with subpixel points.

Source: Canny, PAMI 1986; Devernay, INRIA RR-2724, 1995.
"""

import cv2
import numpy as np

BLUR = 1.2  # px, of the picture before its gradient
STRONG, WEAK = 0.9, 0.3  # Canny's thresholds: a quantile of the gradient, and a part of that
LEAST = 0.5  # grey levels per px, of the stronger threshold
TURN = 0.8  # the least cosine between the gradients of neighbours on a curve
SHORTEST = 0.035  # of the picture's diagonal
APART = 1.0  # px, the largest distance of a point from the circle of its curve


def curves(picture: np.ndarray) -> list[np.ndarray]:
    """The smooth edges of a picture, longest first.

    Args:
        picture: (H, W) or (H, W, 3), uint8.

    Returns:
        Arrays (n, 2) of points (x, y) in px, in order along an edge. Each is close to a circle.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
    even = 16 * np.sqrt(grey.astype(np.float32))  # noise and contrast of dark and bright parts
    smooth = cv2.GaussianBlur(even, (0, 0), BLUR)
    gradient = np.stack([cv2.Scharr(smooth, cv2.CV_32F, *d) / 32 for d in ((1, 0), (0, 1))], -1)
    points, normal = _edge_points(gradient)
    shortest = max(SHORTEST * np.hypot(*grey.shape), 3)
    chains = _chains(points, normal, grey.shape)
    found = [p for c in chains if len(c) > shortest for p in _smooth(points[c], shortest)]
    return sorted(found, key=len, reverse=True)


def _edge_points(gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 2), px, where the gradient is largest across an edge, and its direction."""
    strength = np.linalg.norm(gradient, axis=-1)
    strong = max(np.quantile(strength, STRONG), LEAST)
    dx, dy = np.rint(64 * gradient).astype(np.int16).transpose(2, 0, 1)
    edges = cv2.Canny(dx.copy(), dy.copy(), 64 * WEAK * strong, 64 * strong, L2gradient=True)
    y, x = np.nonzero(edges)
    normal = gradient[y, x] / strength[y, x, None]
    # The top of the parabola through three values along the axis that is closer to the gradient.
    axis = np.eye(2, dtype=int)[np.abs(normal).argmax(1)]
    around = np.pad(strength, 1, mode="edge")
    before, middle, after = (
        around[y + 1 + step * axis[:, 1], x + 1 + step * axis[:, 0]] for step in (-1, 0, 1)
    )
    bend = np.minimum(before + after - 2 * middle, -1e-6)
    offset = np.clip((before - after) / (2 * bend), -0.7, 0.7)
    return np.stack((x, y), -1) + offset[:, None] * axis, normal


def _chains(points: np.ndarray, normal: np.ndarray, size: tuple[int, int]) -> list[list[int]]:
    """Numbers of points in order along each edge, with the bright side on one hand.

    Two points are linked if each is the nearest to the other, ahead and behind.
    """
    place = np.full((size[0] + 4, size[1] + 4), -1)
    x, y = np.rint(points).astype(int).T + 2
    place[y, x] = np.arange(len(points))
    tangent = normal[:, ::-1] * (-1, 1)
    nearest = np.full((2, len(points)), np.inf)
    link = np.full((2, len(points)), -1)
    for dx, dy in ((i, j) for i in range(-2, 3) for j in range(-2, 3) if i or j):
        other = place[y + dy, x + dx]
        apart = points[other] - points
        ahead = (apart * tangent).sum(1)
        distance = np.linalg.norm(apart, axis=1)
        alike = (other >= 0) & ((normal[other] * normal).sum(1) > TURN)
        for way, sign in enumerate((1, -1)):
            better = alike & (sign * ahead > TURN * distance) & (distance < nearest[way])
            nearest[way][better], link[way][better] = distance[better], other[better]
    after, before = link
    mutual = (after >= 0) & (before[after] == np.arange(len(points)))
    after = np.where(mutual, after, -1)
    is_first = np.ones(len(points), bool)
    is_first[after[mutual]] = False
    successor, free, chains = after.tolist(), [True] * len(points), []
    for start in np.argsort(~is_first, kind="stable").tolist():  # closed curves have no first
        chain = []
        while start >= 0 and free[start]:
            free[start] = False
            chain.append(start)
            start = successor[start]
        chains.append(chain)
    return chains


def _smooth(points: np.ndarray, shortest: float) -> list[np.ndarray]:
    """The parts of a chain that are close to circles."""
    if len(points) < shortest:
        return []
    if (_from_circle(points) < APART).all():
        return [points]
    chord = points[-1] - points[0]
    across = np.abs((points - points[0]) @ (chord[::-1] * (-1, 1)))
    corner = int(across[1:-1].argmax()) + 1
    return _smooth(points[:corner], shortest) + _smooth(points[corner:], shortest)


def _from_circle(points: np.ndarray) -> np.ndarray:
    """The distances (n,), px, of points (n, 2) from a circle or line close to all of them."""
    middle = points.mean(0)
    scale = np.abs(points - middle).max() + 1e-9
    x, y = ((points - middle) / scale).T
    rows = np.stack((x * x + y * y, x, y, np.ones_like(x)), 1)
    a, b, c, d = np.linalg.svd(rows, full_matrices=False)[2][-1]
    slope = np.hypot(2 * a * x + b, 2 * a * y + c)
    return scale * np.abs(rows @ (a, b, c, d)) / np.maximum(slope, 1e-9)
