"""Boxes as directions and angles, against formulas, turned cameras, and all points of ellipses."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from darswin import boxes


def camera(points):
    """The rays of a perspective camera of 100 × 80 px with a focal length of 60 px."""
    x, y = points[..., 0] - 49.5, points[..., 1] - 39.5
    return np.stack((x, y, np.full_like(x, 60.0)), -1)


def test_spherical_boxes():
    found = boxes.spherical([[20, 10, 80, 70], [50, 30, 50, 50]], camera)
    # The solid angle of a rectangle 2a × 2b at the distance d, on the axis.
    a = b = 30.0
    d2 = 60.0**2
    omega = 4 * math.asin(a * b / math.sqrt((a * a + d2) * (b * b + d2)))
    assert found.solid_angle[0] == pytest.approx(omega)
    assert found.width[1] == pytest.approx(0, abs=1e-12) == found.solid_angle[1]
    found = boxes.spherical([[0, 0, 9, 9]], lambda p: np.zeros((*p.shape[:-1], 3)))  # not seen
    assert all(np.isnan(value).all() for value in found)
    assert boxes.spherical([], camera).ray.shape == (0, 3)


@pytest.mark.parametrize("azimuth", [-2.5, -0.7, 0.0, 1.2, 3.0])
@pytest.mark.parametrize("elevation", [-1.0, 0.0, 0.8])
def test_a_turned_camera_sees_the_same_box_elsewhere(azimuth, elevation):
    """The camera turns by rotations of scipy; the box at its centre keeps its angles."""
    turn = Rotation.from_euler("YX", [azimuth, elevation])  # y is down: to the right, then up

    def turned(points):
        rays = camera(points)
        return turn.apply(rays.reshape(-1, 3)).reshape(rays.shape)

    found = boxes.spherical([[30.0, 20, 70, 60]], turned)
    assert found.azimuth[0] == pytest.approx(azimuth, abs=1e-6)
    assert found.elevation[0] == pytest.approx(elevation, abs=1e-6)
    assert found.width[0] == pytest.approx(2 * math.atan(1 / 3), rel=1e-6) == found.height[0]
    np.testing.assert_allclose(found.ray[0], turn.apply([0, 0, 1]), atol=1e-6)


def fisheye_rays(points):
    """θ = r / 100 px from the middle of a picture of 600 px, up to 240° across and no farther."""
    plane = (points - 299.5) / 100
    theta = np.linalg.norm(plane, axis=-1, keepdims=True)
    rays = np.concatenate((plane * np.sinc(theta / np.pi), np.cos(theta)), -1)
    return np.where(theta <= math.radians(120.1), rays, np.nan)


@pytest.mark.parametrize("middle", [(310, 148), (290, 142), (300, 455), (340, 139)])
def test_thin_boxes_near_the_zenith_are_seen_around_their_middles(middle):
    half = np.array([125, 0.25])
    found = boxes.spherical([[*(middle - half), *(middle + half)]], fisheye_rays)
    turn = np.linspace(0, 2 * np.pi, 7200)
    rays = fisheye_rays(middle + half * np.stack((np.cos(turn), np.sin(turn)), -1) - 0.5)
    angles = [found.azimuth[0], found.elevation[0]]
    seen = Rotation.from_euler("YX", angles).inv().apply(rays)
    theta = np.arctan2(np.linalg.norm(seen[:, :2], axis=1), seen[:, 2])
    angles = seen[:, :2] * (theta / np.linalg.norm(seen[:, :2], axis=1))[:, None]
    sides = np.stack((found.width, found.height), -1)[0] / 2
    np.testing.assert_allclose(np.nanmax(angles, 0), sides, atol=1e-3)
    np.testing.assert_allclose(np.nanmin(angles, 0), -sides, atol=1e-3)


def test_spherical_boxes_beyond_180_degrees_and_at_the_rim():
    """What the camera that looks at the middle sees, by every point of the ellipse."""
    wide, high = math.radians(240), math.radians(71)
    sides = 100 * np.array([[wide, high], [high, wide], [wide, wide]])
    found = boxes.spherical(np.concatenate((300 - sides / 2, 300 + sides / 2), 1), fisheye_rays)
    np.testing.assert_allclose(found.width, sides[:, 0] / 100, rtol=1e-6)
    np.testing.assert_allclose(found.height, sides[:, 1] / 100, rtol=1e-6)
    assert np.isnan(found.solid_angle).all() and found.ray[:, 2] == pytest.approx(1)
    rim = np.array([[380.0, 420, 520, 490]])
    found = boxes.spherical(rim, fisheye_rays)
    radius = np.sqrt(np.linspace(0, 1, 300))[:, None]
    angle = np.linspace(0, 2 * np.pi, 3000)
    x, y = 449.5 + radius * 70 * np.cos(angle), 454.5 + radius * 35 * np.sin(angle)
    rays = fisheye_rays(np.stack((x, y), -1))
    rays = rays[np.isfinite(rays[..., 0])]
    assert len(rays) < 0.9 * x.size
    ahead = found.ray[0]
    right = np.cross([0, 1, 0], ahead) / np.linalg.norm(np.cross([0, 1, 0], ahead))
    u, v, z = (rays @ np.stack((right, np.cross(ahead, right), ahead), 1)).T
    scale = np.arctan2(np.hypot(u, v), z) / np.hypot(u, v)
    for side, size in ((u * scale, found.width[0]), (v * scale, found.height[0])):
        ends = np.degrees([side.min() + size / 2, side.max() - size / 2])
        assert ends == pytest.approx([0, 0], abs=0.05)
