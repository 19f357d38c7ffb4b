"""Properties of every data set, and pictures and scenes that calibrated cameras took."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from helpers import exif_of, refused, slow_but
from lens_pictures import CALIBRATIONS, WOODSCAPE, at_size, warped, write_frames
from PIL import Image
from scenes import write_plain
from torch.utils.data import BatchSampler, DataLoader, default_collate

from darswin.data import (
    IGNORE,
    Calibrations,
    PolynomialLenses,
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
from darswin.lens import Equidistant, Polynomial, Spherical, Tabulated, load
from darswin.lens.orientation import in_upright_picture
from darswin.lens.pixels import pixel_angles
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


def scenes(root, target, **options):
    return SceneSamples(open_scenes(root / "scenes", "all", target, channels=1), **GREY | options)


DATASETS = {
    "wide": lambda root, **o: WideAngle(frames(root), LENSES, render=48, **GREY | o),
    "calibrated": lambda root, **o: Calibrated(
        frames(root), Calibrations(root / "lenses.json", root / "frames"), **GREY | o
    ),
    "labels": lambda root, **o: scenes(root, "labels", **o),
    "distance": lambda root, **o: scenes(root, "distance", crop=0.5, **o),
    "labels, other lenses": lambda root, **o: scenes(root, "labels", **OTHERS | o),
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
    another_seed = DATASETS[name](folders, seed=1, **RANDOM)
    for other in (dataset[Draw(4, 2, 5)], dataset[Draw(3, 2, 4)], another_seed[draw]):
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
        cameras = None if name.startswith("wide") else dataset.cameras
        order = TrainingOrder(8, 4, rank=0, world=1, cameras=cameras)
        batches.append(list(DataLoader(dataset, 4, sampler=order, num_workers=workers)))
    groups = BatchSampler(order, 4, drop_last=True)  # one by one, partners share no map
    batches.append([default_collate([dataset[k] for k in group]) for group in groups])
    assert len(batches[0]) == 2 and len(batches[0][0][1]) == 4
    for other in batches[1:]:
        assert all(same(a, b) for a, b in zip(batches[0], other, strict=True))


def test_workers_do_not_hang_after_opencv_ran_on_several_threads(folders):
    cv2.setNumThreads(4)
    cv2.GaussianBlur(np.zeros((2000, 2000, 3), np.uint8), (31, 31), 5)  # starts its threads
    batches = DataLoader(DATASETS["wide"](folders), 5, num_workers=1, timeout=300)
    assert len(next(iter(batches))[0]) == 5 and cv2.getNumThreads() == 1


def test_augmentation_differs_from_image_to_image_and_epoch_to_epoch(folders):
    dataset = DATASETS["wide"](
        folders,
        augment=lambda image, rng: (image * 0 + rng.integers(256)).astype(np.uint8),
        erase=lambda image, rng: image + rng.random(),
    )
    drawn = [dataset[Draw(e, i, i)][0] for e in range(3) for i in range(5)]
    assert all(image.unique().numel() == 1 for image in drawn)
    assert len({image[0, 0, 0].item() for image in drawn}) > 12


@pytest.mark.parametrize("name", DATASETS)
def test_a_picture_that_cannot_be_read(folders, name):
    intact = DATASETS[name](folders)
    lens, broken = intact[1][1], intact.source.file(1)
    content = broken.read_bytes()
    try:
        broken.write_bytes(b"nothing")
        refused(broken.name, intact.__getitem__, 1, error=BrokenImageError)
        dataset = DATASETS[name](folders, mean=[0.4], std=[0.2], skip_broken=True)
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


@pytest.mark.parametrize("name", DATASETS)
def test_by_default_pictures_with_a_lens_are_kept_whole(folders, name):
    dataset, cropped = DATASETS[name](folders), DATASETS[name](folders, fit="crop")
    calibrated = "wide" not in name
    assert dataset.fit == ("stretch" if calibrated else "crop")
    assert DATASETS[name](folders, fit="stretch").cut_off() is None
    lost = cropped.cut_off()
    assert (dataset.cut_off() is None) == calibrated
    assert lost.startswith("19 px at the left and 20 px at the right of pictures of 121 × 160 px")
    assert ("off its axis" in lost) == calibrated


def test_wrong_options(folders):
    said = "`fit` must be 'crop' or 'stretch', got 'whole'"
    refused(said, DATASETS["wide"], folders, fit="whole")
    for crop in (0.0, 1.5):
        said = rf"`crop` must be a share in \(0, 1\], got {crop}"
        refused(said, scenes, folders, "labels", crop=crop)


# -- calibrated pictures and scenes -----------------------------------------------------------


@pytest.mark.parametrize("fit", ["crop", "stretch"])
def test_a_sample_is_the_picture_at_the_size_with_its_lens(folders, fit):
    photos = Calibrated(frames(folders), Calibrations(WOODSCAPE), fit=fit, **GREY)
    file = photos.source.file(3)
    photo = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)[..., None]
    labelled, distances = (scenes(folders, kind, fit=fit) for kind in ("labels", "distance"))
    scene = labelled.scenes[3]
    for dataset, picture, camera in (
        (photos, photo, load(WOODSCAPE).in_picture(photo.shape[:2])),
        (labelled, scene.image, scene.lens),
    ):
        image, lens, target = dataset[3]
        expected, there = at_size(picture, camera, 24, fit)
        assert image.shape == (1, 24, 24) and image.dtype == torch.float32
        np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
        assert str(lens) == str(there)
        assert same(dataset[3], dataset[Draw(4, 3, 7)])  # nothing is random
    assert photos[3][2] == int(file.parent.name)
    assert target.dtype == torch.int64 and target.shape == (24, 24)
    assert set(target.unique().tolist()) <= {0, 1, 2, IGNORE}
    beyond = pixel_angles(lens, (24, 24))[0].isnan()
    assert beyond.any() and torch.equal(target == IGNORE, beyond)
    metres = distances[3][2]
    assert metres.dtype == torch.float32 and torch.equal(metres == 0, beyond)


def test_a_large_picture_is_reduced_by_area(tmp_path):
    noise = np.random.default_rng(0).integers(256, size=(960, 960, 1), dtype=np.uint8)
    write_plain(tmp_path / "scenes", 1, lens=Equidistant.from_fov(2.8, 480.0), size=(960, 960))
    cv2.imwrite(str(tmp_path / "scenes" / "images" / "000.png"), noise)
    calibrations = Calibrations(tmp_path / "scenes" / "lens.json")
    means = noise.reshape(24, 40, 24, 40).mean((1, 3))  # 40 × 40 px become one
    for dataset in (
        Calibrated(Arrays(noise[None, ..., 0], np.array([0]), ["a"], 1), calibrations, **GREY),
        scenes(tmp_path, "labels"),
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


def test_a_drawn_lens_sees_as_far_where_it_can(folders):
    own = scenes(folders, "labels").scenes[0].lens.theta_max.item()
    assert own > math.pi / 2
    dataset = scenes(folders, "labels", lens_augmentation=SphericalLenses(0.4, 1))
    for k in range(4):
        lens = dataset[k][1]
        assert lens.theta_max.item() == pytest.approx(own) and 0.4 <= lens.xi.item() <= 1
        assert lens.r_max.item() == pytest.approx(12) and lens.center.tolist() == [[11.5, 11.5]]
    perspective = scenes(folders, "labels", lens_augmentation=SphericalLenses(0, 0))[0]
    assert perspective[1].theta_max.item() == pytest.approx(0.95 * math.pi / 2, abs=1e-4)
    assert (perspective[2] != IGNORE).float().mean() > 0.5
    polynomial = scenes(folders, "labels", lens_augmentation=PolynomialLenses())[0][1]
    assert isinstance(polynomial, Polynomial) and polynomial.theta_max.item() == pytest.approx(own)


@pytest.mark.parametrize("options", [{}, {"lens_augmentation": SphericalLenses(0.5, 0.5)}])
def test_parts_have_their_principal_point_off_the_middle(folders, options):
    dataset = scenes(folders, "labels", crop=0.4, **options)
    lenses = [dataset[Draw(epoch, 0, 0)][1] for epoch in range(40)]
    centers = torch.cat([lens.center for lens in lenses])
    assert (centers - 11.5).abs().amax(0).min() > 2.5
    assert all(lens.image_size.tolist() == [[24, 24]] for lens in lenses)
    whole = scenes(folders, "labels", **options)[0][1]
    scales = torch.tensor([(lens.r_max / whole.r_max).item() for lens in lenses])
    assert 1 <= scales.min() < 1.2 and 2 < scales.max() <= 2.55


def test_unknown_pixels_that_a_worker_reads_are_counted_here(folders):
    source = open_scenes(folders / "scenes", "all", "distance").limited(4)
    assert source.unknown.tolist() == [-1] * 4 and source.file(3) != source.file(2)
    for _ in DataLoader(SceneSamples(source, size=16), 2, num_workers=1):
        pass
    assert source.unknown.tolist() == [int((scene.target == 0).sum()) for scene in source]
    refused("`limit` must be at least 1, got 0", source.limited, 0)


def test_exif_turns_picture_and_lens(tmp_path):
    write_frames(tmp_path / "frames", count=3)
    file = next((tmp_path / "frames").rglob("*.png"))
    Image.open(file).save(file.with_suffix(".jpg"), exif=exif_of(6))
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
