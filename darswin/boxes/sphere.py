"""Boxes as directions and angles."""

from typing import Any, NamedTuple

import numpy as np

from darswin.boxes.arrays import Array, PointMap, like, table_of
from darswin.boxes.carried import FINELY, ellipses
from darswin.boxes.regions import shown_parts

_INNER = np.linspace(0, 1, 4)[:, None, None]  # radii of points inside an ellipse


class SphericalBoxes(NamedTuple):
    """The result of `spherical`."""

    azimuth: Any
    elevation: Any
    width: Any
    height: Any
    ray: Any
    solid_angle: Any


def spherical(boxes: Array, to_rays: PointMap) -> SphericalBoxes:
    """Boxes (K, 4 or 5) of a picture as directions and angles, by the ellipses inside them.

    Args:
        to_rays: a function from points (..., 2), in darswin's pixels, to rays (..., 3), NaN or 0
            where nothing is seen. Boxes end there, as those of `carry`; without any ray, all is
            NaN.

    Returns:
        A named tuple of the boxes as a camera sees them that looks at their middles, level with the
        camera's frame: azimuth and elevation of the middles (K,) rad, to the right and up from the
        optical axis; width and height (K,) rad, the horizontal and the vertical angle of view, 0 to
        2π; ray (K, 3), the unit vectors of the middles in the camera's frame (x right, y down, z
        forward); and solid_angle (K,) sr, of the rectangle in that view, NaN if width or height is
        above π, because no rectangle has them.
    """

    def to_units(points: np.ndarray) -> np.ndarray:
        rays = np.asarray(to_rays(points - 0.5), np.float64)
        length = np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.divide(rays, length, out=np.full(rays.shape, np.nan), where=length > 0)

    table = table_of(boxes)
    rays = to_units(ellipses(table))
    inner = ellipses(table, 12)[:, None]  # a mean of outlines beyond 90° would look backwards
    inner = inner.mean(2, keepdims=True) * (1 - _INNER) + inner * _INNER
    ray = np.nan_to_num(to_units(inner.reshape(len(table), 48, 2))).sum(1)
    cut = np.flatnonzero(np.isnan(rays).any((1, 2)))
    if len(cut):
        outlines = [
            np.concatenate([np.zeros((0, 3)), *(part.new for part in parts)])
            for parts, _ in shown_parts([*ellipses(table[cut], FINELY)], to_units)
        ]
        most = max(rays.shape[1], *map(len, outlines))
        rays = np.pad(rays, ((0, 0), (0, most - rays.shape[1]), (0, 0)), constant_values=np.nan)
        for k, of_box in zip(cut, outlines, strict=True):
            rays[k, : len(of_box)], rays[k, len(of_box) :] = of_box, np.nan
            if not ray[k].any():
                ray[k] = of_box.sum(0)
    ray[np.isnan(rays).all((1, 2))] = np.nan
    best, least = ray, np.full(len(ray), np.inf)
    for turn in range(33):
        frame, low, high = _ends(rays, ray)
        u, v = (low + high) / 2
        theta = np.hypot(u, v)
        best = np.where((theta < least)[:, None], ray, best)
        least = np.fmin(theta, least)
        if turn >= 8 and (theta < 1e-7).all():  # each turn halves the digits that the middle lacks
            break
        # Near the zenith, what is level changes fast: half of the way is better there.
        step = (0.5 if turn >= 8 else 1.0) * theta
        aside = np.divide(np.sin(step), theta, out=np.ones(len(ray)), where=theta > 0)
        ray = (np.stack((u * aside, v * aside, np.cos(step)), -1)[:, None] @ frame)[:, 0]
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    frame, low, high = _ends(rays, best)
    ray = frame[:, 2]
    azimuth, elevation = _angles(ray)
    width, height = high - low
    solid = 4 * np.arcsin(np.sin(width / 2) * np.sin(height / 2))
    solid[(width > np.pi) | (height > np.pi)] = np.nan
    values = (azimuth, elevation, width, height, ray, solid)
    return SphericalBoxes(*(like(boxes, value) for value in values))


def _angles(ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The azimuth and the elevation of rays (K, 3), rad."""
    x, y, z = ray.T
    return np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))


def _ends(rays: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Level cameras that look along a ray (K, 3): their axes, and the least and the greatest angle
    to the right and down, (2, K) rad, of rays (K, P, 3)."""
    frame = _looking(*_angles(ray))
    x, y, z = np.moveaxis(rays @ frame.mT, -1, 0)
    aside = np.hypot(x, y)
    # θ, along the direction from the middle: good for angles beyond 90°.
    scale = np.divide(np.arctan2(aside, z), aside, out=np.ones(x.shape), where=aside > 0)
    angles = np.stack((x * scale, y * scale))
    low, high = np.fmin.reduce(angles, axis=2), np.fmax.reduce(angles, axis=2)
    return frame, low, high


def _looking(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    """The axes right, down and forward of cameras that look in level directions, (K, 3, 3)."""
    (sin_a, sin_e), (cos_a, cos_e) = np.sin((azimuth, elevation)), np.cos((azimuth, elevation))
    right = (cos_a, np.zeros_like(cos_a), -sin_a)
    down = (sin_e * sin_a, cos_e, sin_e * cos_a)
    forward = (cos_e * sin_a, -sin_e, cos_e * cos_a)
    return np.moveaxis(np.array((right, down, forward)), -1, 0)
