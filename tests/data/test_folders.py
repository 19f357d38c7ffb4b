"""Folders as people have them: read, or refused with a sentence that names the folder."""

import json
import os
import shutil
import warnings
from collections import Counter
from pathlib import Path

import hypothesis.strategies as st
import pytest
from helpers import refused
from hypothesis import given

from darswin.data.folders import pictures_and_videos_below
from darswin.data.pictures import open_source
from darswin.data.splits import SPLITS, LeftOut


def touch(root: Path, *names: str) -> None:
    """Empty files: what is in which split does not depend on what they hold."""
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def pictures(root: Path, *folders: str, count: int = 10) -> None:
    touch(root, *(f"{folder}/{k}.jpg" for folder in folders for k in range(count)))


def files(source) -> list[str]:
    return [str(source.file(k)) for k in range(len(source))]


def opened(root: Path, **options) -> list:
    return [open_source(root, split, **options) for split in SPLITS]


def counts(root: Path, **options) -> list[int]:
    return [*map(len, opened(root, **options))]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("there", "expected"),
    [
        ({"train": 20}, [32, 4, 4]),
        ({"train": 20, "testing": 3}, [36, 4, 6]),
        ({"train": 5, "val": 3}, [10, 6, 6]),  # "val" serves as the test set
        ({"Training": 5, "valid": 3, "test": 2}, [10, 6, 4]),
        ({"train": 5, "Validation": 3}, [10, 6, 6]),
        ({"": 20}, [32, 4, 4]),
    ],
)
def test_splits_of_folders(tmp_path, there, expected):
    for name, count in there.items():
        pictures(tmp_path / name, "a", "b/c", count=count)
    train, val, test = parts = opened(tmp_path)
    assert [*map(len, parts)] == expected
    assert all(part.classes == ["a", "b"] for part in parts)
    assert not set(files(train)) & {*files(val), *files(test)}


@pytest.mark.filterwarnings("error")
def test_class_lists_choose_and_order(tmp_path):
    pictures(tmp_path, "bus", "car", "train", "test", ".hidden")
    touch(tmp_path, "bus/._0.jpg")
    (tmp_path / "car" / "folder.png").mkdir()
    assert open_source(tmp_path, "train").classes == ["bus", "car", "test", "train"]
    (tmp_path / "empty").mkdir()  # no class of the list
    (tmp_path / "names.txt").write_text("test\ncar\n")
    (tmp_path / "folders.txt").write_text("test/\ncar/\n")
    for name in ("names.json", "names.JSON"):
        (tmp_path / name).write_text('["test", "car"]')
    for name in ("names.txt", "folders.txt", "names.json", "names.JSON"):
        source = open_source(tmp_path, "train", classes=tmp_path / name)
        assert source.classes == ["test", "car"] and len(source) == 16
        assert source.paths[0].startswith(b"test/") and source.labels[0] == 0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("there", "classes", "error", "message"),
    [
        (["train/1.jpg", "test/2.jpg"], None, ValueError, "test and .*train may be splits"),
        (["train/1.jpg"], None, ValueError, "train may be splits or classes"),
        (["val/a/1.jpg", "test/a/2.jpg"], None, ValueError, "may be splits or classes"),
        (["train/a/1.jpg", "more/a/1.jpg"], None, ValueError, "train may be splits .*`classes`"),
        (["train/a/1.jpg", "val/a/1.jpg", "valid/a/2.jpg"], None, ValueError, "val and .*valid"),
        (["train/a/1.jpg", "val/a/1.jpg", "val/b/2.jpg"], None, ValueError,
         r"'val' split .*\['b'\]"),
        (["train/a/1.jpg", "test/b/1.jpg"], None, ValueError,
         "'test' split .* training split lacks"),
        (["a/1.jpg", "b/1.gif", "b/2.HEIC"], None, ValueError, "b holds no picture .* 1 .heic"),
        (["a/1.jpg", "c/1.txt"], "a\nc\n", FileNotFoundError, r"no pictures of the .*\['c'\]"),
        (["a/1.jpg"], "", ValueError, "names.txt must .* is empty"),
        (["a/1.jpg"], "a\nb\na\n", ValueError, r"names.txt must .* repeats \['a'\]"),
        ([], None, FileNotFoundError, "no images for the '(train|val|test)' split"),
    ],
)  # fmt: skip
def test_what_is_refused(tmp_path, there, classes, error, message):
    touch(tmp_path, *there)
    if classes is not None:
        (tmp_path / "names.txt").write_text(classes)
        classes = tmp_path / "names.txt"
    for split in SPLITS:
        refused(message, open_source, tmp_path, split, classes=classes, error=error)


CLASSES, SPLIT = ("a", "b"), ("train/a", "train/b", "val/a")


@pytest.mark.parametrize(
    ("folders", "there", "message"),
    [
        (CLASSES, "stray.png", r"pictures outside the folders of classes \(1, e\.g\. .*stray\.png"),
        (CLASSES, "a/x.gif b/y.gif", r"does not read, 2 \.gif, e\.g\. .*a/x\.gif: left out"),
        (CLASSES, "labels/x.txt", "labels holds files, but no pictures: it is not a class"),
        (CLASSES, "bird/", "bird holds no pictures: it is not a class"),
        (CLASSES, "bird/.DS_Store", "bird holds no pictures: it is not a class"),
        (CLASSES, "bird/large/ bird/small/", "bird holds no pictures: it is not a class"),
        (CLASSES, "val/", "val holds no pictures: it is not a class"),
        (CLASSES, "few/1.jpg", r"the classes \['few'\] have too few .*none for test or val"),
        (CLASSES, "few/1.jpg few/2.jpg", r"the classes \['few'\] have too few pictures"),
        (SPLIT, "train/c/", "train/c holds no pictures: it is not a class"),
        (SPLIT, "val/b/", "val/b holds no pictures: left out"),
        (SPLIT, "val/c/", "val/c holds no pictures: left out"),
        (SPLIT, "test/", "test holds no pictures: it is not a split"),
        (SPLIT, "testing/a/", "testing holds no pictures: it is not a split"),
    ],
)
def test_what_is_left_out_is_named(tmp_path, folders, there, message):
    pictures(tmp_path, *folders)
    for name in there.split():
        (tmp_path / name).mkdir(parents=True) if name.endswith("/") else touch(tmp_path, name)
    with pytest.warns(LeftOut, match=message):
        parts = opened(tmp_path)
    few = there.count("few")
    assert [*map(len, parts)] == ([16 + few, 2, 2] if folders is CLASSES else [20, 10, 10])
    assert all(part.classes == ["a", "b", "few"][: 2 + (few > 0)] for part in parts)
    assert sum("few" in file for file in files(parts[0])) == few


@pytest.mark.filterwarnings("error")
def test_links_are_followed_once(tmp_path, monkeypatch):
    pictures(tmp_path / "elsewhere", "more")
    root = tmp_path / "root"
    pictures(root, "a", "b")
    (root / "a" / "link").symlink_to(tmp_path / "elsewhere" / "more")
    assert sum(counts(root)) == 30
    for target in (tmp_path / "elsewhere" / "more", root, tmp_path):
        (root / "b" / "link").symlink_to(target)
        refused(r"b/link.* are the same folder", open_source, root, "train")
        (root / "b" / "link").unlink()
    splits = tmp_path / "splits"
    pictures(splits / "train", "a", "b")
    pictures(splits / "val", "a", "b", count=2)
    (splits / "test").symlink_to("val")
    assert counts(splits) == [20, 4, 4]
    monkeypatch.chdir(splits / "train")
    for path in ("..", ".", "../train"):
        source = open_source(path, "train")
        assert source.classes == ["a", "b"] and all(map(os.path.exists, files(source)))


def test_pictures_and_videos_below_a_folder(tmp_path):
    names = ("a/2.MP4", "a/3.insv", "a/4.360", "b/10.png", "b/2.png", "b/5.insp", "b/6.mpo")
    touch(tmp_path, *names, "3.txt", ".x/4.jpg", "c/5.heic")
    found = [str(tmp_path / name) for name in names]
    with pytest.warns(LeftOut, match=r"does not read, 1 \.heic, e\.g\. .*c/5\.heic"):
        assert pictures_and_videos_below(tmp_path) == found
    for folder, said in ((".x/y", r"in .*\.x/y$"), ("c", r"in .*c, but 1 \.heic, which")):
        (tmp_path / folder).mkdir(exist_ok=True)
        function, said = pictures_and_videos_below, f"no pictures or videos {said}"
        refused(said, function, tmp_path / folder, error=FileNotFoundError)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ("{", "must be JSON"),
        ([], "must hold"),
        ({"train": ["a/1.jpg"], "more": []}, r"must hold .*, got \['train', 'more'\]"),
        ({"train": ["a/1.jpg"], "val": [], "valid": []}, "must hold"),
        ({"train": ["a/1.jpg", 3]}, "'train' must list paths CLASS/… below .*, got 3"),
        ({"train": 3}, "must hold .*, got 3 for 'train'"),
        ({"train": ["1.jpg"]}, r"must list paths CLASS/… .*, got '1\.jpg'"),
        ({"train": ["/a/1.jpg"]}, "must list paths CLASS/…"),
        ({"train": ["../a/1.jpg"]}, "must list paths CLASS/…"),
        ({"train": ["a/1.jpg"], "val": ["./a/1.jpg"]}, r"lists a/1\.jpg for 'train' and for 'val'"),
        ({"test": ["a//2.jpg"], "train": ["a/2.jpg"]}, "lists a/2.jpg for 'test' and for 'train'"),
        ({"train": ["a/1.jpg", "a/7.jpg"]}, r"lists 1 picture missing in .*: \['a/7\.jpg'\]"),
        ({"train": ["a/1.jpg"], "val": ["c/1.jpg"]}, r"lists 1 picture .*: \['c/1\.jpg'\]"),
        ({"train": ["a/1.jpg"], "valid": ["b/1.jpg"]}, r"\['b'\], but the training split lacks"),
    ],
)
def test_lists_that_are_wrong(tmp_path, lists, message):
    file = tmp_path / "splits.json"
    file.write_text(lists if isinstance(lists, str) else json.dumps(lists))
    touch(tmp_path, "a/1.jpg", "a/2.jpg", "b/1.jpg")
    refused(message, open_source, tmp_path, "train", splits=file, error=(ValueError, OSError))
    refused("`splits` is for folders", open_source, "digits", "train", splits=file)


def test_lists_of_splits(tmp_path):
    lists = {"train": ["dog/01.png", "cat/02.png"], "val": ["cat/03.png"], "test": []}
    (tmp_path / "splits.json").write_text(json.dumps(lists))
    touch(tmp_path, *lists["train"], *lists["val"])
    (tmp_path / "lists").mkdir()
    for name, paths in lists.items():
        (tmp_path / "lists" / f"{name}.txt").write_text("\n".join(paths))
    for splits in (tmp_path / "splits.json", tmp_path / "lists"):
        train, val = (open_source(tmp_path, part, splits=splits) for part in ("train", "val"))
        assert train.labels.tolist() == [1, 0] and train.file(0) == tmp_path / "dog" / "01.png"
        assert files(val) == [str(tmp_path / "cat" / "03.png")]
        said = "no images for the 'test' split"
        refused(said, open_source, tmp_path, "test", splits=splits, error=FileNotFoundError)
    paths = [f"{name}/{k}.jpg" for name in "ab" for k in range(10)]
    touch(tmp_path, *paths, "a/x.jpg")
    (tmp_path / "TRAIN.TXT").write_text("\n".join([*paths, paths[0], f"./{paths[1]}"]))  # once
    assert counts(tmp_path, splits=tmp_path) == [16, 2, 2]  # a split without a list is held out
    (tmp_path / "validation.txt").write_text("a/x.jpg")
    assert counts(tmp_path, splits=tmp_path) == [20, 1, 1]


def test_the_share_that_is_held_out(tmp_path):
    pictures(tmp_path, "a", count=60)
    before = opened(tmp_path)
    assert [*map(len, before)] == [48, 6, 6]
    assert files(before[1]) == files(open_source(tmp_path, "val"))
    touch(tmp_path, "a/new.jpg")
    after = opened(tmp_path)
    moved = [{*files(new)} - {*files(old)} for new, old in zip(after, before, strict=True)]
    assert sum(map(len, moved)) <= 5  # one picture more moves hardly any
    for path in (tmp_path, "digits"):
        said = r"'val' split .*`holdout` 0 .*leaves none"
        refused(said, open_source, path, "val", holdout=0, error=FileNotFoundError)


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
    text = "\n".join(str(warning.message) for warning in caught)
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
        named = any(f"{folder} holds" in text for folder in Path(picture).parents)
        assert found[picture] == 1 or named, picture
