import math

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from darswin.data import PolynomialLenses, SphericalLenses, WideAngle, warp
from darswin.data.pictures import Arrays, ImageFiles
from darswin.data.samples import IMAGENET_MEAN, IMAGENET_STD, Draw
from darswin.data.wide_angle import PAPER_FOV
from darswin.lens import Perspective, Spherical
from darswin.lens.pixels import OUTSIDE, reprojection
from darswin.utils.image import BrokenImageError


def smooth(size=384):
    """A picture of slow waves."""
    y, x = np.mgrid[:size, :size] / size
    waves = [np.sin(6 * x + k) * np.cos(5 * y - k) for k in range(3)]
    return (127 + 100 * np.stack(waves, -1)).astype(np.uint8)


def pictures(count=5, size=40, channels=3):
    rng = np.random.default_rng(0)
    images = rng.integers(256, size=(count, size, size, channels), dtype=np.uint8)
    return Arrays(images, np.arange(count), [str(k) for k in range(count)], channels)


def test_the_paper_s_field_of_view():
    assert math.degrees(PAPER_FOV) == pytest.approx(174.6324, abs=1e-4)


def test_an_image_is_the_warp_of_the_picture_reduced():
    source = Arrays(smooth()[None], np.array([0]), ["a"])
    dataset = WideAngle(source, SphericalLenses(0.6, 0.6))
    image, lens, label = dataset[0]
    assert image.shape == (3, 64, 64) and image.dtype == torch.float32 and label == 0
    assert isinstance(lens, Spherical) and lens.r_max.item() == pytest.approx(32, rel=1e-5)
    camera = Perspective.from_fov(PAPER_FOV, 192)
    large = warp(smooth(), camera, Spherical.from_fov(0.6, PAPER_FOV, 256), (512, 512))
    expected = cv2.resize(large, (64, 64), interpolation=cv2.INTER_AREA)
    mean, std = (torch.tensor(t)[:, None, None] for t in (IMAGENET_MEAN, IMAGENET_STD))
    got = 255 * (image * std + mean).permute(1, 2, 0).numpy()
    y, x = np.mgrid[:64, :64] - 31.5
    inside = np.hypot(x, y) < 28
    assert np.abs(got - expected)[inside].mean() < 1.5
    assert np.abs(got)[np.hypot(x, y) > 33].max() < 1e-3  # black


@pytest.mark.parametrize(("size", "render"), [(64, 224), (15, 31)])
@pytest.mark.parametrize("distribution", [SphericalLenses(0, 1), PolynomialLenses()])
def test_the_map_of_a_lens_is_the_reprojection(size, render, distribution):
    dataset = WideAngle(pictures(), distribution, size=size, render=render)
    lens = dataset[0][1]
    larger = lens.resized(render / size)
    camera = Perspective.from_fov(PAPER_FOV, 20)
    expected = reprojection(camera, (40, 40), larger, (render, render))[0].numpy()
    got = dataset._map(lens, 40)
    inside = (expected != OUTSIDE).all(-1)
    y, x = np.mgrid[:render, :render] - (render - 1) / 2
    rim = np.abs(np.hypot(x, y) - render / 2) < 0.01  # seen or not, by rounding
    np.testing.assert_allclose(got[inside & ~rim], expected[inside & ~rim], atol=2e-3)
    outside = ~inside & ~rim
    assert (got[outside] == OUTSIDE).all() and outside.any()


def test_a_sample_depends_on_its_draw_alone():
    def make(**options):
        return WideAngle(pictures(), SphericalLenses(0, 1), size=16, render=32, **options)

    dataset = make(seed=1)
    image, lens, label = dataset[3]
    dataset[0], dataset[Draw(2, 3, 3)]
    again, lens_again, _ = dataset[3]
    assert torch.equal(image, again) and torch.equal(lens.xi, lens_again.xi) and label == 3
    loaded = list(DataLoader(dataset, 2, num_workers=1))
    assert torch.equal(loaded[1][0][1], image) and len(loaded[1][1]) == 2
    others = [dataset[Draw(1, 3, 3)], dataset[Draw(0, 3, 2)], make(seed=2)[3]]
    assert all(not torch.equal(lens.xi, other[1].xi) for other in others)
    assert torch.equal(dataset[Draw(0, 1, 2)][1].xi, dataset[Draw(0, 0, 2)][1].xi)


def test_workers_do_not_hang_after_opencv_ran_on_several_threads():
    cv2.setNumThreads(4)
    cv2.GaussianBlur(np.zeros((2000, 2000, 3), np.uint8), (31, 31), 5)  # starts its threads
    dataset = WideAngle(pictures(), SphericalLenses(0, 1), size=64, render=224)
    batches = DataLoader(dataset, 5, num_workers=1, timeout=30)
    assert len(next(iter(batches))[0]) == 5 and cv2.getNumThreads() == 1


def test_augmentation_differs_from_image_to_image_and_epoch_to_epoch():
    def noise(image, rng):
        return (image * 0 + rng.integers(256)).astype(np.uint8)

    dataset = WideAngle(pictures(), SphericalLenses(0, 0), size=16, render=16, augment=noise)
    values = [dataset[Draw(e, i, i)][0][0, 0, 0].item() for e in range(3) for i in range(5)]
    assert len(set(values)) > 12

    def erase(image, rng):
        return image * 0 + rng.random()

    erased = WideAngle(pictures(), SphericalLenses(0, 0), size=16, render=16, erase=erase)
    assert erased[0][0].unique().numel() == 1


@pytest.mark.parametrize(("fit", "left_is_black"), [("crop", True), ("stretch", False)])
def test_pictures_that_are_not_square(fit, left_is_black):
    wide = np.zeros((40, 80, 1), np.uint8)
    wide[:, :20] = 255  # cut off by "crop"
    source = Arrays(wide[None], np.array([0]), ["a"], 1)
    dataset = WideAngle(
        source, SphericalLenses(0, 0), size=16, render=16, fov=1.5, framing=fit, mean=[0], std=[1]
    )
    image = dataset[0][0][0]
    assert (image[8, 1].item() == 0) == left_is_black


def test_large_pictures_are_reduced_first():
    source = Arrays(cv2.resize(smooth(), (1000, 1000))[None], np.array([0]), ["a"])
    large = WideAngle(source, SphericalLenses(0.5, 0.5), picture_size=1000)[0][0]
    reduced = WideAngle(source, SphericalLenses(0.5, 0.5))[0][0]
    assert 0 < (large - reduced).abs().mean() < 0.02


def test_broken_files(tmp_path):
    assert cv2.imwrite(str(tmp_path / "a.png"), np.full((8, 8, 3), 200, np.uint8))
    (tmp_path / "b.png").write_bytes(b"nothing")
    source = ImageFiles(tmp_path, [("a.png", 0), ("b.png", 1)], ["x", "y"])
    strict = WideAngle(source, SphericalLenses(0, 1), size=8, render=8)
    with pytest.raises(BrokenImageError, match=r"b\.png"):
        strict[1]
    dataset = WideAngle(source, SphericalLenses(0, 1), size=8, render=8, skip_broken=True)
    black = -torch.tensor(IMAGENET_MEAN)[:, None, None] / torch.tensor(IMAGENET_STD)[:, None, None]
    for _ in range(2):
        (images, lens, labels) = next(iter(DataLoader(dataset, 2, num_workers=1)))
        assert labels.tolist() == [0, -1] and len(lens) == 2 and (images[1] == black).all()
    assert dataset.broken == [1]  # counted once, though a worker saw it twice


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(size=64, render=32), "0 < size ≤ render"),
        (dict(fov=4.0), r"fov must be in \(0, π\)"),
        (dict(framing="pad"), "framing must be"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        WideAngle(pictures(), SphericalLenses(0, 1), **options)
