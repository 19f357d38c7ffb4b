"""Trees written as the data sets' authors describe them: none of the three can be downloaded."""

import json
import shutil
from functools import partial
from itertools import chain

import cv2
import helpers
import numpy as np
import pytest
from scenes import (
    CLASSES,
    SIZE,
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
SPLITS = ("train", "val", "test")
left_out_is_allowed = pytest.mark.filterwarnings("ignore::darswin.data.splits.LeftOut")


def names(scenes):
    return [scenes.file(k).stem for k in range(len(scenes))]


def refused(folder, message, split="train", target="labels", error=ValueError, **options):
    helpers.refused(message, open_scenes, folder, split, target, error=error, **options)


missing = partial(refused, error=FileNotFoundError)


def lenses_of(scenes):
    """The lenses of a batch of all scenes."""
    return next(iter(DataLoader(SceneSamples(scenes, size=32), len(scenes))))[1]


# -- WoodScape and SynWoodScape ---------------------------------------------------------------


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
    for k, scene in enumerate(scenes):
        # One green row of 121 at each end is gone, as three of 966 are, and the lens follows.
        assert scene.image.shape == (119, 160, 3) and scene.target.shape == (119, 160)
        assert not (scene.image == (0, 255, 0)).all(-1).any()
        whole = load(tmp_path / calibration / f"{scenes.file(k).stem}.json").in_picture(SIZE)
        x, y = whole.center[0].tolist()
        assert scene.lens.center[0].tolist() == pytest.approx([x, y - 1])
        theta, azimuth = rays_of(whole, SIZE)
        assert (scene.target == labels_of(theta, azimuth + 0.3 * k, 10)[1:-1]).all()
    assert len(lenses_of(scenes)) == 4


def test_the_classes_of_woodscape(tmp_path):
    write_woodscape(tmp_path, 2)
    class_names, colors = WOODSCAPE_INFO["class_names"], WOODSCAPE_INFO["class_colors"]
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes.classes == class_names and scenes.colors == [color[::-1] for color in colors]
    turned = {"class_indexes": list(range(9, -1, -1)), "color_scheme": "RGB"}
    (tmp_path / INFO).write_text(json.dumps(WOODSCAPE_INFO | turned))
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes.classes == class_names[::-1] and scenes.colors == colors[::-1]
    (tmp_path / INFO).write_text(json.dumps(WOODSCAPE_INFO | {"class_indexes": [1] * 10}))
    refused(tmp_path, r"seg_annotation_info\.json: class_indexes must be", split="all")
    (tmp_path / INFO).unlink()
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes.classes == class_names and scenes.colors == []


def test_green_rows_are_a_part_of_the_height(tmp_path):
    write_woodscape(tmp_path, 1, size=(323, 428))  # 2 at each end, of 3 in a picture of 966
    scenes = open_scenes(tmp_path, "all", "labels")
    assert scenes[0].image.shape == (319, 428, 3)
    assert scenes[0].lens.image_size.tolist() == [[319, 428]]
    assert scenes.lens_alone(0).image_size.tolist() == [[960, 1280]]


@left_out_is_allowed
def test_the_split_of_heal_swin(tmp_path):
    stems = [f"{k:05d}_{VIEWS[k % 4]}" for k in range(8234)]
    parts = heal_swin(stems)
    order = np.random.RandomState(42).permutation(8234)
    assert len(parts["train"]) == 6588 and len(parts["val"]) == 1646
    assert parts["train"][:3] == [stems[k] for k in order[:3]]
    assert sorted(parts["train"] + parts["val"]) == stems
    write_woodscape(tmp_path, 10)
    parts = [open_scenes(tmp_path, part, "labels", splits="heal-swin") for part in SPLITS[:2]]
    assert [len(part) for part in parts] == [9, 1]
    missing(tmp_path, r"named splits: \['heal-swin'\]", splits="omnidet")
    # Lists as OmniDet's: a test set whose labels are withheld.
    (tmp_path / "lists").mkdir()
    (tmp_path / "lists" / "test.txt").write_text("08234_FV.png\n")
    said = r"1 picture for 'test' missing .*08234_FV"
    missing(tmp_path, said, split="test", splits=tmp_path / "lists")


def test_synwoodscape(tmp_path):
    write_synwoodscape(tmp_path)
    labels, distances = (open_scenes(tmp_path, "all", target) for target in ("labels", "distance"))
    assert len(labels.classes) == 25 and labels.classes[13] == "sky"
    assert (labels[0].target == labels_of(*rays_of(labels[0].lens, SIZE), 25)).all()
    scene = distances[1]
    theta, azimuth = rays_of(scene.lens, SIZE)
    sky, expected = azimuth < -2, distance_of(theta, azimuth + 0.3)
    assert (scene.target[sky] == 0).all() and sky.any()
    np.testing.assert_allclose(scene.target[~sky], expected[~sky], rtol=0, atol=1e-4)
    assert distances.unknown.tolist() == [-1, int(sky.sum()), -1, -1]
    # Calibrations may be the cameras' in place of the frames'.
    for file in sorted((tmp_path / "calibration/calibration").iterdir()):
        file.rename(file.with_name(f"{file.stem.split('_')[1]}.json"))
    assert str(open_scenes(tmp_path, "all", "distance")[1].lens) == str(scene.lens)


def test_what_woodscape_does_not_have(tmp_path):
    write_woodscape(tmp_path, 4)
    refused(tmp_path, "looks like WoodScape, which has labels but no", target="distance")
    (tmp_path / "calibration" / "calibration" / "00002_MVL.json").unlink()
    missing(tmp_path, r"no lens for .*00002_MVL\.png: add .*00002_MVL", split="all")


# -- KITTI-360 and Cityscapes -----------------------------------------------------------------


@left_out_is_allowed
def test_kitti360(tmp_path):
    write_kitti360(tmp_path)
    with pytest.warns(LeftOut, match="no distance for 6 of 18 pictures in .*: left out"):
        scenes = open_scenes(tmp_path, "all", "distance")
    assert len(scenes) == 12 and scenes.cameras == ["image_02", "image_03"]
    scene = scenes[0]
    assert isinstance(scene.lens, Mei) and (scene.target[::2] == 0).all()
    expected = distance_of(*rays_of(scene.lens, (140, 140)))
    np.testing.assert_allclose(scene.target[1::2], expected[1::2], rtol=0, atol=1 / 256)
    parts = [open_scenes(tmp_path, part, "distance") for part in SPLITS]
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
    ids = labels_of(*rays_of(scenes[0].lens, SIZE))
    # The id 6 is no class, 7 the first and 8 the second.
    assert (scenes[0].target == np.choose(ids, [IGNORE, 0, 1])).all()
    for split in ("val", "test"):  # the labels of "test" are withheld
        assert names(open_scenes(tmp_path, split, "labels")) == ["lindau_000000_000019_leftImg8bit"]
    refused(tmp_path, "looks like Cityscapes, which has labels but no", target="distance")
    (tmp_path / "two.txt").write_text("road\nother\n")
    refused(tmp_path, r"two\.txt must name 19 classes, but names 2", classes=tmp_path / "two.txt")


ENDINGS = "_gtFine_labelTrainIds _gtFine_color _gtFine_instanceIds _gtCoarse_labelIds _labelIds"


@pytest.mark.parametrize("ending", [*ENDINGS.split(), ""])
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


# -- COCO panoptic ----------------------------------------------------------------------------

PANOPTIC = "annotations/panoptic_train2017.json"


@pytest.fixture
def coco(tmp_path):
    write_coco(tmp_path)
    shutil.copy(WOODSCAPE, tmp_path / "lens.json")
    return tmp_path


def test_coco_panoptic(coco):
    scenes = open_scenes(coco, "train", "labels")
    assert scenes.classes == CLASSES["names"] and scenes.colors == CLASSES["colors"]
    expected = labels_of(*rays_of(scenes[0].lens, SIZE))
    expected[:, :9] = IGNORE
    assert (scenes[0].target == expected).all() and len(scenes) == 2
    assert names(open_scenes(coco, "test", "labels")) == names(scenes)  # those of val2017
    (coco / "map.json").write_text(json.dumps({"200": "thing", "1": "thing"}))
    mapped = open_scenes(coco, "train", "labels", label_map=coco / "map.json")
    assert mapped.classes == ["thing"]
    unlabelled = (expected == 1) | (expected == IGNORE)
    assert (mapped[0].target == np.where(unlabelled, IGNORE, 0)).all()
    for text, said in (("{}", "it lacks 'categories'"), ("[]", r"must be a JSON object, got \[")):
        (coco / PANOPTIC).write_text(text)
        refused(coco, rf"json is not in COCO's panoptic format: .*{said}")
    refused(coco, "looks like COCO panoptic, which has labels but no", target="distance")


GONE = object()


def edit(folder, place, value):
    """Changes the entry at a place in COCO's annotations, given as names and numbers."""
    file = folder / PANOPTIC
    content = entry = json.loads(file.read_text())
    *parents, name = (int(word) if word.isdigit() else word for word in place.split())
    for parent in parents:
        entry = entry[parent]
    if value is GONE:
        del entry[name]
    else:
        entry[name] = value
    file.write_text(json.dumps(content))


@left_out_is_allowed
@pytest.mark.parametrize(
    ("place", "file_name", "is_found"),
    [
        *(("a/b", name, True)
          for name in ("a/b/{}", "./a//b/{}", r"a\b\{}", "panoptic_train2017/a/b/{}")),
        ("b", "a/b/{}", True), (".", "a/b/{}", True), (".", "{}", True),
        *(("a/b", name, False) for name in ("b/{}", "{}", "a/c/{}")),
    ],
)  # fmt: skip
def test_folders_in_coco(coco, place, file_name, is_found):
    expected = open_scenes(coco, "train", "labels")[0].target
    for folder in ("train2017", "annotations/panoptic_train2017"):
        files = [file for file in (coco / folder).iterdir() if file.is_file()]
        (coco / folder / place).mkdir(exist_ok=True, parents=True)
        for file in files:
            file.rename(coco / folder / place / file.name)
    for k in range(2):
        edit(coco, f"annotations {k} file_name", file_name.format(f"{k:012d}.png"))
    if is_found:
        scenes = open_scenes(coco, "train", "labels")
        assert len(scenes) == 2 and (scenes[0].target == expected).all()
    else:
        missing(coco, r"none of 2 pictures in .* has labels")


SEGMENT = "annotations 0 segments_info 1"


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (f"{SEGMENT} category_id", 69, r"000\.png: the segment 300 has the category 69, but"),
        (f"{SEGMENT} category_id", "17", r"the category '17', but .* are \[1, 17, 200\]"),
        (f"{SEGMENT} category_id", None, "has the category None"),
        (f"{SEGMENT} category_id", [1], r"the segment 300 has the category \[1\], but the known"),
        (f"{SEGMENT} category_id", True, "has the category True, but the known"),
        (f"{SEGMENT} id", -300, "a whole number above 0, .*, got -300"),
        (f"{SEGMENT} id", 0, "above 0, which means no segment, got 0"),
        (f"{SEGMENT} id", 300.5, r"got 300\.5"),
        (f"{SEGMENT} id", "300", "got '300'"),
        (f"{SEGMENT} id", [300], r"a whole number above 0, .*, got \[300\]"),
        (f"{SEGMENT} id", 7, r"000\.png: two segments have the colour of the id 7"),
        (f"{SEGMENT} id", 7 + 2**24, "two segments have the colour"),
        (f"{SEGMENT} id", GONE, "a segment has no 'id'"),
        ("annotations 1 file_name", f"{0:012d}.png", "two annotations for .*000"),
        ("annotations 0 file_name", ["a"], r"'file_name' must be a text, got \['a'\]"),
        ("annotations 0 segments_info", GONE, "panoptic format: it lacks 'segments"),
        ("annotations 0 segments_info", None, "'segments_info' must be a list, got None"),
        ("annotations 0 segments_info", [3], "'segments_info' must list objects, got 3"),
        ("annotations", None, "format: 'annotations' must be a list, got None"),
        ("annotations", [7], "format: 'annotations' must list objects, got 7"),
        ("categories", None, "format: 'categories' must be a list, got None"),
        ("categories", {}, r"format: 'categories' must be a list, got \{\}"),
        ("categories", ["sky"], "format: 'categories' must list objects, got 'sky'"),
        ("categories 2 id", 1, r"train2017\.json defines the category 1 twice"),
        ("categories 0 id", [1], r"format: 'id' must be a whole number, got \[1\]"),
        ("categories 0 name", None, "format: 'name' must be a text, got None"),
        ("categories 0 name", GONE, "it lacks 'name' in {'"),
    ],
)
def test_wrong_annotations_of_coco_are_named(coco, place, value, message):
    edit(coco, place, value)
    refused(coco, rf"panoptic_train2017\.json.*{message}|{message}")


def colors_of(scenes):
    """The colours of the labels of the first scene, RGB."""
    return cv2.imread(str(scenes.target_file(0)), cv2.IMREAD_COLOR_RGB)


@pytest.mark.parametrize(
    ("id_", "color"),
    [
        (1, (1, 0, 0)), (2**24 - 1, (255, 255, 255)), (2**16, (0, 0, 1)),
        # Larger ids are written without their higher digits.
        (2**24 + 301, (45, 1, 0)), (2**31 + 5, (5, 0, 0)), (2**32 - 1, (255, 255, 255)),
        (2**63 + 256, (0, 1, 0)),
    ],
)  # fmt: skip
def test_ids_of_coco_segments(coco, id_, color):
    expected = open_scenes(coco, "train", "labels")[0].target
    edit(coco, f"{SEGMENT} id", id_)
    scenes = open_scenes(coco, "train", "labels")
    helpers.refused(r"000\.png holds the segment 300, but its annotation", scenes.__getitem__, 0)
    colors = colors_of(scenes)
    colors[(colors == (300 % 256, 1, 0)).all(-1)] = color
    write(scenes.target_file(0), colors[..., ::-1])
    assert (scenes[0].target == expected).all()


@pytest.mark.parametrize("id_", [2**24, 2**31])
def test_a_coco_segment_that_has_the_colour_of_no_segment(coco, id_):
    """It names no pixel, and black pixels might be its own."""
    black = {"id": id_, "category_id": 17}
    segments = json.loads((coco / PANOPTIC).read_text())["annotations"][0]["segments_info"]
    edit(coco, "annotations 0 segments_info", [*segments, black])
    scenes = open_scenes(coco, "train", "labels")
    helpers.refused(r"000\.png holds the segment 0, but its annotation lacks", lambda: scenes[0])
    colors = colors_of(scenes)
    colors[:, :9] = colors[:, 9:10]
    write(scenes.target_file(0), colors[..., ::-1])
    assert (scenes[0].target < 3).all()
    edit(coco, "annotations 0 segments_info", [black])
    scenes = open_scenes(coco, "train", "labels")
    helpers.refused(r"000\.png holds the segment \d+, but its annotation", lambda: scenes[0])


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


# -- ids in every reader ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "classes", "expected"),
    [
        ({"0": "b", "1": None, "2": "a"}, ["b", "a"], {0: 0, 1: IGNORE, 2: 1}),
        ({"0": 2, "1": None, "2": 0}, CLASSES["names"], {0: 2, 1: IGNORE, 2: 0}),
        ({"0": "x", "1": "x", "2": 255, "999": "x"}, ["x"], {0: 0, 1: 0, 2: IGNORE}),
    ],
)
def test_label_maps(tmp_path, content, classes, expected):
    file = write_plain(tmp_path, 1) / "map.json"
    before = open_scenes(tmp_path, "all", "labels")[0].target
    file.write_text(json.dumps(content))
    scenes = open_scenes(tmp_path, "all", "labels", label_map=file)
    assert scenes.classes == classes
    for id_, class_ in expected.items():
        assert (scenes[0].target[before == id_] == class_).all()


@pytest.mark.parametrize(
    ("write_tree", "mapped", "known", "unknown"),
    [
        (write_cityscapes, False, {0: IGNORE, 6: IGNORE, 7: 0, 33: 18}, [34, 100, 254]),
        (write_cityscapes, True, {0: IGNORE, 1: 0, 33: IGNORE}, [34, 254]),
        (write_woodscape, False, {0: 0, 9: 9}, [10, 254]),
        (write_woodscape, True, {0: IGNORE, 1: 0, 9: IGNORE}, [10, 254]),
        (write_synwoodscape, False, {0: 0, 24: 24}, [25, 254]),
        (write_synwoodscape, True, {0: IGNORE, 1: 0, 24: IGNORE}, [25, 254]),
        (write_plain, False, {0: 0, 2: 2}, [3, 254]),
        (write_plain, True, {1: 0}, [0, 2, 254]),
    ],
)
def test_ids_that_no_table_knows_are_named(tmp_path, write_tree, mapped, known, unknown):
    """Ids that the authors defined are known, with a class or without."""
    (tmp_path / "map.json").write_text('{"1": "thing"}')
    options = dict(lens=WOODSCAPE) if write_tree is write_cityscapes else {}
    options |= dict(label_map=tmp_path / "map.json") if mapped else {}
    scenes = open_scenes(write_tree(tmp_path / "tree"), "train", "labels", **options)
    file = scenes.target_file(0)
    for id_, class_ in (known | {IGNORE: IGNORE}).items():
        write(file, np.full(SIZE, id_, np.uint8))
        assert (scenes[0].target == class_).all(), id_
    labels = np.full(SIZE, next(iter(known)), np.uint8)
    for id_ in unknown:
        labels[60, 80] = id_
        write(file, labels)
        helpers.refused(rf"{file} holds the ids \[{id_}\], but", lambda: scenes[0])


def test_wrong_label_maps_are_named(tmp_path):
    file = write_plain(tmp_path, 1) / "map.json"
    (tmp_path / "mine.txt").write_text("sky\nsea\n")
    mine = dict(classes=tmp_path / "mine.txt")
    for content, message, options in (
        ([0], r"map\.json must be a JSON object that maps ids to classes", {}),
        ({"x": 0}, "got the id 'x'", {}),
        ({"0": 3}, "maps the id 0 to 3, but the classes are .*sky", {}),
        ({"0": "sky", "1": 1}, r"maps the id 1 to 1, but the classes are \['sky'\]", {}),
        ({"0": True}, "maps the id 0 to True", {}),
        ({"0": "sky", "00": "sea"}, "maps the id 0 twice", {}),
        ({"0": "sky", "1": "land"}, "maps the id 1 to 'land', but the classes are", mine),
    ):
        file.write_text(json.dumps(content))
        refused(tmp_path, message, split="all", label_map=file, **options)


# -- the plain form ---------------------------------------------------------------------------


def test_plain_folders_of_splits(tmp_path):
    write_plain(tmp_path, 2, split="test")
    missing(tmp_path, r"there are \['test'\] pictures, but none for")
    write_plain(tmp_path, 10, split="train")
    parts = [names(open_scenes(tmp_path, part, "labels")) for part in SPLITS]
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
    refused(tmp_path, "'all' needs a folder without splits", split="all")
    refused(tmp_path, r"lists splits, but .* has a folder for each", splits="x")
    write_plain(tmp_path, 1)
    refused(tmp_path, "has both")


def test_hold_out_of_one_folder(tmp_path):
    write_plain(tmp_path, 20)
    parts = [names(open_scenes(tmp_path, part, "labels")) for part in SPLITS]
    assert [len(part) for part in parts] == [16, 2, 2]
    assert sorted(chain(*parts)) == names(open_scenes(tmp_path, "all", "labels"))
    missing(tmp_path, "`holdout` 0 of 20 pictures leaves none", split="test", holdout=0)


@left_out_is_allowed
def test_lists_of_plain_scenes(tmp_path):
    file = write_plain(tmp_path, 6, name="a/{:02d}".format) / "splits.json"
    file.write_text(json.dumps({"train": ["a/00", "a/01.png", "a/02"], "val": ["a/03"]}))
    with pytest.warns(LeftOut, match=r"lists 2 pictures for no split, \['a/04', 'a/05'\]"):
        assert names(open_scenes(tmp_path, "train", "labels", splits=file)) == ["00", "01", "02"]
    for lists, message, error in (
        ({"train": ["a/00"], "val": ["a/00"]}, "a/00 for 'train' and for 'val'", ValueError),
        ({"train": [3]}, "must list names for 'train', got 3", ValueError),
        ({"train": []}, "lists no pictures for 'train'", FileNotFoundError),
        ({"train": ["a/77"]}, "1 picture for 'train' missing in .*a/77", FileNotFoundError),
    ):
        file.write_text(json.dumps(lists))
        refused(tmp_path, message, splits=file, error=error)


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
    scenes = open_scenes(tmp_path, "all", "labels", lens='{"model": "Equidistant", "fov": 2.0}')
    assert scenes.cameras == ["of the lens"] and scenes[0].lens.theta_max.item() == 1
    own.write_text("{")
    refused(tmp_path, r"003\.json: it is not JSON", split="all")
    tangential = dict(radial=[0.01], tangential=[0.02, 0.01], theta_max=0.8)
    own.write_text(json.dumps(dict(model="BrownConrady", focal=60) | tangential))
    refused(tmp_path, r"003\.json: cameras of several lens models", split="all")


@pytest.mark.parametrize("name", ["lens.yaml", "lens.YML", "lens.xml", "lens.txt", "lens.json"])
def test_a_calibration_beside_the_pictures(tmp_path, name):
    lens = load(WOODSCAPE.parent / "opencv_fisheye.yaml").resized(SIZE)
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
    assert "no picture for 1 file of labels" in text
    assert "pictures that darswin does not read, 1 .gif" in text
    (tmp_path / "distance" / "001.npy").write_bytes(b"")
    refused(tmp_path, r"001\.npy and .*001\.png have the same stem", split="all", target="distance")


def test_what_is_no_data_set(tmp_path):
    missing(tmp_path, r"no scenes in .*: darswin looks for images/STEM")
    missing(tmp_path / "x", "no folder")
    for wrong in (dict(split="x"), dict(target="x"), dict(channels=2), dict(holdout=0.5)):
        refused(tmp_path, f"{next(iter(wrong))}`? must be", **wrong)
    write_plain(tmp_path, 1, own_lenses=True)
    refused(tmp_path, "`camera` a needs a calibration: give `lens` too", split="all", camera="a")
