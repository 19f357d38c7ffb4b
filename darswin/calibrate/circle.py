"""The circle that a fisheye fills on its sensor."""

import math
from collections.abc import Iterable

import cv2
import numpy as np

from darswin.calibrate.boards import LEAST_SIDE, grey_of

TRIPLES = 2000  # of points of the rim


def image_circle(pictures: Iterable[np.ndarray]) -> tuple[float, float, float] | None:
    """The middle (x, y) and the radius, px, of the circle that a fisheye fills on its sensor.

    None if there is none: the pictures have bright corners, or their bright part is not round.
    """
    brightest = np.maximum.reduce([grey_of(picture) for picture in pictures])
    height, width = brightest.shape
    if min(height, width) < LEAST_SIDE:
        return None
    light = cv2.GaussianBlur(brightest, (0, 0), 1.0)
    part = max(2, min(height, width) // 40)
    ends = slice(part), slice(-part, None)
    dark = max(np.median(light[rows, columns]) for rows in ends for columns in ends)
    middle = np.median(light[height // 4 : -height // 4, width // 4 : -width // 4])
    there = (light > dark + max(4.0, 0.15 * (middle - dark))).astype(np.uint8)
    outlines, _ = cv2.findContours(there, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if dark > 0.25 * middle or not outlines:
        return None
    rim = max(outlines, key=cv2.contourArea)[:, 0].astype(np.float64)
    rim = rim[((rim > 1) & (rim < (width - 2, height - 2))).all(1)]
    # Circles through three points of the rim. Many more must be near the right one. Dents, such as
    # dark boards make, are inside of it, and nothing is outside.
    rows, squares = np.column_stack((2 * rim, np.ones(len(rim)))), np.square(rim).sum(1)
    chosen = np.random.default_rng(0).integers(len(rim) or 1, size=(TRIPLES, 3))[
        : TRIPLES * len(rim)
    ]
    chosen = chosen[np.abs(np.linalg.det(rows[chosen])) > 1e-3 * width**2]
    most, near = 0, np.zeros(len(rim), bool)
    for a, b, c in np.linalg.solve(rows[chosen], squares[chosen][..., None])[..., 0]:
        radius = math.sqrt(c + a * a + b * b)
        off, step = np.hypot(*(rim - (a, b)).T) - radius, max(2.0, 0.015 * radius)
        count = (np.abs(off) < step).sum() - 2 * (off > step).sum()
        if count > most and radius < max(height, width):
            most, near = count, np.abs(off) < step
    if near.sum() < 16:
        return None
    a, b, c = np.linalg.lstsq(rows[near], squares[near], rcond=None)[0].tolist()
    radius = math.sqrt(c + a * a + b * b)
    # Of the circle that the picture shows, a large part must be there.
    turn = np.arange(360)
    x, y = a + radius * np.cos(np.radians(turn)), b + radius * np.sin(np.radians(turn))
    shown = (x > 1) & (x < width - 2) & (y > 1) & (y < height - 2)
    found = np.degrees(np.arctan2(rim[near, 1] - b, rim[near, 0] - a)) % 360
    there = np.isin(turn, found.astype(int)) & shown
    return (a, b, radius) if there.sum() >= max(90, 0.7 * shown.sum()) else None
