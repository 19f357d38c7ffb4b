import numpy as np
import pytest
import torch
from helpers import refused
from PIL import Image

from darswin.data.augment import OPERATIONS, Mixing, RandAugment, RandomErasing, partners_share
from darswin.lens import Spherical


def image(channels=3, seed=0):
    return np.random.default_rng(seed).integers(256, size=(20, 24, channels), dtype=np.uint8)


class Fixed:
    """A generator whose random number is always the same."""

    def __init__(self, draw):
        self.random = lambda: draw


def apply(name, picture, magnitude, draw=0.0):
    return np.asarray(OPERATIONS[name](Image.fromarray(picture), magnitude, Fixed(draw)))


def test_the_ten_operations_of_the_recipe_at_magnitude_nine():
    x = image()
    assert len(OPERATIONS) == 10
    assert np.array_equal(apply("invert", x, 9), 255 - x)
    assert np.array_equal(apply("posterize", x, 9), x & 0x80)  # 1 bit
    assert len(np.unique(apply("posterize", x, 10))) == 2  # never black altogether
    assert np.array_equal(apply("solarize", x, 9), np.where(x < 26, x, 255 - x))
    brighter = np.where(x < 128, np.minimum(x.astype(int) + 99, 255), x)
    assert np.array_equal(apply("solarize_add", x, 9), brighter)
    mean = round(np.asarray(Image.fromarray(x).convert("L")).mean())
    for name, middle in (("brightness", 0), ("contrast", mean)):
        for draw, factor in ((0.0, 1.81), (0.9, 0.19)):
            expected = np.clip(middle + factor * (x.astype(float) - middle), 0, 255)
            assert np.abs(apply(name, x, 9, draw) - expected).max() <= 1
    low = np.full((4, 4, 3), 100, np.uint8)
    low[0] = 50
    assert set(np.unique(apply("auto_contrast", low, 9))) <= {0, 254, 255}
    assert apply("equalize", x // 4, 9).max() > 200
    for name in ("color", "sharpness"):
        change = [np.abs(apply(name, x, m).astype(int) - x).mean() for m in (0, 3, 9)]
        assert change[0] == 0 < change[1] < change[2]


@pytest.mark.parametrize("channels", [1, 3])
def test_rand_augment_keeps_shape_and_geometry(channels):
    x = image(channels)
    x[:, 12:] = 128  # a half in which nothing is
    changed = 0
    for seed in range(200):
        out = RandAugment()(x, np.random.default_rng(seed))
        assert out.shape == x.shape and out.dtype == np.uint8
        # Sharpness mixes one column over the edge.
        assert np.ptp(out[2:-2, 14:].astype(int), axis=(0, 1)).max() == 0
        changed += not np.array_equal(out, x)
    # With p = 1/2 twice, a quarter stays; and some operations change nothing here.
    assert 110 < changed < 170


def test_rand_augment_draws_with_replacement_and_a_random_strength(monkeypatch):
    applied = []
    for name in OPERATIONS:
        monkeypatch.setitem(
            OPERATIONS, name, lambda image, m, rng, name=name: applied.append((name, m)) or image
        )
    for seed in range(2000):
        RandAugment(p=1.0)(image(), np.random.default_rng(seed))
    names, magnitudes = zip(*applied, strict=True)
    assert 150 < np.sum(np.array(names[::2]) == np.array(names[1::2])) < 250  # one in ten
    counts = [names.count(name) for name in OPERATIONS]
    assert len(names) == 4000 and min(counts) > 300 and max(counts) < 500
    assert np.mean(magnitudes) == pytest.approx(9, abs=0.05) and max(magnitudes) == 10
    assert np.std(magnitudes) == pytest.approx(0.5, abs=0.03)


def test_erasing():
    shares, aspects = [], []
    for seed in range(500):
        picture = np.full((3, 40, 40), 9.0, np.float32)
        out = RandomErasing(p=1.0)(picture, np.random.default_rng(seed))
        y, x = np.nonzero((out != 9).all(0))
        box = out[:, y.min() : y.max() + 1, x.min() : x.max() + 1]
        assert box.shape[1] * box.shape[2] == len(y) and abs(box.mean()) < 0.6
        shares.append(len(y) / 1600)
        aspects.append(box.shape[1] / box.shape[2])
    assert 0.015 < min(shares) < 0.04 and 0.3 < max(shares) < 0.36
    assert min(aspects) < 0.4 and max(aspects) > 2.5 and 0.8 < np.exp(np.log(aspects).mean()) < 1.25
    erase, black = RandomErasing(p=0.25), np.zeros((1, 16, 16), np.float32)
    erased = sum(erase(black.copy(), np.random.default_rng(seed)).any() for seed in range(800))
    assert 150 < erased < 250


# -- mixing -----------------------------------------------------------------------------------


def batch(count=6):
    images = torch.arange(count, dtype=torch.float32)[:, None, None, None].expand(-1, 3, 20, 30)
    return images.clone(), torch.eye(count)


@pytest.mark.parametrize("count", [6, 5])
def test_mixup_mixes_images_as_labels(count):
    images, targets = batch(count)
    shares = []
    for seed in range(300):
        mixed, labels = Mixing(0.8, 0)(images, targets, np.random.default_rng(seed))
        share = labels[0, 0].item()
        shares.append(share)
        assert torch.allclose(labels.sum(1), torch.ones(count))
        assert torch.allclose(labels[0, -1], torch.tensor(1 - share), atol=1e-6)
        expected = labels @ torch.arange(count, dtype=torch.float32)
        assert torch.allclose(mixed, expected[:, None, None, None].expand_as(mixed), atol=1e-5)
    # Beta(0.8, 0.8): mean 1/2, variance 1 / (4 · 2.6).
    assert np.mean(shares) == pytest.approx(0.5, abs=0.06)
    assert np.var(shares) == pytest.approx(1 / 10.4, rel=0.2)


def test_cutmix_labels_give_the_share_of_the_box():
    images, targets = batch()
    for seed in range(100):
        mixed, labels = Mixing(0, 1.0)(images, targets, np.random.default_rng(seed))
        inside = mixed[0, 0] == 5
        assert ((mixed[0, 0] == 0) | inside).all()
        assert labels[0, 5].item() == pytest.approx(inside.float().mean().item(), abs=1e-6)
        if inside.any():
            y, x = inside.nonzero().T
            assert inside.sum() == (y.max() - y.min() + 1) * (x.max() - x.min() + 1)


def test_how_often_each_mixes():
    images, targets = batch()
    before = images.clone()
    kinds = {"cut": 0, "mixed": 0, "none": 0}
    for seed in range(1000):
        mixed, _ = Mixing(0.8, 1.0, p=0.5)(images, targets, np.random.default_rng(seed))
        first = mixed[0].unique()
        kinds["none" if first.equal(torch.zeros(1)) else "cut" if 5 in first else "mixed"] += 1
    # A box may be empty.
    assert 450 < kinds["none"] < 600 and 180 < kinds["cut"] < 280 and 200 < kinds["mixed"] < 300
    assert torch.equal(images, before)
    mixed, labels = Mixing(0, 0)(images, targets, np.random.default_rng(0))
    assert mixed is images and labels is targets
    for wrong in (dict(p=2), dict(p=-1), dict(mixup=-1), dict(cutmix=-1)):
        refused("mixing needs", Mixing, **wrong)


@pytest.mark.parametrize("options", [dict(mixup=1.0, cutmix=0.0), dict(mixup=0.0, cutmix=1.0)])
def test_images_of_different_lenses_stay_as_they_are(options):
    images, targets = torch.rand(6, 1, 8, 8), torch.eye(6)
    may_mix = partners_share(Spherical([0.1, 0.2, 0.3, 0.3, 0.2, 0.4], 9.0))
    assert may_mix.tolist() == [False, True, True, True, True, False]
    mixed = Mixing(**options)(images, targets, np.random.default_rng(0), may_mix)
    every = Mixing(**options)(images, targets, np.random.default_rng(0))
    for some, all_of, before in zip(mixed, every, (images, targets), strict=True):
        assert torch.equal(some[may_mix], all_of[may_mix])
        assert torch.equal(some[~may_mix], before[~may_mix])
    assert not torch.equal(every[1][~may_mix], targets[~may_mix])
