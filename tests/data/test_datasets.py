import json
import struct
import zlib

import cv2
import numpy as np
import pytest

from darswin.data import SphericalLenses, WideAngle
from darswin.data.pictures import open_source
from darswin.utils.image import BrokenImageError, read_image, read_oriented


def write_pictures(root, classes=("cat", "dog"), count=10, size=(6, 8)):
    """Pictures whose grey level is their number."""
    for name in classes:
        (root / name).mkdir(parents=True)
        for k in range(count):
            assert cv2.imwrite(str(root / name / f"{k:02}.png"), np.full((*size, 3), k, np.uint8))


def levels(source):
    return [int(source[k][0].max()) for k in range(len(source))]


def test_a_plain_folder_is_split_the_same_way_every_time(tmp_path):
    write_pictures(tmp_path)
    parts = {s: open_source(tmp_path, s, holdout=0.2) for s in ("train", "val", "test")}
    assert [len(p) for p in parts.values()] == [12, 4, 4]
    seen = [
        (label, level)
        for p in parts.values()
        for (_, label), level in zip(p, levels(p), strict=True)
    ]
    assert sorted(seen) == [(label, level) for label in (0, 1) for level in range(10)]
    assert parts["val"].classes == ["cat", "dog"]
    assert levels(open_source(tmp_path, "val", holdout=0.2)) == levels(parts["val"])
    image, label = parts["train"][0]
    assert image.shape == (6, 8, 3) and image.dtype == np.uint8 and label == 0


def test_a_folder_of_splits(tmp_path):
    write_pictures(tmp_path / "train", count=3)
    write_pictures(tmp_path / "val", count=2)
    assert [len(open_source(tmp_path, s)) for s in ("train", "val", "test")] == [6, 4, 4]
    write_pictures(tmp_path / "test", count=1)
    assert len(open_source(tmp_path, "test")) == 2


def test_hidden_and_empty_things_are_no_pictures(tmp_path):
    write_pictures(tmp_path, ("a", "b"), count=4)
    write_pictures(tmp_path, (".checkpoints",), count=4)
    (tmp_path / "a" / "._00.png").write_bytes(b"a file of another system")
    (tmp_path / "empty").mkdir()
    (tmp_path / "b" / "folder.png").mkdir()
    source = open_source(tmp_path, "train", holdout=0)
    assert source.classes == ["a", "b"] and len(source) == 8


def test_one_picture_more_moves_hardly_any(tmp_path):
    write_pictures(tmp_path, ("a",), count=60)
    before = {s: set(open_source(tmp_path, s).paths) for s in ("train", "val", "test")}
    cv2.imwrite(str(tmp_path / "a" / "new.png"), np.zeros((4, 4, 3), np.uint8))
    after = {s: set(open_source(tmp_path, s).paths) for s in before}
    assert sum(len(after[s] - before[s]) for s in before) <= 5


def test_class_lists_choose_and_order(tmp_path):
    write_pictures(tmp_path, ("a", "b", "c"))
    (tmp_path / "classes.txt").write_text("c\na\n")
    (tmp_path / "classes.json").write_text('["c", "a"]')
    for name in ("classes.txt", "classes.json"):
        source = open_source(tmp_path, "train", classes=tmp_path / name)
        assert source.classes == ["c", "a"] and len(source) == 16
        assert source.paths[0].startswith(b"c/") and source[0][1] == 0
    (tmp_path / "classes.txt").write_text("c\nz\n")
    with pytest.raises(FileNotFoundError, match=r"classes \['z'\]"):
        open_source(tmp_path, "train", classes=tmp_path / "classes.txt")


def test_lists_of_splits(tmp_path):
    write_pictures(tmp_path / "pictures")
    lists = {"train": ["dog/01.png", "cat/02.png"], "val": ["cat/03.png"], "test": []}
    (tmp_path / "splits.json").write_text(json.dumps(lists))
    (tmp_path / "lists").mkdir()
    for name, paths in lists.items():
        (tmp_path / "lists" / f"{name}.txt").write_text("\n".join(paths))
    for splits in (tmp_path / "splits.json", tmp_path / "lists"):
        train = open_source(tmp_path / "pictures", "train", splits=splits)
        assert [train[k][1] for k in range(2)] == [1, 0] and levels(train) == [1, 2]
        assert levels(open_source(tmp_path / "pictures", "val", splits=splits)) == [3]
        with pytest.raises(FileNotFoundError, match="no images for the 'test' split"):
            open_source(tmp_path / "pictures", "test", splits=splits)


def test_digits():
    parts = [open_source("digits", s, channels=1) for s in ("train", "val", "test")]
    assert sum(len(p) for p in parts) == 1797 and all(len(p) > 180 for p in parts)
    assert parts[0][0][0].shape == (8, 8, 1) and max(levels(parts[0])) == 255


def test_a_part_is_a_sample_of_the_whole():
    whole = open_source("digits", "train", channels=1)
    part = whole.limited(50)
    assert len(part) == 50 and len({part[k][1] for k in range(50)}) == 10
    assert len(whole.limited(10_000)) == len(whole)
    for count in (0, -1):
        with pytest.raises(ValueError, match=rf"`limit` must be at least 1, got {count}"):
            whole.limited(count)


def huge_png(path):
    """60,000 × 60,000 pixels, says its header: more than OpenCV reads."""

    def chunk(kind, data):
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0" * 1000)), chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def test_a_picture_that_is_too_large_is_named_and_can_be_skipped(tmp_path):
    write_pictures(tmp_path, ("a", "b"), count=3)
    huge_png(tmp_path / "a" / "00.png")
    for read in (read_image, read_oriented):
        with pytest.raises(BrokenImageError, match=r"cannot read .*00\.png: too many pixels"):
            read(tmp_path / "a" / "00.png")
    source = open_source(tmp_path, "train", holdout=0)
    data = WideAngle(source, SphericalLenses(0, 1), size=8, render=8, skip_broken=True)
    assert [data[k][2] for k in range(6)] == [-1, 0, 0, 1, 1, 1] and data.broken == [0]


@pytest.mark.parametrize(
    ("options", "message"),
    [(dict(split="fit"), "`split` must be"), (dict(split="val", holdout=0.5), "`holdout` must be")],
)
def test_wrong_options(options, message):
    with pytest.raises(ValueError, match=message):
        open_source("digits", **options)


def test_no_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        open_source(tmp_path / "nowhere", "train")
    with pytest.raises(FileNotFoundError, match="no images for the 'train' split"):
        open_source(tmp_path, "train")
