"""Trees written as the data sets' authors describe them: none of the three can be downloaded."""

import json
from itertools import chain

import numpy as np
import pytest
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

from darswin.data import LeftOut, SceneSamples, open_scenes
from darswin.data.scenes.woodscape import heal_swin
from darswin.lens import Mei, load

INFO = "semantic_annotations/seg_annotation_info.json"


def names(scenes):
    return [scenes.file(k).stem for k in range(len(scenes))]


def lenses_of(scenes):
    """The lenses of a batch of all scenes."""
    return next(iter(DataLoader(SceneSamples(scenes, size=32), len(scenes))))[1]


@pytest.mark.parametrize(
    ("nested", "calibration"),
    [(True, "calibration/calibration"), (False, "calibration"),
     (False, "calibration_data/calibration")],
)  # fmt: skip
def test_woodscape(tmp_path, nested, calibration):
    write_woodscape(tmp_path, 4, nested=nested, calibration=calibration)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert len(scenes) == 4 and scenes.cameras == list(VIEWS)
    assert [scenes.camera_of(k) for k in range(4)] == [0, 1, 2, 3]
    assert scenes.classes == WOODSCAPE_INFO["class_names"]
    assert scenes.colors == [color[::-1] for color in WOODSCAPE_INFO["class_colors"]]
    for k, scene in enumerate(scenes):
        # One green row of 121 at each end is gone, as three of 966 are, and the lens follows.
        assert scene.image.shape == (119, 160, 3) and scene.target.shape == (119, 160)
        assert not (scene.image == (0, 255, 0)).all(-1).any()
        whole = load(tmp_path / calibration / f"{scenes.file(k).stem}.json").in_picture((121, 160))
        x, y = whole.center[0].tolist()
        assert scene.lens.center[0].tolist() == pytest.approx([x, y - 1])
        theta, azimuth = rays_of(whole, (121, 160))
        assert (scene.target == labels_of(theta, azimuth + 0.3 * k, 10)[1:-1]).all()
    assert len(lenses_of(scenes)) == 4
    turned = {"class_indexes": list(range(9, -1, -1)), "color_scheme": "RGB"}
    (tmp_path / INFO).write_text(json.dumps(WOODSCAPE_INFO | turned))
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes.classes == WOODSCAPE_INFO["class_names"][::-1]
    assert scenes.colors == WOODSCAPE_INFO["class_colors"][::-1]


def test_green_rows_are_a_part_of_the_height(tmp_path):
    write_woodscape(tmp_path, 1, size=(323, 428))  # 2 at each end, of 3 in a picture of 966
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes[0].image.shape == (319, 428, 3)
    assert scenes[0].lens.image_size.tolist() == [[319, 428]]
    assert scenes.lens_alone(0).image_size.tolist() == [[960, 1280]]


@pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")
def test_woodscape_without_its_file_of_classes_and_with_lists(tmp_path):
    write_woodscape(tmp_path)
    (tmp_path / INFO).unlink()
    lists, file = tmp_path / "lists", tmp_path / "splits.json"
    lists.mkdir()
    # As OmniDet's: pictures' names, and a test set whose labels are withheld.
    (lists / "train.txt").write_text("00000_FV.png\n00001_RV.png\n00005_RV.png\n")
    (lists / "val.txt").write_text("00002_MVL.png\n")
    (lists / "test.txt").write_text("08234_FV.png\n")
    with pytest.warns(LeftOut, match="4 pictures for no split"):
        scenes = open_scenes(tmp_path, "train", "labels", splits=lists)
    assert scenes.classes == WOODSCAPE_INFO["class_names"] and scenes.colors == []
    assert names(scenes) == ["00000_FV", "00001_RV", "00005_RV"]
    with pytest.raises(FileNotFoundError, match=r"1 pictures for 'test' .* not in .*08234_FV"):
        open_scenes(tmp_path, "test", "labels", splits=lists)
    # As fishi's splits.json: stems.
    parts = {"train": ["00003_MVR"], "val": ["00004_FV"], "test": ["00006_MVL"]}
    file.write_text(json.dumps(parts))
    assert names(open_scenes(tmp_path, "test", "labels", splits=file)) == ["00006_MVL"]


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
    expected = distance_of(theta, azimuth)
    np.testing.assert_allclose(scene.target[~sky], expected[~sky], rtol=0, atol=1e-4)
    assert distances.unknown.tolist() == [-1, int(sky.sum()), -1, -1]
    # Calibrations may be the cameras' in place of the frames'.
    for file in sorted((tmp_path / "calibration/calibration").iterdir()):
        file.rename(file.with_name(f"{file.stem.split('_')[1]}.json"))
    assert str(open_scenes(tmp_path, "all", "distance")[1].lens) == str(scene.lens)


@pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")
def test_kitti360(tmp_path):
    write_kitti360(tmp_path)
    with pytest.warns(LeftOut, match="6 of 18 pictures in .* have no distance: left out"):
        scenes = open_scenes(tmp_path, "all", "distance")
    assert len(scenes) == 12 and scenes.cameras == ["image_02", "image_03"]
    scene = scenes[0]
    assert isinstance(scene.lens, Mei) and (scene.target[::2] == 0).all()
    expected = distance_of(*rays_of(scene.lens, (140, 140)))
    np.testing.assert_allclose(scene.target[1::2], expected[1::2], rtol=0, atol=1 / 256)
    parts = [open_scenes(tmp_path, part, "distance") for part in ("train", "val", "test")]
    drives = [{part.file(k).parts[-4] for k in range(len(part))} for part in parts]
    assert [len(part) for part in parts] == [4, 4, 4] and not drives[0] & drives[1]
    assert len(lenses_of(parts[0])) == 4
    with pytest.raises(ValueError, match="KITTI-360's form, whose fisheye pictures have no labels"):
        open_scenes(tmp_path, "train", "labels")
    (tmp_path / "calibration" / "image_03.yaml").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"no lens for .*: add .*image_03\.yaml, or give `lens`"
    ):
        open_scenes(tmp_path, "train", "distance")


def test_what_woodscape_does_not_have(tmp_path):
    write_woodscape(tmp_path, 4)
    with pytest.raises(ValueError, match="WoodScape's form, which has labels, no distances"):
        open_scenes(tmp_path, "train", "distance")
    (tmp_path / "calibration" / "calibration" / "00002_MVL.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"no lens for .*00002_MVL\.png: add .*00002_MVL"):
        open_scenes(tmp_path, "all", "labels")
    lens = tmp_path / "calibration" / "calibration" / "00000_FV.json"
    (tmp_path / INFO).write_text(json.dumps(WOODSCAPE_INFO | {"class_indexes": [1] * 10}))
    with pytest.raises(ValueError, match=r"seg_annotation_info\.json: class_indexes must be"):
        open_scenes(tmp_path, "all", "labels", lens=lens)


# -- the plain form ---------------------------------------------------------------------------


def test_plain_folders_of_splits(tmp_path):
    write_plain(tmp_path, 2, split="test")
    with pytest.raises(FileNotFoundError, match=r"there are \['test'\] pictures, and none for"):
        open_scenes(tmp_path, "train", "labels")
    write_plain(tmp_path, 10, split="train")
    parts = [names(open_scenes(tmp_path, part, "labels")) for part in ("train", "val", "test")]
    assert [len(part) for part in parts] == [9, 1, 2] and not set(parts[0]) & set(parts[1])
    (tmp_path / "test").rename(tmp_path / "valid")
    test = open_scenes(tmp_path, "test", "labels")  # "val" serves as the test set
    assert names(test) == names(open_scenes(tmp_path, "val", "labels")) == ["000", "001"]
    assert test.classes == ["sky", "ground", "wall"]
    assert test.colors == [[0, 0, 255], [0, 128, 0], [200, 0, 0]]
    for options, message in (
        (dict(split="all"), "'all' is of a folder without splits"),
        (dict(split="train", splits="x"), r"lists splits, and .* has a folder for each"),
    ):
        with pytest.raises(ValueError, match=message):
            open_scenes(tmp_path, target="labels", **options)
    write_plain(tmp_path, 1)
    with pytest.raises(ValueError, match="may both be meant"):
        open_scenes(tmp_path, "train", "labels")


def test_hold_out_of_one_folder(tmp_path):
    write_plain(tmp_path, 20)
    parts = [names(open_scenes(tmp_path, p, "labels")) for p in ("train", "val", "test")]
    assert [len(part) for part in parts] == [16, 2, 2]
    assert sorted(chain(*parts)) == names(open_scenes(tmp_path, "all", "labels"))
    with pytest.raises(FileNotFoundError, match="`holdout` 0 of 20 pictures leaves none"):
        open_scenes(tmp_path, "test", "labels", holdout=0)


@pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")
def test_lists_of_plain_scenes(tmp_path):
    write_plain(tmp_path, 6, name="a/{:02d}".format)
    file = tmp_path / "splits.json"
    file.write_text(json.dumps({"train": ["a/00", "a/01.png", "a/02"], "val": ["a/03"]}))
    with pytest.warns(LeftOut, match=r"lists 2 pictures for no split, \['a/04', 'a/05'\]"):
        assert names(open_scenes(tmp_path, "train", "labels", splits=file)) == ["00", "01", "02"]
    for lists, message in (
        ({"train": ["a/00"], "val": ["a/00"]}, "lists a/00 for 'train' and for 'val'"),
        ({"train": [3]}, "must list names for 'train', got 3"),
        ({"train": []}, "lists no pictures for 'train'"),
        ({"train": ["a/77"]}, r"1 pictures for 'train' that are not in .*a/77"),
    ):
        file.write_text(json.dumps(lists))
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            open_scenes(tmp_path, "train", "labels", splits=file)


def test_lenses_of_pictures(tmp_path):
    write_plain(tmp_path, 6, own_lenses=True)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert len(scenes.cameras) == 6 and scenes.cameras[3].endswith("lenses/003.json")
    own = tmp_path / "lenses" / "003.json"
    own.write_text(json.dumps({"model": "Equidistant", "focal": 50.0, "theta_max": 1.2}))
    lenses = lenses_of(open_scenes(tmp_path, "all", "labels"))  # two forms: as curves
    assert lenses[3].theta_max.item() == pytest.approx(1.2) and len(lenses) == 6
    own.unlink()
    with pytest.raises(FileNotFoundError, match=r"no lens for .*003\.png: add .*lenses/003\.json"):
        open_scenes(tmp_path, "all", "labels")
    shared = {"images": {"model": "Equidistant", "focal": 40.0, "theta_max": 1.1}}
    (tmp_path / "lens.json").write_text(json.dumps(shared))
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes[3].lens.theta_max.item() == pytest.approx(1.1)
    assert scenes[2].lens.theta_max.item() > 1.5
    given = open_scenes(tmp_path, "all", "labels", lens='{"model": "Equidistant", "fov": 2.0}')
    assert given.cameras == ["of the lens"] and given[0].lens.theta_max.item() == 1
    tangential = dict(model="BrownConrady", focal=60, radial=[0.01], tangential=[0.02, 0.01])
    for text, message in (
        ("{", "it is no JSON"),
        (json.dumps(tangential | {"theta_max": 0.8}), "cameras of several lens models"),
    ):
        own.write_text(text)
        with pytest.raises(ValueError, match=rf"003\.json: {message}"):
            open_scenes(tmp_path, "all", "labels")


def test_missing_labels_and_pictures_are_named(tmp_path):
    write_plain(tmp_path, 4)
    (tmp_path / "labels" / "002.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"no labels for 1 of 4 .*images/002\.png"):
        open_scenes(tmp_path, "all", "labels")
    assert len(open_scenes(tmp_path, "all", "distance")) == 4
    (tmp_path / "images" / "003.png").rename(tmp_path / "images" / "003.gif")
    file = tmp_path / "splits.json"
    file.write_text(json.dumps({"train": ["000", "001"]}))
    with pytest.warns(LeftOut) as caught:
        assert len(open_scenes(tmp_path, "train", "labels", splits=file, holdout=0)) == 2
    text = "\n".join(str(warning.message) for warning in caught)
    assert "1 files of labels have no picture" in text
    assert "pictures that darswin does not read, ['003']" in text
    (tmp_path / "distance" / "001.npy").write_bytes(b"")
    with pytest.raises(ValueError, match=r"001\.npy and .*001\.png have one stem"):
        open_scenes(tmp_path, "all", "distance")


def test_what_is_no_data_set(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no scenes in .*: darswin looks for images/STEM"):
        open_scenes(tmp_path, "train", "labels")
    with pytest.raises(FileNotFoundError, match="no folder"):
        open_scenes(tmp_path / "x", "train", "labels")
    for wrong in (dict(split="x"), dict(target="x"), dict(channels=2), dict(holdout=0.5)):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))}`? must be"):
            open_scenes(**dict(path=tmp_path, split="train", target="labels") | wrong)
    with pytest.raises(ValueError, match="`camera` a is one of a calibration: give `lens` too"):
        open_scenes(tmp_path, "train", "labels", camera="a")
