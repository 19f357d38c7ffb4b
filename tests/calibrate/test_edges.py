"""Edges as curves: their points are exact, in order, and end at corners."""

import math

import numpy as np
import pytest

from darswin.calibrate import edges

FINE = 8  # samples along each side of a pixel


def drawn(inside, size=(240, 320), low=60, high=180):
    """A picture (H, W) of a region, averaged over the area of each pixel."""
    side = (np.arange(FINE) + 0.5) / FINE - 0.5
    y = (np.arange(size[0])[:, None] + side).ravel()[:, None]
    x = (np.arange(size[1])[:, None] + side).ravel()[None]
    share = inside(x, y).reshape(size[0], FINE, size[1], FINE).mean((1, 3))
    return np.rint(low + (high - low) * share).astype(np.uint8)


@pytest.mark.parametrize("channels", [None, 3])
@pytest.mark.parametrize("radius", [60.0, 95.5])
def test_points_of_an_edge_are_within_a_tenth_of_a_pixel(radius, channels):
    picture = drawn(lambda x, y: np.hypot(x - 150.3, y - 119.6) < radius)
    if channels:
        picture = np.repeat(picture[..., None], channels, 2)
    found = edges.curves(picture)
    points = np.concatenate(found)
    off = np.hypot(*(points - (150.3, 119.6)).T) - radius
    assert np.sqrt((off**2).mean()) < 0.1 and abs(off.mean()) < 0.05
    assert len(points) > 0.9 * 2 * math.pi * radius * 0.9
    # In order along the edge.
    assert all(np.linalg.norm(np.diff(c, axis=0), axis=1).max() < 3.5 for c in found)


def test_an_edge_ends_at_corners():
    turn = math.radians(17)

    def square(x, y):
        across = (x - 160) * math.cos(turn) + (y - 120) * math.sin(turn)
        down = (y - 120) * math.cos(turn) - (x - 160) * math.sin(turn)
        return np.maximum(abs(across), abs(down)) < 60

    found = edges.curves(drawn(square))
    assert len(found) == 4 and all(95 < len(curve) < 125 for curve in found)
    for curve in found:
        assert np.linalg.svd(curve - curve.mean(0))[1][1] / math.sqrt(len(curve)) < 0.3


def test_the_longest_curve_is_first_and_an_even_picture_has_none():
    picture = drawn(lambda x, y: (x > 300.2) | ((abs(x - 120) < 40) & (abs(y - 100) < 25)))
    lengths = [len(curve) for curve in edges.curves(picture)]
    assert len(lengths) >= 5 and lengths == sorted(lengths, reverse=True)
    assert edges.curves(np.full((80, 100), 120, np.uint8)) == []
