"""Sources of pictures: digits, IDX files, and parts of any source."""

import gzip

import numpy as np
import pytest
from helpers import refused
from scenes import write

from darswin.data import open_source
from darswin.data.pictures import Arrays, Form, ImageFiles, form_of, read_idx
from darswin.data.splits import SPLITS
from darswin.utils.image import BrokenImageError


def write_idx(path, array):
    head = b"\0\0\x08" + bytes([array.ndim]) + np.array(array.shape, ">u4").tobytes()
    data = head + array.tobytes()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)


def test_digits():
    parts = [open_source("digits", split, channels=1) for split in SPLITS]
    assert sum(map(len, parts)) == 1797 and all(len(part) > 180 for part in parts)
    image, _ = parts[0][0]
    assert image.shape == (8, 8, 1) and max(parts[0][k][0].max() for k in range(9)) == 255
    assert open_source("digits", "val")[0][0].shape == (8, 8, 3)


def test_a_limit_takes_a_sample_of_the_whole(tmp_path):
    whole = open_source("digits", "train", channels=1)
    part = whole.limited(50)
    labels = [part[k][1] for k in range(50)]
    assert len(part) == 50 and len(set(labels)) == 10 and len(whole) > 50
    assert len(whole.limited(10_000)) == len(whole)
    files = ImageFiles(tmp_path, [(f"{k}.png", k) for k in range(len(whole))], range(len(whole)))
    chosen = files.limited(50)  # the same pictures of any source
    assert [whole.labels[k] for k in chosen.labels] == labels
    assert chosen.file(3) == tmp_path / f"{chosen.labels[3]}.png" and part.file(3) is None
    for count in (0, -1):
        refused(f"`limit` must be at least 1, got {count}", whole.limited, count)


@pytest.mark.parametrize("suffix", ["", ".gz"])
def test_idx_files(tmp_path, suffix):
    rng = np.random.default_rng(0)
    arrays = {}
    for part, count in (("train", 20), ("t10k", 5)):
        arrays[part] = rng.integers(256, size=(count, 28, 28), dtype=np.uint8)
        write_idx(tmp_path / f"{part}-images-idx3-ubyte{suffix}", arrays[part])
        labels = (np.arange(count) % 10).astype(np.uint8)
        write_idx(tmp_path / f"{part}-labels-idx1-ubyte{suffix}", labels)
    train, val, test = (open_source(tmp_path, split, channels=1) for split in SPLITS)
    assert (len(train), len(val), len(test)) == (18, 2, 5) and len(train.classes) == 10
    image, label = val[1]
    assert np.array_equal(image[..., 0], arrays["train"][19]) and label == 9
    assert np.array_equal(test[4][0][..., 0], arrays["t10k"][4])
    assert test.oriented(4)[1:] == (4, 1)


def test_the_classes_of_idx_files_are_those_of_training(tmp_path):
    for part, labels in (("train", [0, 1, 2, 0]), ("t10k", [1, 0])):
        write_idx(tmp_path / f"{part}-images-idx3-ubyte", np.zeros((len(labels), 2, 2), np.uint8))
        write_idx(tmp_path / f"{part}-labels-idx1-ubyte", np.array(labels, np.uint8))
    assert all(open_source(tmp_path, split).classes == ["0", "1", "2"] for split in SPLITS)
    (tmp_path / "names.txt").write_text("zero\none\n")
    with pytest.raises(ValueError, match=r"labels up to 2 in the 'train' split.*\['zero', 'one"):
        open_source(tmp_path, "train", classes=tmp_path / "names.txt")
    write_idx(tmp_path / "t10k-labels-idx1-ubyte", np.array([7, 0], np.uint8))
    refused("labels up to 7 in the 'test' split", open_source, tmp_path, "test")
    (tmp_path / "t10k-labels-idx1-ubyte").unlink()
    refused("no t10k-labels-idx1-ubyte", open_source, tmp_path, "test", error=FileNotFoundError)


def test_a_cut_idx_file_is_named(tmp_path):
    write_idx(tmp_path / "a", np.zeros((4, 3, 3), np.uint8))
    whole = (tmp_path / "a").read_bytes()
    for name, content, message in (
        ("a", whole[:-1], r"a must hold \[4, 3, 3\] bytes, but holds 35"),
        ("a.gz", gzip.compress(whole)[:-12], r"a\.gz is not a complete gzip file"),
        ("a", b"GIF89a", "a is not an IDX file"),
    ):
        (tmp_path / name).write_bytes(content)
        refused(message, read_idx, tmp_path, name.removesuffix(".gz"))
        (tmp_path / name).unlink()


@pytest.mark.parametrize(
    ("pictures", "form"),
    [
        ([(30, 40)] * 3, Form(1, 30)),
        ([(30, 40), (50, 20), (90, 60, 3)], Form(3, 30)),
        ([(64, 48, 4), (64, 48, 4)], Form(3, 48)),
    ],
)
def test_the_form_of_pictures(tmp_path, pictures, form):
    for k, shape in enumerate(pictures):
        write(tmp_path / "a" / f"{k}.png", np.zeros(shape, np.uint8))
    (tmp_path / "a" / "9.png").write_bytes(b"no picture")
    source = open_source(tmp_path, "train", channels=None, holdout=0)
    assert source.form() == form and source.channels == form.channels == source[0][0].shape[2]
    assert open_source(tmp_path, "train", channels=3, holdout=0)[0][0].shape[2] == 3
    for k in range(len(pictures)):
        (tmp_path / "a" / f"{k}.png").unlink()
    with pytest.raises(BrokenImageError, match=r"cannot read .*9\.png"):
        open_source(tmp_path, "train", channels=None, holdout=0)


def test_the_form_of_many_pictures_is_that_of_some(tmp_path):
    files = [write(tmp_path / f"{k}.png", np.zeros((k, 99), np.uint8)) for k in range(10, 75)]
    assert form_of(files.__getitem__, len(files)).side == 40  # of every third: 10, 13, …, 73


def test_the_form_of_arrays():
    assert open_source("digits", "val", channels=None).form() == Form(1, 8)
    colours = Arrays(np.zeros((2, 9, 7, 3), np.uint8), np.zeros(2), ["a"])
    assert colours.form() == Form(3, 7)


def test_wrong_options(tmp_path):
    for options in (dict(split="all"), dict(split="val", holdout=0.5)):
        refused(f"`{list(options)[-1]}` must be", open_source, "digits", **options)
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        open_source(tmp_path / "nowhere", "train")
    refused("2 images and 3 labels", Arrays, np.zeros((2, 4, 4), np.uint8), np.zeros(3), ["a"])
