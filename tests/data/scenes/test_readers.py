"""Trees written as the data sets' authors describe them: none of the three can be downloaded."""

import json
import shutil
from functools import partial
from itertools import chain

import cv2
import numpy as np
import pytest
from scenes import (
    CLASSES,
    VIEWS,
    WOODSCAPE,
    WOODSCAPE_INFO,
    distance_of,
    labels_of,
    rays_of,
    write,
    write_cityscapes,
    write_coco,
    write_kitti360,
    write_outlines,
    write_plain,
    write_synwoodscape,
    write_woodscape,
)
from torch.utils.data import DataLoader

from darswin.data import IGNORE, SceneSamples, open_scenes
from darswin.data.scenes.woodscape import heal_swin
from darswin.data.splits import LeftOut
from darswin.lens import KannalaBrandt, Mei, load, save

INFO = "semantic_annotations/seg_annotation_info.json"


def names(scenes):
    return [scenes.file(k).stem for k in range(len(scenes))]


def refused(folder, message, split="train", target="labels", error=ValueError, **options):
    with pytest.raises(error, match=message):
        open_scenes(folder, split, target, **options)


missing = partial(refused, error=FileNotFoundError)


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
    missing(tmp_path, r"1 pictures for 'test' .* not in .*08234_FV", split="test", splits=lists)
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
    missing(tmp_path, r"named splits: \['heal-swin'\]", splits="omnidet")


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
    refused(tmp_path, "looks like KITTI-360, whose fisheye pictures have no labels")
    (tmp_path / "calibration" / "image_03.yaml").unlink()
    missing(tmp_path, r"no lens for .*: add .*image_03\.yaml, or give `lens`", target="distance")


def test_cityscapes(tmp_path):
    write_cityscapes(tmp_path)
    missing(tmp_path, r"no lens\.json in .*, or give `lens`")
    shutil.copy(WOODSCAPE, tmp_path / "lens.json")
    scenes = open_scenes(tmp_path, "train", "labels")
    assert names(scenes) == [f"aachen_{k:06d}_000019_leftImg8bit" for k in range(3)]
    assert len(scenes.classes) == len(scenes.colors) == 19 and scenes.classes[18] == "bicycle"
    theta, azimuth = rays_of(scenes[0].lens, (121, 160))
    ids = labels_of(theta, azimuth)  # 6 is no class, 7 the first and 8 the second
    for k in range(2):
        assert (scenes[0].target[ids == k + 1] == k).all()
    assert (scenes[0].target[ids == 0] == IGNORE).all()
    for split in ("val", "test"):  # the labels of "test" are withheld
        assert names(open_scenes(tmp_path, split, "labels")) == ["lindau_000000_000019_leftImg8bit"]
    refused(tmp_path, "looks like Cityscapes, which has labels but no", target="distance")
    (tmp_path / "two.txt").write_text("road\nother\n")
    refused(tmp_path, r"two\.txt must name 19 classes, but names 2", classes=tmp_path / "two.txt")


@pytest.mark.parametrize(
    "ending",
    ["_gtFine_labelTrainIds", "_gtFine_color", "_gtFine_instanceIds", "_gtCoarse_labelIds",
     "_labelIds", ""],
)  # fmt: skip
def test_other_endings_and_folders_of_cityscapes_are_named(tmp_path, ending):
    write_cityscapes(tmp_path)
    shutil.copy(WOODSCAPE, tmp_path / "lens.json")
    (tmp_path / "gtFine").rename(tmp_path / "gtCoarse")
    missing(tmp_path, r"no folder .*gtFine/train: .*leftImg8bit/train")
    (tmp_path / "gtCoarse").rename(tmp_path / "gtFine")
    for file in (tmp_path / "gtFine").rglob("*.png"):
        if file.stem.endswith("instanceIds"):
            file.unlink()
        else:
            file.rename(file.with_name(file.name.replace("_gtFine_labelIds", ending)))
    words = rf"hold .* end in _gtFine_labelIds, .*but they end in \['{ending}'\]"
    missing(tmp_path, f"gtFine/train must {words}")
    for file in (tmp_path / "leftImg8bit").rglob("*.png"):
        file.rename(file.with_name(file.name.replace("leftImg8bit", "rightImg8bit")))
    missing(tmp_path, r"leftImg8bit/train must hold .*_leftImg8bit, .*_rightImg8bit")


def test_coco_panoptic(tmp_path):
    write_coco(tmp_path)
    shutil.copy(WOODSCAPE, tmp_path / "lens.json")
    scenes = open_scenes(tmp_path, "train", "labels")
    assert scenes.classes == CLASSES["names"] and scenes.colors == CLASSES["colors"]
    expected = labels_of(*rays_of(scenes[0].lens, (121, 160)))
    expected[:, :9] = IGNORE
    assert (scenes[0].target == expected).all() and len(scenes) == 2
    assert names(open_scenes(tmp_path, "test", "labels")) == names(scenes)  # those of val2017
    (tmp_path / "map.json").write_text(json.dumps({"200": "thing", "1": "thing"}))
    mapped = open_scenes(tmp_path, "train", "labels", label_map=tmp_path / "map.json")
    assert mapped.classes == ["thing"]
    unlabelled = (expected == 1) | (expected == IGNORE)
    assert (mapped[0].target == np.where(unlabelled, IGNORE, 0)).all()
    file = tmp_path / "annotations" / "panoptic_train2017.json"
    for text, message in (
        ("{}", "it lacks 'categories'"),
        ("[]", r"must be a JSON object, got \["),
    ):
        file.write_text(text)
        refused(tmp_path, rf"json is not in COCO's panoptic format: .*{message}")
    refused(tmp_path, "looks like COCO panoptic, which has labels but no", target="distance")


def annotated(folder, change):
    """The scenes of COCO's tree after a change of the first annotation, or of the content."""
    file = folder / "annotations" / "panoptic_train2017.json"
    if not (folder / "lens.json").exists():
        write_coco(folder)
        shutil.copy(WOODSCAPE, folder / "lens.json")
        shutil.copy(file, folder / "before.json")
    content = json.loads((folder / "before.json").read_text())
    change(content["annotations"][0], content)
    file.write_text(json.dumps(content))
    return open_scenes(folder, "train", "labels")


@pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")
@pytest.mark.parametrize(
    ("place", "file_name", "is_found"),
    [
        *(("a/b", name, True)
          for name in ("a/b/{}", "./a//b/{}", r"a\b\{}", "panoptic_train2017/a/b/{}")),
        ("b", "a/b/{}", True), (".", "a/b/{}", True), (".", "{}", True),
        *(("a/b", name, False) for name in ("b/{}", "{}", "a/c/{}")),
    ],
)  # fmt: skip
def test_folders_in_coco(tmp_path, place, file_name, is_found):
    expected = annotated(tmp_path, lambda first, content: None)[0].target
    for folder in ("train2017", "annotations/panoptic_train2017"):
        files = [file for file in (tmp_path / folder).iterdir() if file.is_file()]
        (tmp_path / folder / place).mkdir(exist_ok=True, parents=True)
        for file in files:
            file.rename(tmp_path / folder / place / file.name)

    def named(first, content):
        for annotation in content["annotations"]:
            annotation["file_name"] = file_name.format(annotation["file_name"])

    if not is_found:
        with pytest.raises(FileNotFoundError, match=r"none of 2 pictures in .* has labels"):
            annotated(tmp_path, named)
        return
    scenes = annotated(tmp_path, named)
    assert len(scenes) == 2 and (scenes[0].target == expected).all()


def with_segment(number, **entries):
    return lambda first, content: first["segments_info"][number].update(entries)


def with_entry(name, value):
    return lambda first, content: content.update({name: value})


def with_first(list_, **entries):
    return lambda first, content: content[list_][0].update(entries)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_segment(1, category_id=69), r"000\.png: the segment 300 has the category 69, but"),
        (with_segment(1, category_id="17"), r"has the category '17', but .* are \[1, 17, 200\]"),
        (with_segment(1, category_id=None), "has the category None"),
        (with_segment(1, id=-300), "a whole number above 0, .*, got -300"),
        (with_segment(1, id=0), "above 0, which means no segment, got 0"),
        (with_segment(1, id=300.5), r"got 300\.5"),
        (with_segment(1, id="300"), "got '300'"),
        (with_segment(1, id=7), r"000\.png: two segments have the colour of the id 7"),
        (with_segment(1, id=7 + 2**24), "two segments have the colour"),
        (lambda first, content: first["segments_info"][1].pop("id"), "a segment has no 'id'"),
        (lambda first, content: content["annotations"].append(first), "two annotations for .*000"),
        (lambda first, content: content["categories"][2].update(id=1),
         r"train2017\.json defines the category 1 twice"),
        (lambda first, content: first.pop("segments_info"), "panoptic format: it lacks 'segments"),
        (with_segment(1, category_id=[1]),
         r"the segment 300 has the category \[1\], but the known"),
        (with_segment(1, category_id=True), "has the category True, but the known"),
        (with_segment(1, id=[300]), r"a whole number above 0, .*, got \[300\]"),
        (with_entry("categories", None), "format: 'categories' must be a list, got None"),
        (with_entry("categories", {}), r"format: 'categories' must be a list, got \{\}"),
        (with_entry("categories", ["sky"]), "format: 'categories' must list objects, got 'sky'"),
        (with_entry("annotations", None), "format: 'annotations' must be a list, got None"),
        (with_entry("annotations", [7]), "format: 'annotations' must list objects, got 7"),
        (with_first("annotations", segments_info=None), "'segments_info' must be a list, got None"),
        (with_first("annotations", segments_info=[3]), "'segments_info' must list objects, got 3"),
        (with_first("annotations", file_name=["a"]), r"'file_name' must be a text, got \['a'\]"),
        (with_first("categories", id=[1]), r"format: 'id' must be a whole number, got \[1\]"),
        (with_first("categories", name=None), "format: 'name' must be a text, got None"),
        (lambda first, content: content["categories"][0].pop("name"), "it lacks 'name' in {'"),
    ],
)  # fmt: skip
def test_wrong_annotations_of_coco_are_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=rf"panoptic_train2017\.json.*{message}|{message}"):
        annotated(tmp_path, change)


@pytest.mark.parametrize(
    ("id_", "color"),
    [
        (1, (1, 0, 0)),
        (2**24 - 1, (255, 255, 255)),
        (2**16, (0, 0, 1)),
        # Larger ids are written without their higher digits.
        (2**24 + 301, (45, 1, 0)),
        (2**31 + 5, (5, 0, 0)),
        (2**32 - 1, (255, 255, 255)),
        (2**63 + 256, (0, 1, 0)),
    ],
)
def test_ids_of_coco_segments(tmp_path, id_, color):
    expected = annotated(tmp_path, lambda first, content: None)[0].target
    scenes = annotated(tmp_path, with_segment(1, id=id_))
    file = scenes.target_file(0)
    with pytest.raises(ValueError, match=r"000\.png holds the segment 300, but its annotation"):
        scenes[0]
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)
    picture[(picture == (300 % 256, 1, 0)).all(-1)] = color
    write(file, picture[..., ::-1])
    assert (scenes[0].target == expected).all()


@pytest.mark.parametrize("id_", [2**24, 2**31])
def test_a_coco_segment_that_has_the_colour_of_no_segment(tmp_path, id_):
    """It names no pixel, and black pixels might be its own."""
    annotated(tmp_path, lambda first, content: None)
    more = {"id": id_, "category_id": 17}
    scenes = annotated(tmp_path, lambda first, content: first["segments_info"].append(more))
    with pytest.raises(ValueError, match=r"000\.png holds the segment 0, but its annotation lacks"):
        scenes[0]
    file = scenes.target_file(0)
    picture = cv2.imread(str(file), cv2.IMREAD_COLOR_RGB)
    picture[:, :9] = picture[:, 9:10]
    write(file, picture[..., ::-1])
    assert (scenes[0].target < 3).all()
    scenes = annotated(tmp_path, lambda first, content: first.update(segments_info=[more]))
    with pytest.raises(ValueError, match=r"000\.png holds the segment \d+, but its annotation"):
        scenes[0]


@pytest.mark.parametrize(
    ("content", "classes", "expected"),
    [
        ({"0": "b", "1": None, "2": "a"}, ["b", "a"], {0: 0, 1: IGNORE, 2: 1}),
        ({"0": 2, "1": None, "2": 0}, CLASSES["names"], {0: 2, 1: IGNORE, 2: 0}),
        ({"0": "x", "1": "x", "2": 255, "999": "x"}, ["x"], {0: 0, 1: 0, 2: IGNORE}),
    ],
)
def test_label_maps(tmp_path, content, classes, expected):
    write_plain(tmp_path, 1)
    file = tmp_path / "map.json"
    before = open_scenes(tmp_path, "all", "labels")[0].target
    file.write_text(json.dumps(content))
    scenes = open_scenes(tmp_path, "all", "labels", label_map=file)
    assert scenes.classes == classes
    for id_, class_ in expected.items():
        assert (scenes[0].target[before == id_] == class_).all()


def test_ids_that_no_table_knows_are_named(tmp_path):
    """In every reader; ids that the authors defined are known, with a class or without."""
    write_cityscapes(tmp_path / "cityscapes")
    write_woodscape(tmp_path / "woodscape", 8)
    write_synwoodscape(tmp_path / "synwoodscape")
    write_plain(tmp_path / "plain", 8)
    (tmp_path / "map.json").write_text('{"1": "thing"}')
    lens, mapped = dict(lens=WOODSCAPE), dict(label_map=tmp_path / "map.json")
    for name, options, known, unknown in (
        ("cityscapes", lens, {0: IGNORE, 6: IGNORE, 7: 0, 33: 18}, [34, 100, 254]),
        ("cityscapes", lens | mapped, {0: IGNORE, 1: 0, 33: IGNORE}, [34, 254]),
        ("woodscape", {}, {0: 0, 9: 9}, [10, 254]),
        ("woodscape", mapped, {0: IGNORE, 1: 0, 9: IGNORE}, [10, 254]),
        ("synwoodscape", {}, {0: 0, 24: 24}, [25, 254]),
        ("synwoodscape", mapped, {0: IGNORE, 1: 0, 24: IGNORE}, [25, 254]),
        ("plain", {}, {0: 0, 2: 2}, [3, 254]),
        ("plain", mapped, {1: 0}, [0, 2, 254]),
    ):
        scenes = open_scenes(tmp_path / name, "train", "labels", **options)
        file = scenes.target_file(0)
        for id_, class_ in (known | {IGNORE: IGNORE}).items():
            write(file, np.full((121, 160), id_, np.uint8))
            assert (scenes[0].target == class_).all(), (name, id_)
        labels = np.full((121, 160), next(iter(known)), np.uint8)
        for id_ in unknown:
            labels[60, 80] = id_
            write(file, labels)
            with pytest.raises(ValueError, match=rf"{file} holds the ids \[{id_}\], but"):
                scenes[0]


def test_wrong_label_maps_are_named(tmp_path):
    write_plain(tmp_path, 1)
    file = tmp_path / "map.json"
    for content, message in (
        ([0], r"map\.json must be a JSON object that maps ids to classes"),
        ({"x": 0}, "got the id 'x'"),
        ({"0": 3}, "maps the id 0 to 3, but the classes are .*sky"),
        ({"0": "sky", "1": 1}, r"maps the id 1 to 1, but the classes are \['sky'\]"),
        ({"0": True}, "maps the id 0 to True"),
        ({"0": "sky", "00": "sea"}, "maps the id 0 twice"),
    ):
        file.write_text(json.dumps(content))
        refused(tmp_path, message, split="all", label_map=file)
    (tmp_path / "mine.txt").write_text("sky\nsea\n")
    file.write_text(json.dumps({"0": "sky", "1": "land"}))
    refused(
        tmp_path,
        "maps the id 1 to 'land', but the classes are",
        split="all",
        label_map=file,
        classes=tmp_path / "mine.txt",
    )


def test_what_woodscape_does_not_have(tmp_path):
    write_woodscape(tmp_path, 4)
    refused(tmp_path, "looks like WoodScape, which has labels but no", target="distance")
    (tmp_path / "calibration" / "calibration" / "00002_MVL.json").unlink()
    missing(tmp_path, r"no lens for .*00002_MVL\.png: add .*00002_MVL", split="all")
    lens = tmp_path / "calibration" / "calibration" / "00000_FV.json"
    (tmp_path / INFO).write_text(json.dumps(WOODSCAPE_INFO | {"class_indexes": [1] * 10}))
    refused(tmp_path, r"seg_annotation_info\.json: class_indexes must be", split="all", lens=lens)


@pytest.mark.parametrize(
    "place", ["annotations/instances_train.json", "_annotations.coco.json", "train/result.json"]
)
@pytest.mark.parametrize("pictures", ["images", "train", "train/images", "photos"])
def test_outlines_of_objects_are_no_labels(tmp_path, place, pictures):
    """The error names the file and the page with the lines that make masks."""
    write_outlines(tmp_path)
    file = tmp_path / place
    if pictures != "images":
        (tmp_path / pictures).parent.mkdir(exist_ok=True)
        (tmp_path / "images").rename(tmp_path / pictures)
    file.parent.mkdir(exist_ok=True)
    (tmp_path / "annotations" / "instances_train.json").rename(file)
    missing(tmp_path, rf"{file.name} has outlines .* docs/howto/scenes")


# -- the plain form ---------------------------------------------------------------------------


def test_plain_folders_of_splits(tmp_path):
    write_plain(tmp_path, 2, split="test")
    missing(tmp_path, r"there are \['test'\] pictures, but none for")
    write_plain(tmp_path, 10, split="train")
    parts = [names(open_scenes(tmp_path, part, "labels")) for part in ("train", "val", "test")]
    assert [len(part) for part in parts] == [9, 1, 2] and not set(parts[0]) & set(parts[1])
    # The files of a split count before those of the root.
    (tmp_path / "lens.json").write_text('{"model": "Equidistant", "fov": 2.0}')
    (tmp_path / "train" / "classes.json").write_text('["a", "b", "c"]')
    scenes = open_scenes(tmp_path, "train", "labels")
    assert scenes.cameras == [str(tmp_path / "train" / "lens.json")]
    assert scenes.classes == ["a", "b", "c"]
    (tmp_path / "test").rename(tmp_path / "valid")
    test = open_scenes(tmp_path, "test", "labels")  # "val" serves as the test set
    assert names(test) == names(open_scenes(tmp_path, "val", "labels")) == ["000", "001"]
    assert test.classes == ["sky", "ground", "wall"]
    assert test.colors == [[0, 0, 255], [0, 128, 0], [200, 0, 0]]
    for options, message in (
        (dict(split="all"), "'all' needs a folder without splits"),
        (dict(split="train", splits="x"), r"lists splits, but .* has a folder for each"),
    ):
        with pytest.raises(ValueError, match=message):
            open_scenes(tmp_path, target="labels", **options)
    write_plain(tmp_path, 1)
    refused(tmp_path, "has both")


def test_hold_out_of_one_folder(tmp_path):
    write_plain(tmp_path, 20)
    parts = [names(open_scenes(tmp_path, p, "labels")) for p in ("train", "val", "test")]
    assert [len(part) for part in parts] == [16, 2, 2]
    assert sorted(chain(*parts)) == names(open_scenes(tmp_path, "all", "labels"))
    missing(tmp_path, "`holdout` 0 of 20 pictures leaves none", split="test", holdout=0)


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
    missing(tmp_path, r"no lens for .*003\.png: add .*lenses/003\.json", split="all")
    shared = {"images": {"model": "Equidistant", "focal": 40.0, "theta_max": 1.1}}
    (tmp_path / "lens.json").write_text(json.dumps(shared))
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes[3].lens.theta_max.item() == pytest.approx(1.1)
    assert scenes[2].lens.theta_max.item() > 1.5
    given = open_scenes(tmp_path, "all", "labels", lens='{"model": "Equidistant", "fov": 2.0}')
    assert given.cameras == ["of the lens"] and given[0].lens.theta_max.item() == 1
    tangential = dict(model="BrownConrady", focal=60, radial=[0.01], tangential=[0.02, 0.01])
    for text, message in (
        ("{", "it is not JSON"),
        (json.dumps(tangential | {"theta_max": 0.8}), "cameras of several lens models"),
    ):
        own.write_text(text)
        refused(tmp_path, rf"003\.json: {message}", split="all")


@pytest.mark.parametrize("name", ["lens.yaml", "lens.YML", "lens.xml", "lens.txt", "lens.json"])
def test_a_calibration_beside_the_pictures(tmp_path, name):
    lens = load(WOODSCAPE.parent / "opencv_fisheye.yaml").resized((121, 160))
    write_plain(tmp_path, 2, lens=lens)
    (tmp_path / "lens.json").unlink()
    save(lens, tmp_path / name)
    scenes = open_scenes(tmp_path, "all", "labels")
    assert isinstance(scenes[1].lens, KannalaBrandt)
    (tmp_path / "lenses").mkdir()
    save(lens.replace(focal=lens.focal * 2), tmp_path / "lenses" / f"001{(tmp_path / name).suffix}")
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes[1].lens.focal.item() == pytest.approx(2 * scenes[0].lens.focal.item())
    (tmp_path / "lens.npz").touch()
    refused(tmp_path, "are both calibrations: keep one", split="all")


def test_a_camera_of_the_calibration_beside_the_pictures(tmp_path):
    write_plain(tmp_path, 2)
    (tmp_path / "lens.json").unlink()
    shutil.copy(WOODSCAPE.parent / "kalibr_fov.yaml", tmp_path / "lens.yaml")
    refused(tmp_path, r"lens\.yaml: it has several cameras, choose one with `camera`", split="all")
    lenses = [open_scenes(tmp_path, "all", "labels", camera=f"cam{k}").lenses for k in range(2)]
    assert str(lenses[0].lens_alone(None)) != str(lenses[1].lens_alone(None))


def test_missing_labels_and_pictures_are_named(tmp_path):
    write_plain(tmp_path, 4)
    (tmp_path / "labels" / "002.png").unlink()
    missing(tmp_path, r"no labels for 1 of 4 .*images/002\.png", split="all")
    assert len(open_scenes(tmp_path, "all", "distance")) == 4
    (tmp_path / "images" / "003.png").rename(tmp_path / "images" / "003.gif")
    file = tmp_path / "splits.json"
    file.write_text(json.dumps({"train": ["000", "001"]}))
    with pytest.warns(LeftOut) as caught:
        assert len(open_scenes(tmp_path, "train", "labels", splits=file, holdout=0)) == 2
    text = "\n".join(str(warning.message) for warning in caught)
    assert "1 files of labels have no picture" in text
    assert "pictures that darswin does not read, 1 .gif" in text
    (tmp_path / "distance" / "001.npy").write_bytes(b"")
    refused(tmp_path, r"001\.npy and .*001\.png have the same stem", split="all", target="distance")


def test_what_is_no_data_set(tmp_path):
    missing(tmp_path, r"no scenes in .*: darswin looks for images/STEM")
    missing(tmp_path / "x", "no folder")
    for wrong in (dict(split="x"), dict(target="x"), dict(channels=2), dict(holdout=0.5)):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))}`? must be"):
            open_scenes(**dict(path=tmp_path, split="train", target="labels") | wrong)
    write_plain(tmp_path, 1, own_lenses=True)
    refused(tmp_path, "`camera` a needs a calibration: give `lens` too", split="all", camera="a")
