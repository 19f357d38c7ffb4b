import json

import cv2
import numpy as np
import pytest
import torch
from frames import WOODSCAPE, write_frames
from PIL import ExifTags, Image
from torch.utils.data import DataLoader

from darswin.data import Calibrated, Calibrations, open_source
from darswin.data.pictures import Arrays
from darswin.data.samples import Draw
from darswin.data.warp import at_size
from darswin.lens import Tabulated, load
from darswin.lens.orientation import in_upright_picture
from darswin.utils.image import BrokenImageError, read_oriented

PLAIN = dict(size=32, mean=[0], std=[1])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("data") / "frames", count=20)


def of(folder, lens=WOODSCAPE, **options):
    source = open_source(folder, "train", channels=1)
    return Calibrated(source, Calibrations(lens, folder), **PLAIN | options)


@pytest.mark.parametrize("fit", ["crop", "stretch"])
def test_a_sample_is_the_picture_at_the_size_with_its_lens(folder, fit):
    dataset = of(folder, framing=fit)
    image, lens, label = dataset[3]
    picture = cv2.imread(str(dataset.source.file(3)), cv2.IMREAD_GRAYSCALE)[..., None]
    expected, there = at_size(picture, load(WOODSCAPE).in_picture(picture.shape[:2]), 32, fit)
    assert image.shape == (1, 32, 32) and image.dtype == torch.float32
    np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
    assert str(lens) == str(there) and label == int(dataset.source.file(3).parent.name)
    again = dataset[Draw(4, 3, 7)]
    assert torch.equal(again[0], image) and str(again[1]) == str(lens)


def test_exif_turns_picture_and_lens(tmp_path):
    write_frames(tmp_path / "p", count=3)
    file = next((tmp_path / "p").rglob("*.png"))
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.open(file).save(file.with_suffix(".jpg"), exif=exif)
    file.unlink()
    source = open_source(tmp_path / "p", "train", channels=1, holdout=0)
    dataset = Calibrated(source, Calibrations(WOODSCAPE, tmp_path / "p"), **PLAIN)
    number = [source.file(k).suffix for k in range(3)].index(".jpg")
    picture, orientation = read_oriented(file.with_suffix(".jpg"), 1)
    assert orientation == 6 and picture.shape == (160, 121, 1)
    turned = in_upright_picture(load(WOODSCAPE), (160, 121), 6)
    expected, lens = at_size(picture, turned, 32, "crop")
    image, got, _ = dataset[number]
    np.testing.assert_allclose(255 * image[0].numpy(), expected[..., 0], atol=1e-3)
    assert str(got) == str(lens)


def test_cameras_of_several_models_make_one_batch(folder, tmp_path):
    other = {"model": "Equidistant", "focal": 30.0, "theta_max": 1.5}
    file = tmp_path / "lenses.json"
    file.write_text(json.dumps({".": str(WOODSCAPE), "1": other, "2": {"file": str(WOODSCAPE)}}))
    dataset = of(folder, file)
    labels = [dataset.source[k][1] for k in range(len(dataset))]
    assert dataset.cameras.tolist() == [int(label == 1) for label in labels]
    images, lenses, _ = next(iter(DataLoader(dataset, len(dataset), num_workers=1)))
    assert isinstance(lenses, Tabulated) and len(lenses) == len(images) == len(dataset)
    expected = at_size(np.zeros((121, 160, 1), np.uint8), of(folder)[0][1], 32, "crop")[1]
    theta = torch.linspace(0, 1.4, 9)
    torch.testing.assert_close(lenses[0].project(theta), expected.project(theta))


def test_pictures_without_files():
    images = np.random.default_rng(0).integers(256, size=(4, 8, 8), dtype=np.uint8)
    lens = '{"model": "Equidistant", "fov": 3.0}'
    source = Arrays(images, np.arange(4), list("abcd"), 1).limited(3)
    dataset = Calibrated(source, Calibrations(lens, "digits"), **PLAIN)
    assert dataset[0][1].r_max.item() == pytest.approx(16) and len(dataset) == 3


def test_broken_files_have_a_lens_too(tmp_path):
    write_frames(tmp_path / "p", count=3)
    broken = next((tmp_path / "p").rglob("*.png"))
    broken.write_bytes(b"nothing")
    source = open_source(tmp_path / "p", "train", channels=1, holdout=0)
    calibrations = Calibrations(WOODSCAPE, tmp_path / "p")
    number = [source.file(k) for k in range(3)].index(broken)
    with pytest.raises(BrokenImageError, match=broken.name):
        Calibrated(source, calibrations, **PLAIN)[number]
    dataset = Calibrated(source, calibrations, skip_broken=True, **PLAIN)
    _, lenses, labels = next(iter(DataLoader(dataset, 3)))
    assert (labels == -1).sum() == 1 and len(lenses) == 3 and dataset.broken == [number]


def test_what_does_not_fit(folder, tmp_path):
    with pytest.raises(ValueError, match="framing must be 'crop' or 'stretch', got 'whole'"):
        of(folder, framing="whole")
    file = tmp_path / "lenses.json"
    file.write_text(json.dumps({"1": str(WOODSCAPE)}))
    with pytest.raises(ValueError, match=r"has no lens for .*\.png"):
        of(folder, file)
    narrow = {"model": "Equidistant", "focal": 9.0, "theta_max": 1.5, "image_size": [50, 50]}
    with pytest.raises(ValueError, match=r"\.png: the lens is of pictures of 50×50 px"):
        of(folder, json.dumps(narrow))[0]
