"""Reading labels and distances; damaged files and wrong ones are named."""

import io
import json

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import ExifTags, Image
from scenes import write, write_plain

from darswin.data import IGNORE, SceneSamples, open_scenes
from darswin.data.scenes.targets import read_distance, read_labels
from darswin.utils.image import BrokenImageError

LABELS = np.random.default_rng(0).integers(0, 4, size=(9, 13), dtype=np.uint8)
METRES = np.random.default_rng(1).uniform(0.5, 90, size=(9, 13)).astype(np.float32)


def png(array):
    return cv2.imencode(".png", array)[1].tobytes()


def npy(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


FILES = {
    "labels.png": (png(LABELS), lambda path: read_labels(path, 4)),
    "distance.png": (png(np.round(METRES * 256).astype(np.uint16)), read_distance),
    "distance.npy": (npy(METRES), read_distance),
}


@given(
    name=st.sampled_from(sorted(FILES)),
    changes=st.lists(st.tuples(st.integers(0, 500), st.integers(0, 255)), max_size=4),
    kept=st.floats(0, 1),
)
def test_any_damage(tmp_path_factory, name, changes, kept):
    content, read = FILES[name]
    damaged = bytearray(content[: round(kept * len(content))])
    for place, value in changes:
        if place < len(damaged):
            damaged[place] = value
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(damaged)
    try:
        target = read(path)
    except (BrokenImageError, ValueError) as error:
        assert name in str(error)
        return
    assert target.ndim == 2 and target.dtype == (np.uint8 if "labels" in name else np.float32)
    assert np.isfinite(target).all() and (target >= 0).all()


def test_what_was_written_is_read(tmp_path):
    for name, (content, _) in FILES.items():
        (tmp_path / name).write_bytes(content)
    assert (read_labels(tmp_path / "labels.png", 4) == LABELS).all()
    assert (read_distance(tmp_path / "distance.npy") == METRES).all()
    error = np.abs(read_distance(tmp_path / "distance.png") - METRES)
    assert error.max() <= 1 / 512 + 1e-5
    far = read_distance(tmp_path / "distance.npy", far=40.0)
    assert (far == np.where(METRES < 40, METRES, 0)).all()
    unknown = METRES.astype(np.float64)
    unknown[0, :7] = 0, -1, np.nan, np.inf, -np.inf, 1e300, 40.0
    np.save(tmp_path / "u.npy", unknown)
    assert (read_distance(tmp_path / "u.npy", far=40.0)[0, :7] == 0).all()
    ignored = np.where(LABELS == 3, IGNORE, LABELS)
    assert (read_labels(write(tmp_path / "i.png", ignored), 3) == ignored).all()


@pytest.mark.parametrize("bits", [1, 2, 4, 8])
def test_palettes_of_few_bits(tmp_path, bits):
    ids = LABELS & np.uint8(2**bits - 1)
    picture = Image.fromarray(ids)
    picture.putpalette([255, 0, 0, 0, 255, 0, 0, 0, 255, 9, 9, 9])
    picture.save(tmp_path / "p.png", bits=bits)
    assert (read_labels(tmp_path / "p.png", 4) == ids).all()
    Image.fromarray(LABELS > 1).save(tmp_path / "b.png")  # black and white: 0 and 1
    assert (read_labels(tmp_path / "b.png", 2) == (LABELS > 1)).all()


LABEL = np.arange(121 * 160, dtype=np.uint8).reshape(121, 160) % 3


@pytest.mark.parametrize(
    ("name", "content", "error", "message"),
    [
        ("labels.png", png(np.where(LABEL == 1, 3, LABEL)), ValueError, r"ids \[3\], .* 3 classes"),
        ("labels.png", png(LABEL.astype(np.uint16)), ValueError, "an id of 8 bits .* 16 bits"),
        ("labels.png", png(np.dstack([LABEL] * 3)), ValueError, r"an id .* colours \(RGB\)"),
        ("labels.png", png(LABEL[:-1]), ValueError, r"has 120×160 px, .*001\.png has 121×160"),
        ("labels.png", b"", BrokenImageError, "cannot read"),
        ("labels.png", png(LABEL)[:400], BrokenImageError, "cannot read"),
        ("distance.png", png(LABEL), ValueError, "a distance of 16 bits .* 1 × 8 bits"),
        ("distance.png", None, BrokenImageError, "cannot read"),
        ("distance.npy", npy(LABEL[None] / 3), ValueError, r"\(H, W\), but holds float64 \(1,"),
        ("distance.npy", npy(LABEL.astype(int)), ValueError, "but holds int64"),
        ("distance.npy", npy(np.array([[{}]])), BrokenImageError, "cannot read"),
    ],
)
def test_wrong_targets_are_named(tmp_path, name, content, error, message):
    write_plain(tmp_path, 2)
    target, suffix = name.split(".")
    old = tmp_path / target / "001.png"
    old.unlink()
    file = old.with_suffix(f".{suffix}")
    file.touch()
    scenes = open_scenes(tmp_path, "all", target)
    file.unlink() if content is None else file.write_bytes(content)
    with pytest.raises(error, match=rf"{target}/001\.{suffix}.*{message}|{message}.*{target}/001"):
        scenes[1]
    dataset = SceneSamples(scenes, size=16, skip_broken=True)
    if error is ValueError:  # a wrong target is not skipped as if its file were broken
        with pytest.raises(error):
            dataset[1]
    else:
        image, lens, target = dataset[1]
        assert (target == (IGNORE if scenes.target == "labels" else 0)).all()
        assert target.dtype == (torch.int64 if scenes.target == "labels" else torch.float32)
        assert lens.image_size.tolist() == [[16, 16]] and image.unique().numel() == 3
        assert dataset.broken == [1]


def test_wrong_lenses_and_turned_pictures_are_named(tmp_path):
    write_plain(tmp_path, 3)
    scenes = open_scenes(tmp_path, "all", "labels")
    picture = tmp_path / "images" / "001.png"
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.open(picture).save(picture, exif=exif)
    with pytest.raises(ValueError, match=r"001\.png has the EXIF orientation 6"):
        scenes[1]
    lens = json.loads((tmp_path / "lens.json").read_text())
    (tmp_path / "lens.json").write_text(json.dumps(lens | {"image_size": [50, 50]}))
    scenes = open_scenes(tmp_path, "all", "labels")
    with pytest.raises(ValueError, match=r"000\.png: the calibration is for 50×50"):
        scenes[0]
    write(tmp_path / "labels" / "002.png", np.full((121, 160), IGNORE, np.uint8))
    write_plain(tmp_path, 2)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert (scenes[2].target == IGNORE).all() and scenes.unknown.tolist() == [-1, -1, 121 * 160]


@pytest.mark.parametrize(
    ("classes", "message"),
    [
        (None, 'no classes.json in .*, for example {"names":'),
        ([], "must list the classes"),
        ({"names": ["a", "a"]}, "must name each class once"),
        ({"names": ["a", 3]}, "must name the classes as a list of words"),
        ({"names": ["a", "b"], "colors": [[0, 0, 0]]}, "must give all 2 classes a color"),
        ({"names": ["a"], "colors": [[0, 0, 256]]}, "must give all 1 classes a color"),
        ({"names": ["a"], "colors": [[0, 0]]}, "must give all 1 classes a color"),
        ({"names": [str(k) for k in range(256)]}, "must name each class once, and at most 255"),
    ],
)
def test_wrong_classes_are_named(tmp_path, classes, message):
    write_plain(tmp_path, 2, classes=classes)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_scenes(tmp_path, "all", "labels")
    (tmp_path / "mine.txt").write_text("a\nb\nc\n")
    scenes = open_scenes(tmp_path, "all", "labels", classes=tmp_path / "mine.txt")
    assert scenes.classes == ["a", "b", "c"] and scenes.colors == []
