"""Pictures warped as wide-angle lenses see them, and the lenses that are drawn for this."""

import math

import cv2
import numpy as np
import pytest
import torch
from helpers import refused
from lens_pictures import blob, centroid, warped

from darswin.data import PolynomialLenses, RandomTurns, SphericalLenses, WideAngle
from darswin.data.lens_distributions import LEVELS, parse_lenses, parse_sweep
from darswin.data.pictures import Arrays
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD, Draw
from darswin.data.wide_angle import PAPER_FOV
from darswin.lens import Perspective, Spherical
from darswin.views import Turn

# -- lenses -----------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [*LEVELS, "0.4", "0.1..0.9", "polynomial"])
def test_every_lens_fills_the_circle(text):
    rng = np.random.default_rng(0)
    for _ in range(50):
        lens = parse_lenses(text).draw(rng, math.radians(170), 32.0)
        assert lens.theta_max.item() == pytest.approx(math.radians(85))
        assert lens.r_max.item() == pytest.approx(32, rel=1e-5)


def test_ranges_are_used_whole():
    assert LEVELS["low"] == (0.2, 0.35) and list(LEVELS) == ["very low", "low", "medium", "high"]
    rng = np.random.default_rng(0)
    for text, low, high in (("medium", 0.5, 0.7), ("0.4", 0.4, 0.4), ("0.1..0.9", 0.1, 0.9)):
        xi = [parse_lenses(text).draw(rng, 3.0, 32).xi.item() for _ in range(500)]
        assert min(xi) == pytest.approx(low, abs=0.01) and max(xi) == pytest.approx(high, abs=0.01)
        assert low - 1e-6 <= min(xi) and max(xi) <= high + 1e-6
    middles = torch.cat([PolynomialLenses().draw(rng, 3.0, 32).project(0.75) for _ in range(100)])
    # Half way to θ_max: 1/2 of the radius for k₁ alone, 1/16 for k₄ alone.
    assert 2 < middles.min() < 6 and 10 < middles.max() < 16


def test_sweeps():
    assert parse_sweep("0:1:0.1") == [f"{k / 10:g}" for k in range(11)]
    assert parse_sweep("0:1:0.05")[-1] == "1" and len(parse_sweep("0:1:0.05")) == 21
    assert parse_sweep(["very low", "0.4", "0:1:0.5"]) == ["very low", "0.4", "0", "0.5", "1"]
    assert parse_sweep("low, high,polynomial") == ["low", "high", "polynomial"]


def test_wrong_names():
    for text in ("lowest", "0.1..", "0.5..0.1", "-0.1", "1..2..3", "nan", ""):
        refused(r"lenses must be one of|ξ must be", parse_lenses, text)
    for text in ("0:1", "1:0:0.1", "0:1:0", "lowest"):
        refused(r"sweep|lenses must be", parse_sweep, text)
    refused("ξ must be 0 ≤ low ≤ high", SphericalLenses, 0.5, 0.1)


# -- pictures ---------------------------------------------------------------------------------


def smooth(size=384):
    """A picture of slow waves."""
    y, x = np.mgrid[:size, :size] / size
    waves = [np.sin(6 * x + k) * np.cos(5 * y - k) for k in range(3)]
    return (127 + 100 * np.stack(waves, -1)).astype(np.uint8)


def assert_same(lens, other):
    """Lenses that differ by rounding."""
    assert type(lens) is type(other)
    for name in lens.names:
        torch.testing.assert_close(getattr(lens, name), getattr(other, name), rtol=1e-6, atol=1e-6)


def of(picture, lenses, **options):
    channels = 3 if picture.ndim == 3 and picture.shape[2] == 3 else 1
    return WideAngle(Arrays(picture[None], np.array([0]), ["a"], channels), lenses, **options)


def test_an_image_is_the_warp_of_the_picture_reduced():
    assert IMAGENET_MEAN == (0.485, 0.456, 0.406) and IMAGENET_STD == (0.229, 0.224, 0.225)
    assert math.degrees(PAPER_FOV) == pytest.approx(174.6324, abs=1e-4)
    image, lens, label = of(smooth(), SphericalLenses(0.6, 0.6))[0]
    assert image.shape == (3, 64, 64) and image.dtype == torch.float32 and label == 0
    assert isinstance(lens, Spherical) and lens.r_max.item() == pytest.approx(32, rel=1e-5)
    camera = Perspective.from_fov(PAPER_FOV, 192)
    fisheye = Spherical.from_fov(0.6, PAPER_FOV, 256)
    large = warped(smooth(), camera, fisheye, (512, 512))
    expected = cv2.resize(large, (64, 64), interpolation=cv2.INTER_AREA)
    mean, std = (torch.tensor(t)[:, None, None] for t in (IMAGENET_MEAN, IMAGENET_STD))
    got = 255 * (image * std + mean).permute(1, 2, 0).numpy()
    y, x = np.mgrid[:64, :64] - 31.5
    inside = np.hypot(x, y) < 28
    assert np.abs(got - expected)[inside].mean() < 1.5
    assert np.abs(got)[np.hypot(x, y) > 33].max() < 1e-3  # black


@pytest.mark.parametrize(("size", "render"), [(64, 224), (15, 31)])
@pytest.mark.parametrize("distribution", [SphericalLenses(0, 1), PolynomialLenses()])
def test_a_picture_is_rendered_once_for_each_pixel_and_reduced(size, render, distribution):
    dataset = of(smooth(40), distribution, size=size, render=render)
    large = dataset._read(Draw(0, 0, 0))
    expected = warped(smooth(40), Perspective.from_fov(PAPER_FOV, 20), large.lens, (render,) * 2)
    y, x = np.mgrid[:render, :render] - (render - 1) / 2
    clear = np.abs(np.hypot(x, y) - render / 2) > 1  # the rim is seen or not, by rounding
    assert np.abs(large.image.astype(int) - expected)[clear].max() <= 2
    assert_same(large.lens.resized((size, size)), dataset[0][1])


@pytest.mark.parametrize("turn", [Turn(0.0, True), Turn(0.7, False), Turn(-2.5, True)])
def test_a_picture_turns_in_its_map(turn):
    class Always(RandomTurns):
        def draw(self, rng):
            return turn

    picture = blob((40.0, 25.0), (64, 64), 3.0)
    options = dict(size=48, render=96, fov=2.0, mean=[0], std=[1])
    before, after = (
        (255 * of(picture, SphericalLenses(0, 1), turns=turns, **options)[0][0]).numpy()
        for turns in (None, Always())
    )
    before, after = before.transpose(1, 2, 0), after.transpose(1, 2, 0)
    middle = torch.tensor([23.5, 23.5])
    moved = torch.from_numpy(turn.matrix).float() @ (centroid(before) - middle)
    torch.testing.assert_close(centroid(after) - middle, moved, atol=0.15, rtol=0)
    # No second interpolation: a mirrored image has the same pixels, up to the map's rounding.
    if turn.angle == 0:
        np.testing.assert_allclose(after[:, ::-1], before, atol=1.01)


def test_an_image_is_warped_again_as_another_lens_had_seen_it():
    same = dict(fov=2.8, mean=[0] * 3, std=[1] * 3)
    other = SphericalLenses(0.8, 0.8)
    image, lens, _ = of(smooth(), SphericalLenses(0, 0.05), lens_augmentation=other, **same)[0]
    expected, there, _ = of(smooth(), other, **same)[0]
    assert_same(lens, there.replace(center=lens.center, image_size=lens.image_size))
    y, x = np.mgrid[:64, :64] - 31.5
    inside = torch.from_numpy(np.hypot(x, y) < 30)
    error = 255 * (image - expected)[:, inside].abs()
    assert error.mean() < 1 and error.max() < 6


def test_both_lenses_of_an_image_are_drawn_independently():
    dataset = of(smooth(40), SphericalLenses(0, 1), lens_augmentation=SphericalLenses(0, 1))
    draws = [Draw(0, 0, k) for k in range(40)]
    own = [dataset._lens_alone(draw).xi.item() for draw in draws]
    other = [dataset._view(dataset._lens_alone(draw), draw).lens.xi.item() for draw in draws]
    assert abs(np.corrcoef(own, other)[0, 1]) < 0.5 and np.ptp(own) > 0.8 < np.ptp(other)


@pytest.mark.parametrize(("fit", "left_is_black"), [("crop", True), ("stretch", False)])
def test_pictures_that_are_not_square(fit, left_is_black):
    wide = np.zeros((40, 80, 1), np.uint8)
    wide[:, :20] = 255  # cut off by "crop"
    options = dict(size=16, render=16, fov=1.5, fit=fit, mean=[0], std=[1])
    image = of(wide, SphericalLenses(0, 0), **options)[0][0][0]
    assert (image[8, 1].item() == 0) == left_is_black


def test_large_pictures_are_reduced_first():
    picture = cv2.resize(smooth(), (1000, 1000))
    large, reduced = (
        of(picture, SphericalLenses(0.5, 0.5), picture_size=side)[0][0] for side in (1000, 384)
    )
    assert 0 < (large - reduced).abs().mean() < 0.02


def test_wrong_options():
    for options, message in (
        (dict(size=64, render=32), "0 < size ≤ render"),
        (dict(fov=4.0), r"fov must be in \(0, π\)"),
    ):
        refused(message, of, smooth(8), SphericalLenses(0, 1), **options)
