"""Folders as people have them: understood, or refused with a sentence that names the folder."""

import json
import os
import shutil
import warnings
from collections import Counter
from pathlib import Path

import hypothesis.strategies as st
import pytest
from hypothesis import given

from darswin.data.pictures import open_source
from darswin.data.splits import SPLITS, LeftOut


def touch(root: Path, *names: str) -> None:
    """Empty files: what is in which split does not depend on what they hold."""
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def pictures(root: Path, *classes: str, count: int = 10) -> None:
    touch(root, *(f"{name}/{k}.jpg" for name in classes for k in range(count)))


def files(source) -> list[str]:
    return [str(source.root / os.fsdecode(path)) for path in source.paths]


def opened(root: Path, **options) -> dict:
    return {split: open_source(root, split, **options) for split in SPLITS}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["val", "valid", "Validation"])
def test_the_names_of_validation(tmp_path, name):
    pictures(tmp_path / "train", "a", "b", count=5)
    pictures(tmp_path / name, "a", "b", count=3)
    parts = opened(tmp_path)
    assert [len(parts[s]) for s in SPLITS] == [10, 6, 6]
    pictures(tmp_path / "test", "b", count=2)
    parts = opened(tmp_path)
    assert [len(parts[s]) for s in SPLITS] == [10, 6, 2]
    assert all(part.classes == ["a", "b"] for part in parts.values())


@pytest.mark.filterwarnings("error")
def test_training_and_test_folders_alone(tmp_path):
    """Validation is a share of training, and of a lone `train/` the test set too."""
    pictures(tmp_path / "train", "cat", "dog", count=20)
    parts = opened(tmp_path)
    assert [len(parts[s]) for s in SPLITS] == [32, 4, 4]
    pictures(tmp_path / "testing", "cat", "dog", count=3)
    parts = opened(tmp_path)
    assert [len(parts[s]) for s in SPLITS] == [36, 4, 6]
    assert all(part.classes == ["cat", "dog"] for part in parts.values())
    assert not set(files(parts["train"])) & set(files(parts["val"]))


@pytest.mark.filterwarnings("error")
def test_classes_may_have_the_names_of_splits(tmp_path):
    pictures(tmp_path, "bus", "car", "train", "test")
    assert open_source(tmp_path, "train").classes == ["bus", "car", "test", "train"]
    (tmp_path / "names.txt").write_text("test\ntrain\n")
    assert open_source(tmp_path, "val", classes=tmp_path / "names.txt").classes == ["test", "train"]


@pytest.mark.parametrize(
    ("there", "message"),
    [
        (["train/1.jpg", "test/2.jpg"], r"test and .*train may be meant as splits or as classes"),
        (["train/1.jpg"], "train may be meant as splits or as classes"),
        (["val/a/1.jpg", "test/a/2.jpg"], "may be meant as splits or as classes"),
        (["train/a/1.jpg", "other/a/1.jpg"], r"train may be meant .*`classes`"),
        (["train/a/1.jpg", "val/a/1.jpg", "valid/a/2.jpg"], r"val and .*valid both have a name"),
        (["train/a/1.jpg", "val/a/1.jpg", "val/b/2.jpg"], r"val holds .* the classes \['b'\], wh"),
        (["train/a/1.jpg", "test/b/1.jpg"], r"test holds .* which training has no pictures of"),
        (["a/1.jpg", "b/1.gif", "b/2.HEIC"], r"b holds no picture .*, but 1 \.gif, 1 \.heic: co"),
    ],
)
def test_what_can_be_read_in_two_ways_is_refused(tmp_path, there, message):
    touch(tmp_path, *there)
    for split in SPLITS:
        with pytest.raises(ValueError, match=message):
            open_source(tmp_path, split)


@pytest.mark.parametrize(
    ("there", "message"),
    [
        (
            ["stray.png"],
            r"holds pictures in no class's folder \(1, e\.g\. .*stray\.png\): left out",
        ),
        (["a/x.gif", "b/y.gif"], r"does not read, 2 \.gif, e\.g\. .*a/x\.gif: left out"),
        (["labels/x.txt"], "labels holds files, but no pictures: it is no class"),
        (["few/1.jpg"], r"too few pictures .* the classes \['few'\].*none is for test or val"),
        (["few/1.jpg", "few/2.jpg"], r"too few pictures .* the classes \['few'\]"),
    ],
)
def test_what_is_left_out_is_said(tmp_path, there, message):
    pictures(tmp_path, "a", "b")
    touch(tmp_path, *there)
    with pytest.warns(LeftOut, match=message):
        parts = opened(tmp_path)
    few = [file for file in files(parts["train"]) if "few" in file]
    assert len(few) == sum("few" in name for name in there)


def test_pictures_beside_the_splits_are_said(tmp_path):
    pictures(tmp_path / "train", "a", "b")
    pictures(tmp_path / "val", "a", "b")
    touch(tmp_path, "test/1.jpg", "more/2.jpg")
    with pytest.warns(LeftOut) as said:
        assert len(open_source(tmp_path, "val")) == 20
    text = "\n".join(str(warning.message) for warning in said)
    assert f"{tmp_path / 'more'} holds pictures, but is no split" in text
    assert f"{tmp_path / 'test'} holds pictures in no class's folder (1" in text
    with (
        pytest.warns(LeftOut),
        pytest.raises(FileNotFoundError, match="no images for the 'test' split"),
    ):
        open_source(tmp_path, "test")


@pytest.mark.filterwarnings("error")
def test_links_are_followed_once(tmp_path):
    pictures(tmp_path / "elsewhere", "more")
    pictures(tmp_path / "root", "a", "b")
    (tmp_path / "root" / "a" / "link").symlink_to(tmp_path / "elsewhere" / "more")
    parts = opened(tmp_path / "root")
    assert sum(len(part) for part in parts.values()) == 30
    for target in (tmp_path / "elsewhere" / "more", tmp_path / "root", tmp_path):
        (tmp_path / "root" / "b" / "link").symlink_to(target)
        with pytest.raises(ValueError, match=r"b/link.* are the same folder"):
            open_source(tmp_path / "root", "train")
        (tmp_path / "root" / "b" / "link").unlink()


@pytest.mark.filterwarnings("error")
def test_a_test_set_that_is_a_link_to_validation(tmp_path):
    pictures(tmp_path / "train", "a", "b")
    pictures(tmp_path / "val", "a", "b", count=2)
    (tmp_path / "test").symlink_to("val")
    assert [len(part) for part in opened(tmp_path).values()] == [20, 4, 4]


def test_the_folder_one_is_in(tmp_path, monkeypatch):
    pictures(tmp_path / "train", "a", "b/c")
    pictures(tmp_path / "val", "a", "b", count=1)
    for folder, path in ((tmp_path, "."), (tmp_path / "train", "../train"), (tmp_path, "train")):
        monkeypatch.chdir(folder)
        source = open_source(path, "train")
        assert source.classes == ["a", "b"] and all(map(os.path.exists, files(source)))


def test_every_class_of_a_list_has_pictures(tmp_path):
    pictures(tmp_path, "a", "b")
    (tmp_path / "c").mkdir()
    (tmp_path / "classes.txt").write_text("a\nc\n")
    with pytest.raises(FileNotFoundError, match=r"no pictures of the classes \['c'\]"):
        open_source(tmp_path, "train", classes=tmp_path / "classes.txt")
    for text, message in (("", "is empty"), ("a\nb\na\n", r"repeats \['a'\]")):
        (tmp_path / "classes.txt").write_text(text)
        with pytest.raises(ValueError, match=rf"classes\.txt must .*{message}"):
            open_source(tmp_path, "train", classes=tmp_path / "classes.txt")


def test_a_holdout_that_leaves_nothing_is_named(tmp_path):
    pictures(tmp_path, "a", "b")
    for path in (tmp_path, "digits"):
        with pytest.raises(FileNotFoundError, match=r"'val' split .*`holdout` 0 .*leaves none"):
            open_source(path, "val", holdout=0)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ("{", "must be JSON"),
        ([], "must hold"),
        ({"train": ["a/1.jpg"], "more": []}, r"must hold .*, got \['train', 'more'\]"),
        ({"train": ["a/1.jpg"], "val": [], "valid": []}, "must hold"),
        ({"train": ["a/1.jpg", 3]}, "'train' must hold paths CLASS/… below .*, got 3"),
        ({"train": 3}, "must hold .*, got 3 for 'train'"),
        ({"train": ["1.jpg"]}, r"must hold paths CLASS/… .*, got '1\.jpg'"),
        ({"train": ["/a/1.jpg"]}, "must hold paths CLASS/…"),
        ({"train": ["../a/1.jpg"]}, "must hold paths CLASS/…"),
        ({"train": ["a/1.jpg"], "valid": ["b/1.jpg"]}, r"\['b'\], which training has no pict"),
    ],
)
def test_lists_that_are_wrong(tmp_path, lists, message):
    file = tmp_path / "splits.json"
    file.write_text(lists if isinstance(lists, str) else json.dumps(lists))
    with pytest.raises(ValueError, match=message):
        open_source(tmp_path, "train", splits=file)
    with pytest.raises(ValueError, match=r"`splits` is for folders"):
        open_source("digits", "train", splits=file)


def test_a_split_without_a_list_is_held_out(tmp_path):
    paths = [f"{name}/{k}.jpg" for name in "ab" for k in range(10)]
    (tmp_path / "train.txt").write_text("\n".join(paths))
    assert [len(part) for part in opened(tmp_path, splits=tmp_path).values()] == [16, 2, 2]
    (tmp_path / "validation.txt").write_text("a/x.jpg")
    assert [len(part) for part in opened(tmp_path, splits=tmp_path).values()] == [20, 1, 1]


# -- any tree ---------------------------------------------------------------------------------

FOLDERS = st.sampled_from(["train", "test", "val", "valid", "a", "b", "c"])
NAMES = st.sampled_from(["1.jpg", "2.PNG", "3.webp", "4.gif", "5.heic", "6.txt", "7.jpg", "8.jpg"])
TREES = st.lists(st.tuples(st.lists(FOLDERS, max_size=4), NAMES), min_size=1, max_size=40)
SPLIT_SETS = [("",), ("train",), ("train", "test"), ("train", "valid"), ("train", "val", "test")]
SETS = st.tuples(
    st.sampled_from(SPLIT_SETS),
    st.lists(st.sampled_from(["1.jpg", "2.PNG", "x/3.webp", "4.gif"]), min_size=1, unique=True),
).map(lambda t: [((split, name), file) for split in t[0] for name in "ab" for file in t[1]])


def linked(root: Path, other: Path) -> None:
    """Every folder "c" moves elsewhere and is linked from where it was."""
    for k, folder in enumerate(sorted(root.rglob("c"), reverse=True)):
        if folder.is_dir() and not folder.is_symlink():
            shutil.move(folder, other / str(k))
            folder.symlink_to(other / str(k))


@given(TREES | st.builds(list.__add__, SETS, TREES) | SETS, st.booleans(), st.floats(0, 0.49))
def test_every_picture_is_in_one_split_or_named(tmp_path_factory, tree, links, holdout):
    base = tmp_path_factory.mktemp("tree")
    root, other = base / "root", base / "other"
    root.mkdir()
    other.mkdir()
    touch(root, *(os.path.join(*folders, name) for folders, name in tree))
    there = [p for p in root.rglob("*") if p.is_file() and p.suffix != ".txt"]
    if links:
        linked(root, other)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        parts, errors = {}, []
        for split in SPLITS:
            try:
                parts[split] = open_source(root, split, holdout=holdout)
            except (ValueError, FileNotFoundError) as error:
                errors.append(str(error))
    said = "\n".join(str(warning.message) for warning in caught)
    assert all(str(root) in error for error in errors)
    if "train" not in parts:
        return
    classes = parts["train"].classes
    assert all(part.classes == classes for part in parts.values())
    # A class without a training picture is none.
    assert {int(label) for label in parts["train"].labels} == set(range(len(classes)))
    if "test" in parts and "val" in parts and files(parts["test"]) == files(parts["val"]):
        del parts["test"]  # validation serves as the test set
    found = Counter(file for part in parts.values() for file in files(part))
    assert set(found.values()) == {1}
    for picture in map(str, there):
        named = any(f"{folder} holds" in said for folder in Path(picture).parents)
        assert found[picture] == 1 or named, picture
