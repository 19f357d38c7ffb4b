"""Trees written as the data sets' authors describe them: none of the three can be downloaded."""

import json
from itertools import chain

import cv2
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image
from scenes import (
    VIEWS,
    WOODSCAPE_INFO,
    distance_of,
    labels_of,
    rays_of,
    write_kitti360,
    write_plain,
    write_synwoodscape,
    write_woodscape,
)
from torch.utils.data import DataLoader

from darswin.data import IGNORE, SceneSamples, open_scenes
from darswin.data.scenes.woodscape import heal_swin
from darswin.data.splits import LeftOut
from darswin.lens import Mei, load
from darswin.utils.image import BrokenImageError


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize(
    "calibration", ["calibration/calibration", "calibration", "calibration_data/calibration"]
)
def test_woodscape(tmp_path, nested, calibration):
    write_woodscape(tmp_path, nested=nested, calibration=calibration)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert len(scenes) == 8 and scenes.cameras == list(VIEWS)
    assert [scenes.camera_of(k) for k in range(8)] == [0, 1, 2, 3] * 2
    assert scenes.classes == WOODSCAPE_INFO["class_names"]
    assert scenes.colors == [color[::-1] for color in WOODSCAPE_INFO["class_colors"]]
    for k, scene in enumerate(scenes):
        # One green row of 121 at each end is gone, as three of 966 are, and the lens follows.
        assert scene.image.shape == (119, 160, 3) and scene.target.shape == (119, 160)
        assert not (scene.image == (0, 255, 0)).all(-1).any()
        whole = load(tmp_path / calibration / f"{scenes.file(k).stem}.json").in_picture((121, 160))
        assert scene.lens.center[0].tolist() == pytest.approx(
            [whole.center[0, 0].item(), whole.center[0, 1].item() - 1]
        )
        theta, azimuth = rays_of(whole, (121, 160))
        expected = labels_of(theta, azimuth + 0.3 * k, 10)[1:-1]
        assert (scene.target == expected).all()
    _, lenses, _ = next(iter(DataLoader(SceneSamples(scenes, size=32), 8)))
    assert len(lenses) == 8


def test_three_rows_of_a_whole_picture_are_green(tmp_path):
    write_woodscape(tmp_path, 1, size=(966, 1280))
    scene = open_scenes(tmp_path, "all", "labels")[0]
    assert scene.image.shape == (960, 1280, 3) and scene.lens.image_size.tolist() == [[960, 1280]]


def test_woodscape_without_its_file_of_classes_and_with_lists(tmp_path):
    write_woodscape(tmp_path)
    (tmp_path / "semantic_annotations" / "seg_annotation_info.json").unlink()
    lists = tmp_path / "lists"
    lists.mkdir()
    # As OmniDet's: pictures' names, and a test set whose labels are withheld.
    (lists / "train.txt").write_text("00000_FV.png\n00001_RV.png\n00005_RV.png\n")
    (lists / "val.txt").write_text("00002_MVL.png\n")
    (lists / "test.txt").write_text("08234_FV.png\n")
    with pytest.warns(LeftOut, match="4 pictures for no split"):
        scenes = open_scenes(tmp_path, "train", "labels", splits=lists)
    assert scenes.classes == WOODSCAPE_INFO["class_names"] and scenes.colors == []
    assert [scenes.file(k).stem for k in range(3)] == ["00000_FV", "00001_RV", "00005_RV"]
    with (
        pytest.warns(LeftOut),
        pytest.raises(FileNotFoundError, match=r"1 pictures for 'test' that are not in .*08234_FV"),
    ):
        open_scenes(tmp_path, "test", "labels", splits=lists)
    # As fishi's splits.json: stems.
    file = tmp_path / "splits.json"
    file.write_text(
        json.dumps({"train": ["00003_MVR"], "val": ["00004_FV"], "test": ["00006_MVL"]})
    )
    with pytest.warns(LeftOut):
        test = open_scenes(tmp_path, "test", "labels", splits=file)
    assert [test.file(k).stem for k in range(len(test))] == ["00006_MVL"]


def test_the_split_of_heal_swin(tmp_path):
    stems = [f"{k:05d}_{VIEWS[k % 4]}" for k in range(8234)]
    parts = heal_swin(stems)
    order = np.random.RandomState(42).permutation(8234)
    assert len(parts["train"]) == 6588 and len(parts["val"]) == 1646
    assert parts["train"][:3] == [stems[k] for k in order[:3]]
    assert sorted(parts["train"] + parts["val"]) == stems
    write_woodscape(tmp_path, 10)
    parts = [open_scenes(tmp_path, part, "labels", splits="heal-swin") for part in ("train", "val")]
    assert [len(part) for part in parts] == [9, 1]
    with pytest.raises(FileNotFoundError, match=r"splits with a name: \['heal-swin'\]"):
        open_scenes(tmp_path, "train", "labels", splits="omnidet")


def test_synwoodscape(tmp_path):
    write_synwoodscape(tmp_path)
    labels = open_scenes(tmp_path, "all", "labels")
    assert len(labels.classes) == 25 and labels.classes[13] == "sky"
    theta, azimuth = rays_of(labels[0].lens, (121, 160))
    assert (labels[0].target == labels_of(theta, azimuth, 25)).all()
    distances = open_scenes(tmp_path, "all", "distance")
    scene = distances[1]
    theta, azimuth = rays_of(scene.lens, (121, 160))
    sky = azimuth < -2
    assert (scene.target[sky] == 0).all() and sky.any()
    np.testing.assert_allclose(
        scene.target[~sky], distance_of(theta, azimuth)[~sky], rtol=0, atol=1e-4
    )
    assert distances.unknown.tolist() == [-1, int(sky.sum()), -1, -1]
    # Calibrations may be the cameras' in place of the frames'.
    for file in sorted((tmp_path / "calibration/calibration").iterdir()):
        file.rename(file.with_name(f"{file.stem.split('_')[1]}.json"))
    assert str(open_scenes(tmp_path, "all", "distance")[1].lens) == str(scene.lens)


def test_kitti360(tmp_path):
    write_kitti360(tmp_path)
    with pytest.warns(LeftOut, match="6 of 18 pictures in .* have no distance: left out"):
        scenes = open_scenes(tmp_path, "all", "distance")
    assert len(scenes) == 12 and scenes.cameras == ["image_02", "image_03"]
    scene = scenes[0]
    assert isinstance(scene.lens, Mei) and (scene.target[::2] == 0).all()
    theta, azimuth = rays_of(scene.lens, (140, 140))
    np.testing.assert_allclose(
        scene.target[1::2], distance_of(theta, azimuth)[1::2], rtol=0, atol=1 / 256
    )
    with pytest.warns(LeftOut):
        parts = [open_scenes(tmp_path, part, "distance") for part in ("train", "val", "test")]
    drives = [{part.file(k).parts[-4] for k in range(len(part))} for part in parts]
    assert [len(part) for part in parts] == [4, 4, 4] and not drives[0] & drives[1]
    _, lenses, targets = next(iter(DataLoader(SceneSamples(parts[0], size=32), 4)))
    assert len(lenses) == len(targets) == 4
    with pytest.raises(ValueError, match="KITTI-360's form, whose fisheye pictures have no labels"):
        open_scenes(tmp_path, "train", "labels")
    (tmp_path / "calibration" / "image_03.yaml").unlink()
    with pytest.warns(LeftOut), pytest.raises(FileNotFoundError, match=r"no .*image_03\.yaml"):
        open_scenes(tmp_path, "train", "distance")


def test_what_woodscape_does_not_have(tmp_path):
    write_woodscape(tmp_path, 4)
    with pytest.raises(ValueError, match="WoodScape's form, which has labels, no distances"):
        open_scenes(tmp_path, "train", "distance")
    calibration = tmp_path / "calibration" / "calibration" / "00002_MVL.json"
    calibration.unlink()
    with pytest.raises(FileNotFoundError, match=r"no lens for .*00002_MVL\.png: add .*00002_MVL"):
        open_scenes(tmp_path, "all", "labels")
    lens = tmp_path / "calibration" / "calibration" / "00000_FV.json"
    assert len(open_scenes(tmp_path, "all", "labels", lens=lens)) == 4
    info = tmp_path / "semantic_annotations" / "seg_annotation_info.json"
    info.write_text(json.dumps(WOODSCAPE_INFO | {"class_indexes": [1] * 10}))
    with pytest.raises(ValueError, match=r"seg_annotation_info\.json: class_indexes must be"):
        open_scenes(tmp_path, "all", "labels", lens=lens)


def test_labels_with_other_indexes(tmp_path):
    write_woodscape(tmp_path, 2)
    info = tmp_path / "semantic_annotations" / "seg_annotation_info.json"
    turned = {"class_indexes": list(range(9, -1, -1)), "color_scheme": "RGB"}
    info.write_text(json.dumps(WOODSCAPE_INFO | turned))
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes.classes == WOODSCAPE_INFO["class_names"][::-1]
    assert scenes.colors == WOODSCAPE_INFO["class_colors"][::-1]


# -- the plain form ---------------------------------------------------------------------------


def names(scenes):
    return [scenes.file(k).stem for k in range(len(scenes))]


def test_plain_folders_of_splits(tmp_path):
    for split, count in (("train", 10), ("valid", 3)):
        write_plain(tmp_path, count, split=split)
    assert len(open_scenes(tmp_path, "train", "labels")) == 10
    assert names(open_scenes(tmp_path, "val", "labels")) == ["000", "001", "002"]
    test = open_scenes(tmp_path, "test", "labels")  # "val" serves as the test set
    assert names(test) == ["000", "001", "002"] and test.classes == ["sky", "ground", "wall"]
    assert test.colors == [[0, 0, 255], [0, 128, 0], [200, 0, 0]]
    with pytest.raises(ValueError, match="'all' is of a folder without splits"):
        open_scenes(tmp_path, "all", "labels")
    with pytest.raises(ValueError, match=r"lists splits, and .* has a folder for each"):
        open_scenes(tmp_path, "train", "labels", splits="x")
    write_plain(tmp_path, 1)
    with pytest.raises(ValueError, match="may both be meant"):
        open_scenes(tmp_path, "train", "labels")


def test_only_a_test_set(tmp_path):
    write_plain(tmp_path, 2, split="test")
    assert len(open_scenes(tmp_path, "test", "labels")) == 2
    with pytest.raises(FileNotFoundError, match="there are \\['test'\\] pictures, and none for"):
        open_scenes(tmp_path, "train", "labels")


def test_hold_out_of_one_folder(tmp_path):
    write_plain(tmp_path, 20)
    parts = [names(open_scenes(tmp_path, p, "labels")) for p in ("train", "val", "test")]
    assert [len(part) for part in parts] == [16, 2, 2]
    assert sorted(chain(*parts)) == names(open_scenes(tmp_path, "all", "labels"))
    again = open_scenes(tmp_path, "train", "distance")
    assert names(again) == parts[0]
    with pytest.raises(FileNotFoundError, match="`holdout` 0 of 20 pictures leaves none"):
        open_scenes(tmp_path, "test", "labels", holdout=0)


@pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")
def test_lists_of_plain_scenes(tmp_path):
    write_plain(tmp_path, 6, name="a/{:02d}".format)
    file = tmp_path / "splits.json"
    file.write_text(json.dumps({"train": ["a/00", "a/01.png", "a/02"], "val": ["a/03"]}))
    with pytest.warns(LeftOut, match=r"lists 2 pictures for no split, \['a/04', 'a/05'\]"):
        assert names(open_scenes(tmp_path, "train", "labels", splits=file)) == ["00", "01", "02"]
    for lists, wrong in (
        ({"train": ["a/00"], "val": ["a/00"]}, "lists a/00 for 'train' and for 'val'"),
        ({"train": [3]}, "must list names for 'train', got 3"),
        ({"train": []}, "lists no pictures for 'train'"),
        ({"train": ["a/77"]}, r"1 pictures for 'train' that are not in .*a/77"),
    ):
        file.write_text(json.dumps(lists))
        with pytest.raises((ValueError, FileNotFoundError), match=wrong):
            open_scenes(tmp_path, "train", "labels", splits=file)


def test_lenses_of_pictures(tmp_path):
    write_plain(tmp_path, 6, own_lenses=True)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert len(scenes.cameras) == 6 and scenes.cameras[3].endswith("lenses/003.json")
    own = tmp_path / "lenses" / "003.json"
    own.write_text(json.dumps({"model": "Equidistant", "focal": 50.0, "theta_max": 1.2}))
    scenes = open_scenes(tmp_path, "all", "labels")  # two forms: as curves
    _, lenses, _ = next(iter(DataLoader(SceneSamples(scenes, size=32), 6)))
    assert lenses[3].theta_max.item() == pytest.approx(1.2) and len(lenses) == 6
    own.unlink()
    with pytest.raises(FileNotFoundError, match=r"no lens for .*003\.png: add .*lenses/003\.json"):
        open_scenes(tmp_path, "all", "labels")
    (tmp_path / "lens.json").write_text(
        json.dumps({"images": {"model": "Equidistant", "focal": 40.0, "theta_max": 1.1}})
    )
    shared = open_scenes(tmp_path, "all", "labels")
    assert shared[3].lens.theta_max.item() == pytest.approx(1.1)
    assert shared[2].lens.theta_max.item() > 1.5
    given = open_scenes(tmp_path, "all", "labels", lens='{"model": "Equidistant", "fov": 2.0}')
    assert given.cameras == ["of the lens"] and given[0].lens.theta_max.item() == 1
    own.write_text("{")
    with pytest.raises(ValueError, match=r"003\.json: it is no JSON"):
        open_scenes(tmp_path, "all", "labels")


def test_lenses_that_cannot_be_joined(tmp_path):
    write_plain(tmp_path, 3, own_lenses=True)
    tangential = dict(model="BrownConrady", focal=60, radial=[0.01], tangential=[0.02, 0.01])
    (tmp_path / "lenses" / "001.json").write_text(json.dumps(tangential | {"theta_max": 0.8}))
    with pytest.raises(ValueError, match=r"001\.json: cameras of several lens models"):
        open_scenes(tmp_path, "all", "labels")


def test_what_is_no_data_set(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no scenes in .*: darswin looks for images/STEM"):
        open_scenes(tmp_path, "train", "labels")
    with pytest.raises(FileNotFoundError, match="no folder"):
        open_scenes(tmp_path / "x", "train", "labels")
    for wrong in (dict(split="x"), dict(target="x"), dict(channels=2), dict(holdout=0.6)):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))}.* must be"):
            open_scenes(**dict(path=tmp_path, split="train", target="labels") | wrong)
    with pytest.raises(ValueError, match="`camera` a is one of a calibration: give `lens` too"):
        open_scenes(tmp_path, "train", "labels", camera="a")


# -- bad input --------------------------------------------------------------------------------


def test_missing_labels_and_pictures_are_named(tmp_path):
    write_plain(tmp_path, 4)
    (tmp_path / "labels" / "002.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"no labels for 1 of 4 .*images/002\.png"):
        open_scenes(tmp_path, "all", "labels")
    assert len(open_scenes(tmp_path, "all", "distance")) == 4
    (tmp_path / "images" / "003.png").unlink()
    file = tmp_path / "splits.json"
    file.write_text(json.dumps({"train": ["000", "001"]}))
    with pytest.warns(LeftOut) as said:
        assert len(open_scenes(tmp_path, "train", "labels", splits=file, holdout=0)) == 2
    assert any("1 files of labels have no picture" in str(w.message) for w in said)
    (tmp_path / "distance" / "001.npy").write_bytes(b"")
    with pytest.raises(ValueError, match=r"001\.npy and .*001\.png have one stem"):
        open_scenes(tmp_path, "all", "distance")


def test_wrong_labels_name_the_file(tmp_path):
    write_plain(tmp_path, 3)
    scenes = open_scenes(tmp_path, "all", "labels")
    file = tmp_path / "labels" / "001.png"
    good = scenes[1].target.copy()
    for array, wrong in (
        (np.where(good == 1, 7, good), r"001\.png holds the ids \[7\], and there are 3 classes"),
        (good.astype(np.uint16), r"001\.png must hold an id of 8 bits .* 16 bits"),
        (np.repeat(good[..., None], 3, 2), r"001\.png must hold an id .* colours \(RGB\)"),
        (good[:-1], r"labels/001\.png has 120×160 px, and its picture .*001\.png has 121×160"),
    ):
        cv2.imwrite(str(file), array)
        for read in (lambda: scenes[1], lambda: SceneSamples(scenes, skip_broken=True)[1]):
            with pytest.raises(ValueError, match=wrong):
                read()
    palette = Image.fromarray(good)
    palette.putpalette([200, 10, 30, 7, 7, 7, 90, 80, 70])
    palette.save(file)
    assert Image.open(file).mode == "P" and (scenes[1].target == good).all()
    cv2.imwrite(str(file), np.where(good == 1, IGNORE, good))
    assert scenes[1].target.max() == IGNORE
    assert scenes.unknown.tolist() == [-1, int((good == 1).sum()), -1]
    whole = file.read_bytes()
    for content in (b"", b"nothing", whole[: len(whole) // 2]):
        file.write_bytes(content)
        with pytest.raises(BrokenImageError, match=r"cannot read .*labels/001\.png"):
            scenes[1]
        dataset = SceneSamples(scenes, size=16, skip_broken=True)
        image, lens, target = dataset[1]
        assert (target == IGNORE).all() and target.dtype == torch.int64 and dataset.broken == [1]
        assert lens.image_size.tolist() == [[16, 16]] and image.unique().numel() == 3
    assert len(next(iter(DataLoader(dataset, 3)))[1]) == 3


def test_wrong_distances_name_the_file(tmp_path):
    write_plain(tmp_path, 3, targets=["distance"])
    scenes = open_scenes(tmp_path, "all", "distance")
    good = scenes[1].target.copy()
    file = tmp_path / "distance" / "001.png"
    cv2.imwrite(str(file), np.zeros((121, 160), np.uint8))
    with pytest.raises(ValueError, match=r"001\.png must hold a distance of 16 bits .* 1 × 8 bits"):
        scenes[1]
    file.unlink()
    file = file.with_suffix(".npy")
    unknown = good.astype(np.float64)
    unknown.ravel()[:6] = 0, -1, np.nan, np.inf, -np.inf, 1e300
    np.save(file, unknown)
    scenes = open_scenes(tmp_path, "all", "distance")
    assert (scenes[1].target.ravel()[:6] == 0).all() and scenes.unknown[1] == 6
    assert (scenes[1].target.ravel()[6:] == good.ravel()[6:]).all()
    for array, wrong in (
        (good[None], r"001\.npy must hold floating-point metres \(H, W\), but holds float32 \(1,"),
        (good.astype(int), "but holds int64"),
    ):
        np.save(file, array)
        with pytest.raises(ValueError, match=wrong):
            scenes[1]
    np.save(file, np.array([[{}]]), allow_pickle=True)
    with pytest.raises(BrokenImageError, match=r"cannot read .*001\.npy"):
        scenes[1]
    dataset = SceneSamples(scenes, size=16, skip_broken=True)
    assert (dataset[1][2] == 0).all() and dataset[1][2].dtype == torch.float32


def test_wrong_lenses_and_turned_pictures_name_the_file(tmp_path):
    write_plain(tmp_path, 3)
    scenes = open_scenes(tmp_path, "all", "labels")
    picture = tmp_path / "images" / "001.png"
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.open(picture).save(picture, exif=exif)
    with pytest.raises(ValueError, match=r"001\.png is stored turned, as its EXIF orientation 6"):
        scenes[1]
    lens = json.loads((tmp_path / "lens.json").read_text())
    (tmp_path / "lens.json").write_text(json.dumps(lens | {"image_size": [50, 50]}))
    scenes = open_scenes(tmp_path, "all", "labels")
    with pytest.raises(ValueError, match=r"000\.png: the lens is of pictures of 50×50 px"):
        scenes[0]


@pytest.mark.parametrize(
    ("classes", "wrong"),
    [
        (None, "no classes.json in"),
        ([], "must name the classes"),
        ({"names": ["a", "a"]}, "must name each class once"),
        ({"names": ["a", 3]}, "must name the classes as a list of words"),
        ({"names": ["a", "b"], "colors": [[0, 0, 0]]}, r"must give each of 2 classes a color"),
        ({"names": ["a"], "colors": [[0, 0, 256]]}, r"must give each of 1 classes a color"),
    ],
)
def test_wrong_classes_name_the_file(tmp_path, classes, wrong):
    write_plain(tmp_path, 2, classes=classes)
    with pytest.raises((ValueError, FileNotFoundError), match=wrong):
        open_scenes(tmp_path, "all", "labels")
    file = tmp_path / "mine.txt"
    file.write_text("a\nb\nc\n")
    assert open_scenes(tmp_path, "all", "labels", classes=file).classes == ["a", "b", "c"]
