import math

import numpy as np
import pytest
import torch

from darswin.data import warp, warp_map
from darswin.lens import Perspective, Polynomial, Spherical


def wave(lens, size):
    """A smooth scene, in terms of the rays: an image of it through any lens can be computed."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    theta = lens.unproject(torch.from_numpy(np.hypot(x, y)).float()).numpy()
    image = 0.5 + 0.4 * np.cos(4 * theta) * np.cos(np.arctan2(y, x))
    return np.where(theta <= lens.theta_max.item(), image, 0).astype(np.float32)


@pytest.mark.parametrize("xi", [0.0, 0.5, 1.0])
def test_the_warped_image_is_what_the_other_lens_sees(xi):
    source = Perspective.from_fov(math.radians(120), 200)
    target = Spherical.from_fov(xi, math.radians(120), 60)
    got = warp(wave(source, 400), source, target, (120, 120))
    expected = wave(target, 120)
    y, x = np.mgrid[:120, :120] - 59.5
    inside = np.hypot(x, y) < 58
    assert np.abs(got - expected)[inside].max() < 0.02
    assert (got[np.hypot(x, y) > 61] == 0).all()


def test_the_same_lens_changes_nothing():
    lens = Spherical.from_fov(0.4, 2.0, 100)
    image = np.random.default_rng(0).integers(0, 255, (64, 48, 3), np.uint8)
    assert np.array_equal(warp(image, lens, lens, (64, 48)), image)


def test_principal_points_move_the_view():
    image = np.random.default_rng(0).random((40, 40)).astype(np.float32)
    lens = Perspective(30.0, 1.0)
    moved = Perspective(30.0, 1.0, center=[24.5, 16.5])
    got = warp(image, lens, moved, (40, 40))
    np.testing.assert_allclose(got[5:30, 10:40], image[8:33, 5:35], atol=1e-5)


def test_beyond_the_source_is_black():
    source = Perspective.from_fov(math.radians(90), 50)
    wide = Polynomial([40.0], math.radians(100))
    got = warp(np.ones((100, 100), np.float32), source, wide, (140, 140))
    y, x = np.mgrid[:140, :140] - 69.5
    theta = np.hypot(x, y) / 40
    assert (got[theta < math.radians(44)] == 1).all()
    assert (got[theta > math.radians(46)] == 0).all()


def test_maps_of_many_lenses_are_those_of_each():
    source = Perspective.from_fov(2.0, 50)
    many = Spherical.from_fov([0.1, 0.5, 0.9], 2.0, 30, center=[[29.5, 30.0]] * 3)
    together = warp_map(source, (100, 100), many, (60, 64))
    for k in range(3):
        alone = warp_map(source, (100, 100), many[k], (60, 64))
        assert together.shape == (3, 60, 64, 2) and np.array_equal(together[k], alone[0])


def test_one_lens_at_a_time():
    two = Perspective([10.0, 20.0], 1.0)
    with pytest.raises(ValueError, match="one lens each, got 2 and 1"):
        warp(np.zeros((4, 4), np.float32), two, two[0], (4, 4))
