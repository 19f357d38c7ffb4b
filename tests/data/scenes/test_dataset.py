import math

import numpy as np
import pytest
import torch
from lens_pictures import at_size
from scenes import write_plain
from torch.utils.data import DataLoader

from darswin.data import (
    IGNORE,
    PolynomialLenses,
    SceneSamples,
    SphericalLenses,
    open_scenes,
)
from darswin.data.samples import Draw
from darswin.lens import Polynomial
from darswin.lens.pixels import pixel_angles


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_plain(tmp_path_factory.mktemp("scenes"), 6)


def of(folder, target="labels", **options):
    scenes = open_scenes(folder, "all", target, channels=1)
    return SceneSamples(scenes, size=48, mean=[0], std=[1], **options)


@pytest.mark.parametrize("fit", ["crop", "stretch"])
def test_a_sample_is_the_scene_at_the_size(folder, fit):
    dataset = of(folder, fit=fit)
    image, lens, labels = dataset[2]
    scene = dataset.scenes[2]
    expected, there = at_size(scene.image, scene.lens, 48, fit)
    np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
    assert str(lens) == str(there)
    assert labels.dtype == torch.int64 and labels.shape == (48, 48)
    assert set(labels.unique().tolist()) <= {0, 1, 2, IGNORE}
    beyond = pixel_angles(lens, (48, 48))[0].isnan()
    assert torch.equal(labels == IGNORE, beyond)
    distance = of(folder, "distance", fit=fit)[2][2]
    assert distance.dtype == torch.float32 and torch.equal(distance == 0, beyond)
    assert torch.equal(dataset[Draw(7, 2, 5)][2], labels)  # nothing is random


def test_unknown_pixels_that_a_worker_reads_are_counted_here(folder):
    scenes = open_scenes(folder, "all", "distance").limited(4)
    assert scenes.unknown.tolist() == [-1] * 4 and scenes.file(3) != scenes.file(2)
    for _ in DataLoader(SceneSamples(scenes, size=16), 2, num_workers=1):
        pass
    assert scenes.unknown.tolist() == [int((scenes[0].target == 0).sum())] * 4
    with pytest.raises(ValueError, match="`limit` must be at least 1, got 0"):
        scenes.limited(0)


def test_a_drawn_lens_sees_as_far_where_it_can(folder):
    own = open_scenes(folder, "all", "labels")[0].lens.theta_max.item()
    assert own > math.pi / 2
    dataset = of(folder, lens_augmentation=SphericalLenses(0.4, 1))
    for k in range(4):
        lens = dataset[k][1]
        assert lens.theta_max.item() == pytest.approx(own) and 0.4 <= lens.xi.item() <= 1
        assert lens.r_max.item() == pytest.approx(24) and lens.center.tolist() == [[23.5, 23.5]]
    perspective = of(folder, lens_augmentation=SphericalLenses(0, 0))[0]
    assert perspective[1].theta_max.item() == pytest.approx(0.95 * math.pi / 2, abs=1e-4)
    assert (perspective[2] != IGNORE).float().mean() > 0.5
    polynomial = of(folder, lens_augmentation=PolynomialLenses())[0][1]
    assert isinstance(polynomial, Polynomial) and polynomial.theta_max.item() == pytest.approx(own)


@pytest.mark.parametrize("options", [{}, {"lens_augmentation": SphericalLenses(0.5, 0.5)}])
def test_parts_have_their_principal_point_off_the_middle(folder, options):
    lenses = [of(folder, crop=0.4, **options)[Draw(e, 0, 0)][1] for e in range(40)]
    centers = torch.cat([lens.center for lens in lenses])
    assert (centers - 23.5).abs().amax(0).min() > 5
    assert all(lens.image_size.tolist() == [[48, 48]] for lens in lenses)
    whole = of(folder, **options)[0][1]
    scales = torch.tensor([(lens.r_max / whole.r_max).item() for lens in lenses])
    assert 1 <= scales.min() < 1.2 and 2 < scales.max() <= 2.55


def test_wrong_parts(folder):
    for crop in (0.0, 1.5):
        with pytest.raises(ValueError, match=rf"`crop` must be a share in \(0, 1\], got {crop}"):
            of(folder, crop=crop)
