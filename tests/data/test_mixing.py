import numpy as np
import pytest
import torch

from darswin.data.augment import Mixing, partners_share
from darswin.lens import Spherical


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


def test_cutmix_labels_say_how_large_the_box_is():
    images, targets = batch()
    for seed in range(100):
        mixed, labels = Mixing(0, 1.0)(images, targets, np.random.default_rng(seed))
        inside = mixed[0, 0] == 5
        assert ((mixed[0, 0] == 0) | inside).all()
        assert labels[0, 5].item() == pytest.approx(inside.float().mean().item(), abs=1e-6)
        if inside.any():
            y, x = inside.nonzero().T
            assert inside.sum() == (y.max() - y.min() + 1) * (x.max() - x.min() + 1)


def test_both_have_half_and_p_says_how_often():
    images, targets = batch()
    kinds = {"cut": 0, "mixed": 0, "none": 0}
    for seed in range(1000):
        mixed, _ = Mixing(0.8, 1.0, p=0.5)(images, targets, np.random.default_rng(seed))
        first = mixed[0].unique()
        kinds["none" if first.equal(torch.zeros(1)) else "cut" if 5 in first else "mixed"] += 1
    # A box may be empty.
    assert 450 < kinds["none"] < 600 and 180 < kinds["cut"] < 280 and 200 < kinds["mixed"] < 300


def test_off_changes_nothing_and_inputs_stay():
    images, targets = batch()
    mixed, labels = Mixing(0, 0)(images, targets, np.random.default_rng(0))
    assert mixed is images and labels is targets
    before = images.clone()
    Mixing(0.8, 1.0)(images, targets, np.random.default_rng(1))
    assert torch.equal(images, before)
    with pytest.raises(ValueError, match="mixing needs"):
        Mixing(p=2)


@pytest.mark.parametrize("options", [dict(mixup=1.0, cutmix=0.0), dict(mixup=0.0, cutmix=1.0)])
def test_images_of_different_lenses_stay_as_they_are(options):
    images, targets = torch.rand(6, 1, 8, 8), torch.eye(6)
    lens = Spherical([0.1, 0.2, 0.3, 0.3, 0.2, 0.4], 9.0)
    may_mix = partners_share(lens)
    assert may_mix.tolist() == [False, True, True, True, True, False]
    mixed, mixed_targets = Mixing(**options)(images, targets, np.random.default_rng(0), may_mix)
    every, every_target = Mixing(**options)(images, targets, np.random.default_rng(0))
    assert torch.equal(mixed[may_mix], every[may_mix])
    assert torch.equal(mixed_targets[may_mix], every_target[may_mix])
    assert torch.equal(mixed[~may_mix], images[~may_mix])
    assert torch.equal(mixed_targets[~may_mix], targets[~may_mix])
    assert not torch.equal(every_target[~may_mix], targets[~may_mix])
