import json
import math

import numpy as np
import pytest
import torch
from scenes import CALIBRATIONS, write_plain, write_woodscape
from torch.utils.data import DataLoader

from darswin.data import (
    IGNORE,
    PolynomialLenses,
    SceneSamples,
    SphericalLenses,
    open_scenes,
)
from darswin.data.augment import RandAugment
from darswin.data.order import TrainingOrder
from darswin.data.samples import Draw
from darswin.data.warp import RandomTurns, at_size
from darswin.lens import Polynomial, Spherical, Tabulated
from darswin.lens.pixels import pixel_angles

RAW = dict(size=48, mean=[0], std=[1])
ALL = dict(
    turns=RandomTurns(True, 180), crop=0.5, lenses=SphericalLenses(0.2, 1), augment=RandAugment()
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_plain(tmp_path_factory.mktemp("scenes"), 6)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Three cameras of two models."""
    root = tmp_path_factory.mktemp("mixed")
    other = {"model": "Equidistant", "focal": 40.0, "theta_max": 1.3}
    for name, lens in (("a", "woodscape.json"), ("b", "synwoodscape.json")):
        write_plain(root, 2, lens=CALIBRATIONS / lens, name=f"{name}/{{}}".format)
    write_plain(root, 2, lens=CALIBRATIONS / "ours.json", size=(120, 160), name="c/{}".format)
    cameras = {"images/a": str(CALIBRATIONS / "woodscape.json"), "images/c": other,
               "images/b": str(CALIBRATIONS / "synwoodscape.json")}  # fmt: skip
    (root / "lens.json").write_text(json.dumps(cameras))
    return root


def of(folder, target="labels", **options):
    channels = len(options.get("mean", RAW["mean"]))
    return SceneSamples(open_scenes(folder, "all", target, channels=channels), **RAW | options)


def same(one, other):
    return (
        torch.equal(one[0], other[0])
        and str(one[1]) == str(other[1])
        and torch.equal(one[2], other[2])
    )


@pytest.mark.parametrize("fit", ["crop", "stretch"])
def test_a_sample_is_the_scene_at_the_size(folder, fit):
    dataset = of(folder, framing=fit)
    image, lens, labels = dataset[2]
    scene = dataset.scenes[2]
    expected, there = at_size(scene.image, scene.lens, 48, fit)
    np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
    assert str(lens) == str(there)
    assert labels.dtype == torch.int64 and labels.shape == (48, 48)
    assert set(labels.unique().tolist()) <= {0, 1, 2, IGNORE}
    beyond = pixel_angles(lens, (48, 48))[0].isnan()
    assert torch.equal(labels == IGNORE, beyond)
    distance = of(folder, "distance", framing=fit)[2][2]
    assert distance.dtype == torch.float32 and torch.equal(distance == 0, beyond)
    assert same(dataset[2], dataset[Draw(7, 2, 5)])  # nothing is random


@pytest.mark.parametrize("target", ["labels", "distance"])
def test_a_sample_depends_on_its_draw_alone(folder, target):
    dataset, again = of(folder, target, **ALL), of(folder, target, **ALL)
    draw = Draw(3, 2, 5)
    first = dataset[draw]
    for k in range(4):
        again[k]
    assert same(first, again[draw]) and same(dataset[4], dataset[Draw(0, 4, 4)])
    others = [
        dataset[Draw(4, 2, 5)],
        dataset[Draw(3, 2, 4)],
        of(folder, target, seed=1, **ALL)[draw],
    ]
    for other in others:
        assert not torch.equal(first[2], other[2]) and str(first[1]) != str(other[1])
    # The lens is drawn by its own key, whatever the picture.
    assert str(dataset[Draw(3, 1, 5)][1]) == str(first[1])


@pytest.mark.parametrize("options", [{}, ALL, ALL | {"lenses": None}])
def test_samples_are_the_same_for_any_number_of_workers(mixed, options, threads):
    batches = []
    for workers, count in ((0, 1), (0, 2), (1, 1), (2, 1)):
        threads(count)
        dataset = of(mixed, "distance", **options)
        order = TrainingOrder(6, 3, rank=0, world=1, cameras=dataset.cameras)
        loader = DataLoader(dataset, 3, sampler=order, num_workers=workers)
        batches.append(list(loader))
    assert len(batches[0]) == 2
    for other in batches[1:]:
        assert all(same(a, b) for a, b in zip(batches[0], other, strict=True))


def test_cameras_of_several_models_make_one_batch(mixed):
    scenes = open_scenes(mixed, "all", "labels")
    assert len(scenes.cameras) == 3
    assert [scenes.camera_of(k) for k in range(6)] == [0, 0, 2, 2, 1, 1]
    dataset = SceneSamples(scenes, size=32)
    assert dataset.cameras.tolist() == [0, 0, 2, 2, 1, 1]
    images, lenses, labels = next(iter(DataLoader(dataset, 6, num_workers=1)))
    assert isinstance(lenses, Tabulated) and len(lenses) == len(images) == len(labels) == 6
    assert lenses[5].theta_max.item() == pytest.approx(1.3)
    drawn = SceneSamples(scenes, size=32, lenses=SphericalLenses(0, 1))
    assert isinstance(next(iter(DataLoader(drawn, 6)))[1], Spherical)


def test_what_a_worker_reads_is_counted_here(folder):
    scenes = open_scenes(folder, "all", "distance")
    assert scenes.unknown.tolist() == [-1] * 6
    for _ in DataLoader(SceneSamples(scenes, size=16), 3, num_workers=1):
        pass
    assert scenes.unknown.tolist() == [int((scenes[0].target == 0).sum())] * 6


def test_a_drawn_lens_sees_as_far_where_it_can(folder):
    own = open_scenes(folder, "all", "labels")[0].lens.theta_max.item()
    assert own > math.pi / 2
    dataset = of(folder, lenses=SphericalLenses(0.4, 1))
    for k in range(4):
        lens = dataset[k][1]
        assert lens.theta_max.item() == pytest.approx(own) and 0.4 <= lens.xi.item() <= 1
        assert lens.r_max.item() == pytest.approx(24) and lens.center.tolist() == [[23.5, 23.5]]
    perspective = of(folder, lenses=SphericalLenses(0, 0))[0]
    assert perspective[1].theta_max.item() == pytest.approx(0.95 * math.pi / 2, abs=1e-4)
    assert (perspective[2] != IGNORE).float().mean() > 0.5
    polynomial = of(folder, lenses=PolynomialLenses())[0][1]
    assert isinstance(polynomial, Polynomial) and polynomial.theta_max.item() == pytest.approx(own)


def test_parts_have_their_principal_point_off_the_middle(folder):
    whole = of(folder)[0][1]
    for options in ({}, {"lenses": SphericalLenses(0.5, 0.5)}):
        lenses = [of(folder, crop=0.4, **options)[Draw(e, 0, 0)][1] for e in range(40)]
        centers = torch.cat([lens.center for lens in lenses])
        assert (centers - 23.5).abs().amax(0).min() > 5
        assert all(lens.image_size.tolist() == [[48, 48]] for lens in lenses)
        plain = whole if not options else of(folder, **options)[0][1]
        scales = torch.tensor([(lens.r_max / plain.r_max).item() for lens in lenses])
        assert 1 <= scales.min() < 1.2 and 2 < scales.max() <= 2.55


def test_a_broken_picture_is_black_with_a_lens_that_joins(tmp_path):
    write_woodscape(tmp_path, 4)
    broken = tmp_path / "rgb_images" / "00001_RV.png"
    broken.write_bytes(broken.read_bytes()[:500])
    for options in ({}, ALL):
        dataset = of(tmp_path, skip_broken=True, **options)
        _, lenses, labels = next(iter(DataLoader(dataset, 4)))
        assert dataset.broken == [1] and (labels[1] == IGNORE).all() and len(lenses) == 4
        assert not (labels[0] == IGNORE).all()
        expected = dataset[Draw(0, 0, 1)][1]
        if options:
            assert lenses[1].xi.item() == expected.xi.item()
        else:
            assert lenses[1].image_size.tolist() == [[48, 48]]


def test_wrong_options(folder):
    for wrong, said in (
        (dict(framing="whole"), "framing must be 'crop' or 'stretch', got 'whole'"),
        (dict(crop=0.0), r"`crop` must be a share in \(0, 1\], got 0.0"),
        (dict(crop=1.5), "`crop` must be a share"),
    ):
        with pytest.raises(ValueError, match=said):
            of(folder, **wrong)
