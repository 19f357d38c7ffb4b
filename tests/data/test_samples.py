"""Properties of every data set, and pictures that calibrated cameras took."""

import json

import cv2
import numpy as np
import pytest
import torch
from helpers import slow_but
from lens_pictures import CALIBRATIONS, WOODSCAPE, at_size, warped, write_frames
from PIL import ExifTags, Image
from scenes import write_plain
from torch.utils.data import DataLoader

from darswin.data import (
    IGNORE,
    Calibrations,
    RandAugment,
    RandomTurns,
    SceneSamples,
    SphericalLenses,
    WideAngle,
    open_scenes,
    open_source,
)
from darswin.data.order import TrainingOrder
from darswin.data.pictures import Arrays
from darswin.data.samples import Calibrated, Draw
from darswin.lens import Equidistant, Spherical, Tabulated, load
from darswin.lens.orientation import in_upright_picture
from darswin.utils.image import BrokenImageError, read_oriented

GREY = dict(size=24, mean=[0], std=[1])
LENSES = SphericalLenses(0.2, 1)
OTHERS = GREY | dict(lens_augmentation=LENSES)
EQUIDISTANT = {"model": "Equidistant", "focal": 30.0, "theta_max": 1.5}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Frames of two cameras, and scenes of two lens models."""
    root = tmp_path_factory.mktemp("data")
    write_frames(root / "frames", count=12, classes="01")
    cameras = {".": str(WOODSCAPE), "1": EQUIDISTANT, "0": {"file": str(WOODSCAPE)}}
    (root / "lenses.json").write_text(json.dumps(cameras))
    for name in "ab":
        write_plain(root / "scenes", 4, name=f"{name}/{{}}".format)
    cameras = {"images/a": str(WOODSCAPE), "images/b": EQUIDISTANT | {"focal": 60.0}}
    (root / "scenes" / "lens.json").write_text(json.dumps(cameras))
    return root


def frames(root, **options):
    return open_source(root / "frames", "train", channels=1, holdout=0, **options)


DATASETS = {
    "wide": lambda root, **o: WideAngle(frames(root), LENSES, render=48, **GREY | o),
    "calibrated": lambda root, **o: Calibrated(
        frames(root), Calibrations(root / "lenses.json", root / "frames"), **GREY | o
    ),
    "labels": lambda root, **o: SceneSamples(
        open_scenes(root / "scenes", "all", "labels", channels=1), **GREY | o
    ),
    "distance": lambda root, **o: SceneSamples(
        open_scenes(root / "scenes", "all", "distance", channels=1), crop=0.5, **GREY | o
    ),
    "labels, other lenses": lambda root, **o: SceneSamples(
        open_scenes(root / "scenes", "all", "labels", channels=1), **OTHERS | o
    ),
    "wide, other lenses": lambda root, **o: DATASETS["wide"](root, **OTHERS | o),
    "calibrated, other lenses": lambda root, **o: DATASETS["calibrated"](root, **OTHERS | o),
}
RANDOM = dict(turns=RandomTurns(True, 180), augment=RandAugment())


def same(one, other):
    equal = torch.equal(one[0], other[0]) and str(one[1]) == str(other[1])
    return equal and torch.equal(torch.as_tensor(one[2]), torch.as_tensor(other[2]))


@pytest.mark.parametrize("name", DATASETS)
def test_a_sample_depends_on_its_draw_alone(folders, name):
    dataset, again = (DATASETS[name](folders, **RANDOM) for _ in range(2))
    draw = Draw(3, 2, 5)
    first = dataset[draw]
    for k in range(4):
        again[k]
    assert same(first, again[draw]) and same(dataset[4], dataset[Draw(0, 4, 4)])
    for other in (
        dataset[Draw(4, 2, 5)],
        dataset[Draw(3, 2, 4)],
        DATASETS[name](folders, seed=1, **RANDOM)[draw],
    ):
        assert not torch.equal(first[0], other[0])
    still = DATASETS[name](folders)[draw]
    assert same(DATASETS[name](folders, turns=RandomTurns())[draw], still)  # off
    # Its own key draws the lens, whatever the picture.
    if name in ("wide", "wide, other lenses", "labels, other lenses"):
        assert str(dataset[Draw(3, 1, 5)][1]) == str(first[1])
        assert str(dataset[Draw(4, 2, 5)][1]) != str(first[1]) != str(dataset[Draw(3, 2, 4)][1])


@pytest.mark.parametrize("name", slow_but(DATASETS, "wide", "labels"))
def test_samples_are_the_same_for_any_number_of_workers(folders, name, threads):
    batches = []
    for workers, count in ((0, 1), (0, 2), (1, 1), (2, 1)):
        threads(count)
        dataset = DATASETS[name](folders, **RANDOM)
        order = TrainingOrder(
            8, 4, rank=0, world=1, cameras=None if name.startswith("wide") else dataset.cameras
        )
        batches.append(list(DataLoader(dataset, 4, sampler=order, num_workers=workers)))
    assert len(batches[0]) == 2 and len(batches[0][0][1]) == 4
    for other in batches[1:]:
        assert all(same(a, b) for a, b in zip(batches[0], other, strict=True))


def test_workers_do_not_hang_after_opencv_ran_on_several_threads(folders):
    cv2.setNumThreads(4)
    cv2.GaussianBlur(np.zeros((2000, 2000, 3), np.uint8), (31, 31), 5)  # starts its threads
    batches = DataLoader(DATASETS["wide"](folders), 5, num_workers=1, timeout=300)
    assert len(next(iter(batches))[0]) == 5 and cv2.getNumThreads() == 1


def test_augmentation_differs_from_image_to_image_and_epoch_to_epoch(folders):
    def noise(image, rng):
        return (image * 0 + rng.integers(256)).astype(np.uint8)

    dataset = DATASETS["wide"](
        folders, augment=noise, erase=lambda image, rng: image + rng.random()
    )
    drawn = [dataset[Draw(e, i, i)][0] for e in range(3) for i in range(5)]
    assert all(image.unique().numel() == 1 for image in drawn)
    assert len({image[0, 0, 0].item() for image in drawn}) > 12


@pytest.mark.parametrize("name", DATASETS)
def test_a_picture_that_cannot_be_read(folders, name):
    intact = DATASETS[name](folders)
    lens = intact[1][1]
    broken = intact.source.file(1)
    content = broken.read_bytes()
    try:
        broken.write_bytes(b"nothing")
        with pytest.raises(BrokenImageError, match=broken.name):
            intact[1]
        options = dict(mean=[0.4], std=[0.2], skip_broken=True)
        dataset = DATASETS[name](folders, **options)
        for _ in range(2):
            images, lenses, labels = next(iter(DataLoader(dataset, 8, num_workers=1)))
            assert (images[1] == np.float32(-0.4) / np.float32(0.2)).all() and len(lenses) == 8
            assert not (images[0] == images[1]).all()
        assert dataset.broken == [1]  # counted once, though a worker saw it twice
        nothing = {"labels": IGNORE, "distance": 0}.get(name.split(",")[0], -1)
        assert (labels[1] == nothing).all() and not (labels[0] == nothing).all()
    finally:
        broken.write_bytes(content)
    if name != "distance":  # a random part has another lens
        torch.testing.assert_close(lenses[1].project(0.5), lens.project(0.5), rtol=0.01, atol=0)


def test_unknown_fits(folders):
    with pytest.raises(ValueError, match="`fit` must be 'crop' or 'stretch', got 'whole'"):
        DATASETS["wide"](folders, fit="whole")


@pytest.mark.parametrize("name", DATASETS)
def test_by_default_pictures_with_a_lens_are_kept_whole(folders, name):
    dataset, cropped = DATASETS[name](folders), DATASETS[name](folders, fit="crop")
    calibrated = "wide" not in name
    assert dataset.fit == ("stretch" if calibrated else "crop")
    assert DATASETS[name](folders, fit="stretch").cut_off() is None
    lost = cropped.cut_off()
    assert (dataset.cut_off() is None) == calibrated
    assert lost.startswith("19 px at the left and 20 px at the right of pictures of 160×121 px")
    assert ("off its axis" in lost) == calibrated


# -- calibrated pictures ----------------------------------------------------------------------


@pytest.mark.parametrize("fit", ["crop", "stretch"])
def test_a_sample_is_the_picture_at_the_size_with_its_lens(folders, fit):
    dataset = Calibrated(frames(folders), Calibrations(WOODSCAPE), fit=fit, **GREY)
    image, lens, label = dataset[3]
    picture = cv2.imread(str(dataset.source.file(3)), cv2.IMREAD_GRAYSCALE)[..., None]
    expected, there = at_size(picture, load(WOODSCAPE).in_picture(picture.shape[:2]), 24, fit)
    assert image.shape == (1, 24, 24) and image.dtype == torch.float32
    np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
    assert str(lens) == str(there) and label == int(dataset.source.file(3).parent.name)
    assert same(dataset[3], dataset[Draw(4, 3, 7)])  # nothing is random


def test_a_large_picture_is_reduced_by_area(tmp_path):
    noise = np.random.default_rng(0).integers(256, size=(960, 960, 1), dtype=np.uint8)
    own = Equidistant.from_fov(2.8, 480.0)
    write_plain(tmp_path, 1, lens=own, size=(960, 960))
    cv2.imwrite(str(tmp_path / "images" / "000.png"), noise)
    calibrations = Calibrations(tmp_path / "lens.json")
    means = noise.reshape(24, 40, 24, 40).mean((1, 3))  # 40 × 40 px become one
    for dataset in (
        Calibrated(Arrays(noise[None, ..., 0], np.array([0]), ["a"], 1), calibrations, **GREY),
        SceneSamples(open_scenes(tmp_path, "all", "labels", channels=1), **GREY),
    ):
        np.testing.assert_allclose(255 * dataset[0][0][0].numpy(), means, atol=0.51)


def test_a_picture_as_another_lens_had_seen_it(folders):
    own = load(WOODSCAPE)
    dataset = Calibrated(frames(folders), Calibrations(WOODSCAPE), **OTHERS)
    image, lens, label = dataset[3]
    picture = dataset.source[3][0]
    assert label == dataset.source[3][1] and isinstance(lens, Spherical)
    assert lens.theta_max.item() == pytest.approx(own.theta_max.item(), rel=1e-5)
    own = own.in_picture(picture.shape[:2])
    large = warped(picture, own, lens.resized((192, 192)), (192, 192))
    expected = cv2.resize(large, (24, 24), interpolation=cv2.INTER_AREA)
    assert np.abs(255 * image[0].numpy() - expected).mean() < 3
    assert str(dataset[Draw(1, 3, 3)][1]) != str(lens)  # another lens in each epoch


def test_exif_turns_picture_and_lens(tmp_path):
    write_frames(tmp_path / "frames", count=3)
    file = next((tmp_path / "frames").rglob("*.png"))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.open(file).save(file.with_suffix(".jpg"), exif=exif)
    file.unlink()
    dataset = Calibrated(frames(tmp_path), Calibrations(WOODSCAPE), **GREY)
    number = [dataset.source.file(k).suffix for k in range(3)].index(".jpg")
    picture, orientation = read_oriented(file.with_suffix(".jpg"), 1)
    assert orientation == 6 and picture.shape == (160, 121, 1)
    turned = in_upright_picture(load(WOODSCAPE), (160, 121), 6)
    expected, lens = at_size(picture, turned, 24, "stretch")
    image, got, _ = dataset[number]
    np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
    assert str(got) == str(lens)


def test_cameras_of_several_models_make_one_batch(folders):
    dataset = DATASETS["calibrated"](folders)
    labels = [dataset.source[k][1] for k in range(len(dataset))]
    assert dataset.cameras.tolist() == [int(label == 1) for label in labels]
    _, lenses, _ = next(iter(DataLoader(dataset, len(dataset))))
    assert isinstance(lenses, Tabulated) and len(lenses) == len(dataset)


def test_partners_turn_together_and_share_a_lens_with_tangential_terms():
    file = CALIBRATIONS / "ros_plumb_bob.yaml"
    size = tuple(int(side) for side in load(file).image_size[0])
    images = np.zeros((4, *size, 1), np.uint8)
    images[:, : size[0] // 2, : size[1] // 2] = 255
    source = Arrays(images, np.arange(4), list("abcd"), 1)
    turns = RandomTurns(True, 180)
    for dataset in (
        Calibrated(source, Calibrations(file), turns=turns, **GREY),
        WideAngle(source, LENSES, turns=turns, **GREY),
    ):
        samples = [dataset[draw] for draw in TrainingOrder(4, 4, rank=0, world=1)]
        for one, other in zip(samples, samples[::-1], strict=True):
            assert same((*one[:2], 0), (*other[:2], 0))
        assert len({str(lens) for _, lens, _ in samples}) == 2
        assert not torch.equal(samples[0][0], samples[1][0])
