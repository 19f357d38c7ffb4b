import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given

from darswin.data import IGNORE
from darswin.data.warp import FullSize, at_size
from darswin.lens import Equidistant, KannalaBrandt

FITS = ("crop", "stretch", "whole")


def all_seen(size):
    """A lens that sees all of its picture."""
    return Equidistant(max(size), theta_max=1.5, image_size=size, center=(size[1] / 2, size[0] / 2))


def part(size, fit):
    height, width = size
    side = min(size)
    if fit != "crop":
        return np.s_[:, :]
    top, left = (height - side) // 2, (width - side) // 2
    return np.s_[top : top + side, left : left + side]


def enlarged(values, size, fit):
    """By torch, which has the same convention of pixels."""
    height, width = (min(size),) * 2 if fit == "crop" else size
    return torch.nn.functional.interpolate(
        torch.from_numpy(values)[None], (height, width), mode="bilinear"
    )[0].numpy()


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("size", [(61, 90), (90, 61), (7, 9)])
def test_labels_are_those_of_the_interpolated_logits(size, fit):
    rng = np.random.default_rng(0)
    small = at_size(np.zeros((*size, 3), np.uint8), all_seen(size), 16, fit)[0].shape[:2]
    logits = rng.standard_normal((5, *small)).astype(np.float32)
    labels = FullSize(all_seen(size), 16, fit).labels(logits)
    expected = np.full(size, IGNORE)
    expected[part(size, fit)] = enlarged(logits, size, fit).argmax(0)
    assert labels.dtype == np.uint8 and (labels == expected).mean() > 0.999  # rounding decides some
    assert np.array_equal(labels == IGNORE, expected == IGNORE)


@pytest.mark.parametrize("fit", FITS)
def test_the_logarithm_of_distances_is_interpolated(fit):
    size = (60, 84)
    small = at_size(np.zeros((*size, 3), np.uint8), all_seen(size), 16, fit)[0].shape[:2]
    distance = np.exp(np.random.default_rng(0).standard_normal(small)).astype(np.float32)
    full = FullSize(all_seen(size), 16, fit).distance(distance)
    expected = np.zeros(size, np.float32)
    expected[part(size, fit)] = np.exp(enlarged(np.log(distance[None]), size, fit)[0])
    assert full.dtype == np.float32
    np.testing.assert_allclose(full, expected, rtol=2e-4)  # OpenCV rounds the weights


def test_equal_logits_are_the_first_class():
    size = (20, 20)
    assert not FullSize(all_seen(size), 4, "crop").labels(np.zeros((3, 4, 4), np.float32)).any()
    assert not FullSize(all_seen(size), 4, "crop").labels(np.zeros((1, 4, 4), np.float32)).any()


@given(st.integers(10, 80), st.integers(10, 80), st.sampled_from(FITS), st.floats(0.3, 3.0))
def test_pixels_beyond_the_lens_have_no_answer(height, width, fit, theta_max):
    lens = KannalaBrandt(
        15.0, (0.01, 0, 0, 0), theta_max, center=(width / 3, height / 2), image_size=(height, width)
    )
    full = FullSize(lens, 8, fit)
    y, x = np.mgrid[:height, :width]
    radius = np.hypot(x - width / 3, y - height / 2)
    edge = 15 * (theta_max + 0.01 * theta_max**3)
    seen = np.zeros((height, width), bool)
    seen[part((height, width), fit)] = (radius <= edge)[part((height, width), fit)]
    pixel = (max(height, width) if fit == "stretch" else min(height, width)) / 8
    assert not full.seen[~seen & (np.abs(radius - edge) > 1e-3)].any()
    assert full.seen[seen & (radius < edge - 1.5 * pixel)].all()
    small = at_size(np.zeros((height, width, 3), np.uint8), lens, 8, fit)[0].shape[:2]
    labels = full.labels(np.ones((2, *small), np.float32))
    distance = full.distance(np.full(small, 3, np.float32))
    assert np.array_equal(labels == IGNORE, ~full.seen)
    assert np.array_equal(distance == 0, ~full.seen)


@pytest.mark.parametrize("fit", FITS)
def test_it_undoes_at_size(fit):
    """A smooth map comes back to the pixels that it was taken of."""
    size = (96, 128)
    y, x = np.mgrid[:96, :128]
    smooth = (120 + 60 * np.sin(x / 30) + 60 * np.cos(y / 25)).astype(np.uint8)[..., None]
    lens = all_seen(size)
    small, _ = at_size(smooth, lens, 64, fit)
    back = FullSize(lens, 64, fit).distance(small[..., 0].astype(np.float32))
    inside = part(size, fit)
    error = np.abs(back[inside] - smooth[inside][..., 0].astype(float))
    assert error.mean() < 1
    shifted = np.abs(np.roll(back, 2, 1)[inside] - smooth[inside][..., 0].astype(float))
    assert shifted.mean() > 2 * error.mean()


def test_what_a_network_says_beyond_the_lens_has_no_part_in_the_answer():
    """The distance is 5 m and the class 1 up to the rim, whatever stands beyond it."""
    lens = Equidistant(30.0, theta_max=1.5, image_size=(97, 113))
    full = FullSize(lens, 16, "stretch")
    y, x = np.mgrid[:16, :16]
    inside = np.hypot((x - 7.5) * 113 / 16, (y - 7.5) * 97 / 16) <= 45
    distance = np.where(inside, 5, 1e-6).astype(np.float32)
    found = full.distance(distance)
    np.testing.assert_allclose(found[full.seen], 5, rtol=1e-5)
    logits = np.stack((np.where(inside, 0, 1000), inside)).astype(np.float32)
    assert (full.labels(logits)[full.seen] == 1).all()
    assert np.array_equal(full.distance(np.where(inside, distance, np.nan)), found)


def test_a_lens_that_says_no_size():
    two = Equidistant([20.0, 30.0], math.pi / 2, image_size=(9, 9))
    for lens in (Equidistant(20.0, math.pi / 2), two):
        with pytest.raises(ValueError, match="one lens, with the image_size"):
            FullSize(lens, 9, "crop")
    with pytest.raises(ValueError, match="framing must be one of"):
        FullSize(all_seen((9, 9)), 9, "cut")
