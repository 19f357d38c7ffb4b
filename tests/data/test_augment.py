import numpy as np
import pytest
from PIL import Image

from darswin.data.augment import OPERATIONS, RandAugment, RandomErasing


def image(channels=3, seed=0):
    return np.random.default_rng(seed).integers(256, size=(20, 24, channels), dtype=np.uint8)


def apply(name, picture, magnitude, draw=0.0):
    """An operation with a generator whose random number is `draw`."""

    class Fixed:
        def random(self):
            return draw

    return np.asarray(OPERATIONS[name](Image.fromarray(picture), magnitude, Fixed()))


def test_the_ten_operations_of_the_recipe_at_magnitude_nine():
    x = image()
    assert len(OPERATIONS) == 10
    assert np.array_equal(apply("invert", x, 9), 255 - x)
    assert np.array_equal(apply("posterize", x, 9), x & 0x80)  # 1 bit
    assert np.array_equal(apply("solarize", x, 9), np.where(x < 26, x, 255 - x))
    brighter = np.where(x < 128, np.minimum(x.astype(int) + 99, 255), x)
    assert np.array_equal(apply("solarize_add", x, 9), brighter)
    for draw, factor in ((0.0, 1.81), (0.9, 0.19)):
        expected = np.clip(x * factor, 0, 255)
        assert np.abs(apply("brightness", x, 9, draw) - expected).max() <= 1
    mean = round(np.asarray(Image.fromarray(x).convert("L")).mean())
    expected = np.clip(mean + 1.81 * (x.astype(float) - mean), 0, 255)
    assert np.abs(apply("contrast", x, 9) - expected).max() <= 1
    low = np.full((4, 4, 3), 100, np.uint8)
    low[0] = 50
    assert set(np.unique(apply("auto_contrast", low, 9))) <= {0, 254, 255}
    assert apply("equalize", x // 4, 9).max() > 200


def test_stronger_is_stronger():
    x = image()
    for name in ("color", "contrast", "brightness", "sharpness"):
        change = [np.abs(apply(name, x, m).astype(int) - x).mean() for m in (0, 3, 9)]
        assert change[0] == 0 < change[1] < change[2]
    assert len(np.unique(apply("posterize", x, 10))) == 2  # never black altogether


@pytest.mark.parametrize("channels", [1, 3])
def test_rand_augment_keeps_shape_and_geometry(channels):
    x = image(channels)
    x[:, 12:] = 128  # a half in which nothing is
    augment = RandAugment()
    changed = 0
    for seed in range(200):
        out = augment(x, np.random.default_rng(seed))
        assert out.shape == x.shape and out.dtype == np.uint8
        assert len(np.unique(out[:, 14:], axis=1)) == 20  # sharpness mixes one column over the edge
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
    x = image()
    pairs = 0
    for seed in range(2000):
        before = len(applied)
        RandAugment(p=1.0)(x, np.random.default_rng(seed))
        (first, _), (second, _) = applied[before:]
        pairs += first == second
    assert 150 < pairs < 250  # one in ten
    names, magnitudes = zip(*applied, strict=True)
    counts = [names.count(name) for name in OPERATIONS]
    assert min(counts) > 300 and max(counts) < 500
    assert np.mean(magnitudes) == pytest.approx(9, abs=0.05) and max(magnitudes) == 10
    assert np.std(magnitudes) == pytest.approx(0.5, abs=0.03)


def test_erasing():
    erase = RandomErasing(p=1.0)
    shares, aspects = [], []
    for seed in range(500):
        out = erase(np.full((3, 40, 40), 9.0, np.float32), np.random.default_rng(seed))
        y, x = np.nonzero((out != 9).all(0))
        box = out[:, y.min() : y.max() + 1, x.min() : x.max() + 1]
        assert box.shape[1] * box.shape[2] == len(y) and abs(box.mean()) < 0.6
        shares.append(len(y) / 1600)
        aspects.append(box.shape[1] / box.shape[2])
    assert 0.015 < min(shares) < 0.04 and 0.3 < max(shares) < 0.36
    assert min(aspects) < 0.4 and max(aspects) > 2.5 and 0.8 < np.exp(np.log(aspects).mean()) < 1.25


def test_erasing_only_sometimes():
    erase = RandomErasing(p=0.25)
    hit = sum(
        (erase(np.zeros((1, 16, 16), np.float32), np.random.default_rng(s)) != 0).any()
        for s in range(800)
    )
    assert 150 < hit < 250
