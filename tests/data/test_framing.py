"""A ray stays on the same content when picture and lens get a model's size, and back."""

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from lens_pictures import WOODSCAPE, at_size, blob, centroid

from darswin.data import IGNORE, FullSize, fitted
from darswin.data.framing import cut_off
from darswin.lens import Equidistant, KannalaBrandt, load
from darswin.lens.orientation import upright
from darswin.lens.pixels import pixel_angles
from darswin.utils.resize import area_resized


def full_size(lens, size, fit):
    whole = tuple(round(side) for side in lens.image_size[0].tolist())
    return FullSize(fitted(whole, size, fit).at(lens, whole))


# -- at a model's size, and back --------------------------------------------------------------

FITS = ("crop", "stretch", "whole")


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("size", [32, 64])
def test_a_ray_stays_on_its_content_at_another_size(fit, size):
    lens = load(WOODSCAPE).in_picture((242, 320))
    for theta, azimuth in ((0.3, 0.4), (0.6, 2.0), (0.5, -2.5)):
        before = blob(lens.project_rays(theta, azimuth)[0], (242, 320), 6.0)
        image, there = at_size(before, lens, size, fit)
        across = round(size * 320 / 242) if fit == "whole" else size
        assert image.shape == (size, across, 1)
        assert tuple(there.image_size[0].tolist()) == image.shape[:2]
        place = there.project_rays(theta, azimuth)[0]
        torch.testing.assert_close(centroid(image), place, atol=0.1, rtol=0)


SIDES = st.integers(8, 200)


@given(st.tuples(SIDES, SIDES), st.integers(8, 64), st.sampled_from(FITS), st.floats(0, 1.2))
def test_the_lens_of_a_resized_picture_is_exact(before, size, fit, theta):
    """A ray lands where `cv2.resize` puts the pixel that it had, relative to the part's corner."""
    center = (before[1] / 3, before[0] / 2)
    lens = Equidistant(50.0, theta_max=1.3, center=center, image_size=before)
    image, there = at_size(np.zeros((*before, 1), np.uint8), lens, size, fit)
    after = np.array(image.shape[:2])
    side = np.array([min(before)] * 2 if fit == "crop" else before)
    corner = (before - side) // 2
    azimuth = torch.linspace(0, 6, 7)
    was = lens.project_rays(theta, azimuth[None])[0].numpy()[:, ::-1]  # y, x
    expected = (was - corner + 0.5) * after / side - 0.5
    got = there.project_rays(theta, azimuth[None])[0].numpy()[:, ::-1]
    np.testing.assert_allclose(got, expected, atol=1e-3)
    assert there.image_size.tolist() == [after.tolist()]


@pytest.mark.parametrize(
    ("before", "after"), [((90, 640), (128, 128)), ((400, 100), (96, 120)), ((60, 250), (60, 31))]
)
def test_an_axis_that_becomes_shorter_while_the_other_becomes_longer_is_not_shifted(before, after):
    y, x = np.mgrid[: before[0], : before[1]].astype(np.float32)
    resized = area_resized(np.stack((y, x), -1), after)
    for axis in (0, 1):
        scale = before[axis] / after[axis]
        centres = (np.arange(after[axis]) + 0.5) * scale - 0.5
        off = (resized[..., axis].mean(1 - axis) - centres)[2:-2] / scale
        assert abs(off.mean()) < 1e-3 and np.abs(off).max() < 0.5 / min(scale, 1)


def test_a_picture_of_the_size_stays_and_wrong_arguments_are_named():
    square = np.random.default_rng(0).integers(256, size=(32, 32, 1), dtype=np.uint8)
    lens = Equidistant(9.0, 1.5, image_size=(32, 32))
    assert (at_size(square, lens, 32, "crop")[0] == square).all()
    said = "`fit` must be one of crop, stretch, whole, got 'pad'"
    refused(said, at_size, square, lens, 32, "pad")


WIDE = load(WOODSCAPE)  # its circle is cut by the top and the bottom of 966 × 1280 px
SHIFTED = KannalaBrandt(
    30.0, [0.02, -0.01], 1.6, [62.0, 45.0], tangential=[0.02, -0.01], image_size=(96, 128)
)


@pytest.mark.parametrize(
    ("lens", "sides"),
    [
        (WIDE, "157 px at the left and 157 px at the right of pictures of 966 × 1280 px"),
        (upright(WIDE, 6), "157 px at the top and 157 px at the bottom of pictures of 1280 × 966"),
        (SHIFTED, "16 px at the left and 16 px at the right of pictures of 96 × 128 px"),
        (WIDE.cropped(0, 0, 966, 967), "0 px at the left and 1 px at the right of"),
    ],
)
def test_what_a_crop_cuts_off_is_told_in_pixels_and_degrees(lens, sides):
    size = tuple(int(side) for side in lens.image_size[0])
    theta = np.degrees(pixel_angles(lens, size)[0].numpy())
    theta[part(size, "crop")], seen = np.nan, np.isfinite(theta).sum()
    share, first, last = np.isfinite(theta).sum() / seen, np.nanmin(theta), np.nanmax(theta)
    said, part_lost = cut_off(size, lens, "crop"), f"{100 * share:.2g} % of what their lens sees"
    assert said.startswith(sides)
    assert said.endswith(f"({part_lost}, from {first:.0f}° to {last:.0f}° off its axis)")
    assert all(cut_off(size, lens, fit) is None for fit in ("stretch", "whole"))


def test_a_crop_of_what_no_ray_reaches_loses_nothing():
    circle = Equidistant(30.0, theta_max=1.5, image_size=(96, 128))  # 90 px wide
    assert cut_off((96, 128), circle, "crop") is None
    assert cut_off((96, 96), SHIFTED.cropped(0, 0, 96, 96), "crop") is None
    whole = "16 px at the top and 16 px at the bottom of pictures of 128 × 96 px (H × W) (25 % "
    assert cut_off((128, 96), None, "crop").startswith(whole)  # of an unknown lens all counts


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
    size = (min(size),) * 2 if fit == "crop" else size
    values = torch.from_numpy(values)[None]
    return torch.nn.functional.interpolate(values, size, mode="bilinear")[0].numpy()


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize("size", [(61, 90), (90, 61), (7, 9)])
def test_answers_at_full_size_are_interpolated(size, fit):
    """Logits are interpolated linearly, distances in their logarithm."""
    rng = np.random.default_rng(0)
    small = at_size(np.zeros((*size, 3), np.uint8), all_seen(size), 16, fit)[0].shape[:2]
    full, inside = full_size(all_seen(size), 16, fit), part(size, fit)
    logits = rng.standard_normal((5, *small)).astype(np.float32)
    labels, expected = full.labels(logits), np.full(size, IGNORE)
    expected[inside] = enlarged(logits, size, fit).argmax(0)
    assert labels.dtype == np.uint8 and (labels == expected).mean() > 0.999  # rounding decides some
    assert np.array_equal(labels == IGNORE, expected == IGNORE)
    distance = np.exp(rng.standard_normal(small)).astype(np.float32)
    metres, expected = full.distance(distance), np.zeros(size, np.float32)
    expected[inside] = np.exp(enlarged(np.log(distance[None]), size, fit)[0])
    assert metres.dtype == np.float32
    np.testing.assert_allclose(metres, expected, rtol=2e-4)  # OpenCV rounds the weights
    for count in (1, 3):  # equal logits are the first class
        assert not full.labels(np.zeros((count, *small), np.float32))[inside].any()


@given(st.integers(10, 80), st.integers(10, 80), st.sampled_from(FITS), st.floats(0.3, 3.0))
def test_pixels_beyond_the_lens_have_no_answer(height, width, fit, theta_max):
    lens = KannalaBrandt(
        15.0, (0.01, 0, 0, 0), theta_max, center=(width / 3, height / 2), image_size=(height, width)
    )
    full, inside = full_size(lens, 8, fit), part((height, width), fit)
    y, x = np.mgrid[:height, :width]
    radius = np.hypot(x - width / 3, y - height / 2)
    edge = 15 * (theta_max + 0.01 * theta_max**3)
    seen = np.zeros((height, width), bool)
    seen[inside] = (radius <= edge)[inside]
    pixel = (max(height, width) if fit == "stretch" else min(height, width)) / 8
    assert not full.seen[~seen & (np.abs(radius - edge) > 1e-3)].any()
    assert full.seen[seen & (radius < edge - 1.5 * pixel)].all()
    small = at_size(np.zeros((height, width, 3), np.uint8), lens, 8, fit)[0].shape[:2]
    labels = full.labels(np.ones((2, *small), np.float32))
    distance = full.distance(np.full(small, 3, np.float32))
    assert np.array_equal(labels == IGNORE, ~full.seen)
    assert np.array_equal(distance == 0, ~full.seen)


def test_answers_beyond_the_lens_have_no_part_in_the_others():
    """The distance is 5 m and the class 1 up to the rim, whatever stands beyond it."""
    full = full_size(Equidistant(30.0, theta_max=1.5, image_size=(97, 113)), 16, "stretch")
    y, x = np.mgrid[:16, :16]
    inside = np.hypot((x - 7.5) * 113 / 16, (y - 7.5) * 97 / 16) <= 45
    distance = np.where(inside, 5, 1e-6).astype(np.float32)
    found = full.distance(distance)
    np.testing.assert_allclose(found[full.seen], 5, rtol=1e-5)
    logits = np.stack((np.where(inside, 0, 1000), inside)).astype(np.float32)
    assert (full.labels(logits)[full.seen] == 1).all()
    assert np.array_equal(full.distance(np.where(inside, distance, np.nan)), found)
