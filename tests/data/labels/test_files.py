"""COCO, YOLO and WoodScape: files read, written and read again, and wrong files."""

import json
import math
import re

import cv2
import numpy as np
import pytest
import yaml
from helpers import exif_of, refused, save_picture
from PIL import Image
from scenes import write_woodscape

from darswin.boxes import Instances, encode_rle
from darswin.data.labels import (
    Labels,
    moved,
    open_labels,
    read_coco,
    read_woodscape_boxes,
    read_yolo,
    write_coco,
    write_yolo,
)
from darswin.lens import Equidistant
from darswin.views import CropView

SIZE = (60, 80)
MASK = np.zeros(SIZE, np.uint8)
MASK[10:20, 30:50] = 1
PERSON = {
    "id": 1, "name": "person", "supercategory": "animal",
    "keypoints": ["nose", "left_eye", "right_eye"], "skeleton": [[1, 2]],
}  # fmt: skip
CATEGORIES = [PERSON, {"id": 18, "name": "dog"}]
ANNOTATIONS = [
    {"id": 5, "image_id": 9, "category_id": 18, "bbox": [10, 20, 30, 15], "area": 450,
     "iscrowd": 0, "attributes": {"tame": True}},
    {"id": 6, "image_id": 9, "category_id": 1, "bbox": [1, 2, 20, 10], "area": 100, "iscrowd": 0,
     "segmentation": [[1, 2, 21, 2, 21, 12], [1, 5.5, 3, 5.5, 3, 8, 1, 8]],
     "keypoints": [5, 5, 2, 6, 4, 1, 0, 0, 0], "num_keypoints": 2},
    {"id": 7, "image_id": 9, "category_id": 1, "bbox": [30, 10, 20, 10], "area": 200, "iscrowd": 1,
     "segmentation": encode_rle(MASK, compressed=False)},
    {"id": 8, "image_id": 4, "category_id": 1, "bbox": [30, 10, 20, 10], "area": 200, "iscrowd": 0,
     "segmentation": encode_rle(MASK)},
]  # fmt: skip
IMAGES = [
    {"id": 9, "file_name": "a.png", "height": 60, "width": 80, "license": 3},
    {"id": 4, "file_name": "sub/b.png", "height": 60, "width": 80},
    {"id": 2, "file_name": "c.png", "height": 60, "width": 80},
]


def write_pictures(folder, *names):
    for name in names:
        save_picture(folder / name, np.zeros((*SIZE, 3), np.uint8))


def write(folder, place="images", path="instances.json", **changes):
    write_pictures(folder / place, *(entry["file_name"] for entry in IMAGES))
    content = {"images": IMAGES, "annotations": ANNOTATIONS, "categories": CATEGORIES} | changes
    (folder / path).parent.mkdir(parents=True, exist_ok=True)
    (folder / path).write_text(json.dumps(content))
    return folder / path


def changed(number, **changes):
    annotations = [dict(annotation) for annotation in ANNOTATIONS]
    annotations[number] |= changes
    return {"annotations": annotations}


# -- COCO -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("place", "path"),
    [
        ("images", "instances.json"),
        (".", "labels.json"),
        ("val2017", "annotations/instances_val2017.json"),
        ("images/val2017", "annotations/person_keypoints_val2017.json"),
        ("images", "annotations/any.json"),
    ],
)
def test_coco_is_read(tmp_path, place, path):
    data = read_coco(write(tmp_path, place, path))
    assert data.folder.samefile(tmp_path / place) and data.lenses is None and len(data) == 3
    assert list(data.files) == ["a.png", "sub/b.png", "c.png"]
    instances, size, _ = data.labels(0)
    assert size == SIZE and not len(data.labels(2).instances)
    np.testing.assert_array_equal(instances.boxes[0], [10, 20, 40, 35])
    assert instances.labels.tolist() == [18, 1, 1]
    entry = {"id": 5, "image_id": 9, "attributes": {"tame": True}}
    assert instances.more["entry"][0] == entry
    shapes = [[polygon.shape for polygon in outline] for outline in instances.outlines]
    assert shapes == [[], [(3, 2), (4, 2)], []]
    assert instances.areas == pytest.approx([450, 100 + 5, 200])
    person, nothing = [[5, 5, 2], [6, 4, 1], [np.nan, np.nan, 0]], np.full((3, 3), np.nan)
    np.testing.assert_array_equal(instances.keypoints, [nothing, person, nothing])
    assert instances.more["mirror"][1] == [0, 2, 1]
    assert instances.more["crowd"].tolist() == [False, False, True]
    assert data.labels(1).instances.areas == [200]


def test_coco_is_written_and_read_again(tmp_path):
    data = read_coco(write(tmp_path))
    pictures = [(entry, data.labels(k)) for k, entry in enumerate(data.entries)]
    write_coco(tmp_path / "again.json", pictures, data.categories)
    again = json.loads((tmp_path / "again.json").read_text())
    assert again["images"] == IMAGES and again["categories"] == CATEGORIES
    for annotation, expected in zip(again["annotations"], ANNOTATIONS, strict=True):
        area = pytest.approx(expected["area"], abs=5)  # 105, which COCO rounds
        assert annotation == expected | {"area": area, "visible": 1.0}
    read_coco(tmp_path / "again.json").labels(0)


def test_ids_are_numbered_where_they_are_missing(tmp_path):
    boxes = np.array([[1.0, 2, 3, 4], [1, 2, 3, 5]])
    labels = Labels(Instances(boxes, labels=np.array([1, 1])), SIZE)
    file = write(tmp_path)
    write_coco(file, [({"file_name": name}, labels) for name in ("a.png", "c.png")], CATEGORIES)
    content = json.loads(file.read_text())
    assert [image["id"] for image in content["images"]] == [1, 2]
    ids = [(annotation["id"], annotation["image_id"]) for annotation in content["annotations"]]
    assert ids == [(1, 1), (2, 1), (3, 2), (4, 2)]
    assert len(read_coco(file).labels(1).instances) == 2


@pytest.mark.parametrize("write_labels", [write_coco, write_yolo])
def test_what_files_cannot_hold_is_refused(tmp_path, write_labels):
    box = np.array([[1.0, 2, 3, 4]])
    for said, columns in (
        ("the label 7 is that of no category", dict(labels=np.array([7]))),
        ("a box is NaN", dict(boxes=box * np.nan, labels=np.array([1]))),
        ("instances need labels", dict()),
    ):
        labels = Labels(Instances(**{"boxes": box} | columns), SIZE)
        pictures = [({"file_name": "a.png"}, labels)]
        refused(said, write_labels, tmp_path / "new", pictures, CATEGORIES)


def test_a_lens_beside_the_labels_is_that_of_the_pictures(tmp_path):
    file = write(tmp_path, "train", "annotations/instances_train.json")
    (tmp_path / "lens.json").write_text('{"model": "Equidistant", "focal": 20, "theta_max": 1}')
    lenses = read_coco(file).lenses
    assert lenses is not None and lenses.lens_of("a.png", SIZE).focal == 20
    # One above the folder with the labels and the pictures is no part of the data set.
    assert read_coco(write(tmp_path / "set")).lenses is None


UNREADABLE = "has a mask that cannot be read"
OUTSIDE = "must lie in its picture, with numbers that are pixels"


@pytest.mark.parametrize(
    ("number", "changes", "said"),
    [
        (0, dict(segmentation={"size": [60, 80]}), f"{UNREADABLE}: a run"),
        (0, dict(segmentation={"size": None, "counts": [1]}), UNREADABLE),
        (0, dict(segmentation={"size": [60, 80], "counts": "zzz"}), UNREADABLE),
        (0, dict(segmentation=5), "has the polygon 5, which must be finite"),
        (0, dict(visible=None), "has visible None, which must be a share from 0 to 1"),
        (0, dict(visible="yes"), "has visible 'yes'"),
        (0, dict(visible=55), "has visible 55"),
        (0, dict(bbox=[1, 2, float("nan"), 3]), "has the box .*finite numbers"),
        (0, dict(bbox=[1, 2, 3]), "has the box"),
        (0, dict(bbox=None), "has the box"),
        (0, dict(bbox=[10, 20, 0, 15]), r"has \[10, 20, 0, 15\], and neither"),
        (0, dict(bbox=[10, 20, 1e9, 15]), OUTSIDE),
        (0, dict(bbox=[100, 20, 5, 5]), OUTSIDE),
        (0, dict(bbox_mode=0), "has bbox_mode 0, but COCO's boxes are x, y, width, height"),
        (0, dict(iscrowd="yes"), "has iscrowd 'yes', which must be 0 or 1"),
        (0, dict(attributes={"rotation": "a"}), "has the rotation 'a'"),
        (1, dict(segmentation=[[1, 2, 3]]), "has the polygon"),
        (1, dict(segmentation=[["a", "b"]]), "has the polygon"),
        (1, dict(segmentation=[[0, 0, 1e9, 0, 1e9, 1e9]]), OUTSIDE),
        (1, dict(keypoints=[9e9, 5, 2] * 3), OUTSIDE),
        (1, dict(keypoints=[5, 5, 130] * 3), "has keypoints whose third number, v, is not 0, 1 or"),
        (1, dict(keypoints=[5, 5, 6, 4, 1, 7]), "has 2 keypoints x, y, v, but its category 3"),
        (1, dict(keypoints=[1, 2]), "has the keypoints"),
        (2, dict(segmentation={"size": [3, 4], "counts": [12]}), r".*a mask of \[3, 4\] px"),
    ],
)
def test_wrong_annotations_are_named(tmp_path, number, changes, said):
    data = read_coco(write(tmp_path, **changed(number, **changes)))
    refused(f"instances.json: the annotation {5 + number} {said}", data.labels, 0)


def pictures_with(**changes):
    return {"images": [IMAGES[0] | changes, *IMAGES[1:]]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"annotations": [{"id": 1, "image_id": 9, "category_id": 1}]}, "1 has no bbox"),
        ({"annotations": {}}, 'must have the lists "images"'),
        ({"categories": [{"name": "dog"}]}, "lacks 'id'"),
        ({"images": [*IMAGES, IMAGES[0]]}, "lists a picture twice"),
        (pictures_with(width=81), "60 × 81, but it has 60 × 80 px"),
        (pictures_with(width=60, height=80), "80 × 60, .* 60 × 80 px .* are swapped"),
        ({"images": [{"file_name": "d.png", "id": 9}]}, r"1 of 1 picture .*d\.png"),
    ],
)
def test_wrong_coco_files(tmp_path, changes, said):
    with pytest.raises((ValueError, FileNotFoundError), match=said):
        read_coco(write(tmp_path, **changes)).labels(0)


def test_sides_before_exif_turns_a_picture_are_told(tmp_path):
    file = write(tmp_path)
    Image.new("L", (80, 60)).save(tmp_path / "images" / "a.png", exif=exif_of(6))
    refused("80 × 60 px .* when its EXIF orientation turns it", read_coco(file).labels, 0)


def test_annotations_and_pictures_that_cannot_be_used_are_named(tmp_path):
    """The others are read."""
    wrong = [
        (ANNOTATIONS[0] | {"category_id": 3}, "5 has the category 3, but the categories are"),
        (ANNOTATIONS[0] | {"image_id": 77}, "5 is of the picture 77, which the file does not list"),
        ({"id": 8}, "8 lacks 'category_id'"),
        ([1], r"an annotation must be a JSON object with ids, got \[1\]"),
        (ANNOTATIONS[0] | {"image_id": {}}, "must be a JSON object"),
    ]
    images = [*IMAGES, {"id": 5, "file_name": "d.png"}]
    annotations = [*ANNOTATIONS, *(annotation for annotation, _ in wrong)]
    file = write(tmp_path, images=images, annotations=annotations)
    (tmp_path / "images" / "a.png").unlink()
    data = read_coco(file)
    assert list(data.files) == ["sub/b.png", "c.png"] and len(data.labels(0).instances) == 1
    said = [*(text for _, text in wrong), "no picture a.png in", "no picture d.png in"]
    for text, words in zip(data.wrong, said, strict=True):
        assert str(file) in text and re.search(words, text)


@pytest.mark.parametrize(
    "changes",
    [
        dict(segmentation=[[]]), dict(segmentation=[[10, 20, 30, 15]]),
        dict(segmentation=[[10, 20, 40, 35]]), dict(segmentation=[[10, 20, 20, 20, 40, 20]]),
        dict(segmentation=encode_rle(0 * MASK)), dict(bbox=["10", "20", "30", "15"]),
        dict(iscrowd="0"), dict(iscrowd=None), dict(attributes={"rotation": 0.0}),
        dict(attributes=["rotation"]), dict(attributes={"rotation": None}),
    ],
)  # fmt: skip
def test_what_is_no_outline_is_the_box(tmp_path, changes):
    sides = pictures_with(width="80", height="60.0")
    found = read_coco(write(tmp_path, **sides, **changed(0, **changes))).labels(0).instances[0]
    np.testing.assert_array_equal(found.boxes, [[10, 20, 40, 35]])
    assert not len(found.outlines[0]) and found.masks == [None] and not found.more["crowd"]


def test_a_turned_box_of_cvat_stays_a_turned_one(tmp_path):
    """As files have it: the outline, the box around it, and the rotation in degrees."""
    turned = changed(0, attributes={"rotation": 30.0, "occluded": True}, visible=0.625)
    data = read_coco(write(tmp_path, **turned))
    lens = Equidistant(20.0, 1.6, image_size=SIZE)
    remap = CropView((5, 10, *SIZE), SIZE).at(lens, SIZE)
    write_coco(tmp_path / "again.json", [(IMAGES[0], data.labels(0))], CATEGORIES)
    for labels, corner in ((data.labels(0), 0), (read_coco(tmp_path / "again.json").labels(0), 0),
                           (moved(data.labels(0), remap), 5)):  # fmt: skip
        box, *_ = labels.instances.boxes
        expected = [25 - 2 * corner, 27.5 - corner, 30, 15, math.radians(30)]
        np.testing.assert_allclose(box, expected, atol=0.01)
        write_coco(tmp_path / "again.json", [(IMAGES[0], labels)], CATEGORIES)
        again = json.loads((tmp_path / "again.json").read_text())["annotations"][0]
        assert again["attributes"] == {"rotation": pytest.approx(30, abs=0.1), "occluded": True}
        assert again["visible"] == 0.625 and again["area"] == pytest.approx(450, abs=0.5)
        middle, sin, cos = box[:2], math.sin(math.radians(30)), math.cos(math.radians(30))
        half = np.array([15 * cos + 7.5 * sin, 15 * sin + 7.5 * cos])
        np.testing.assert_allclose(again["bbox"], [*(middle - half), *(2 * half)], atol=0.02)
        (points,) = again["segmentation"]
        first = middle - np.array([15 * cos - 7.5 * sin, 15 * sin + 7.5 * cos])
        np.testing.assert_allclose(points[:2], first, atol=0.02)
        assert len(points) == 8
    write_yolo(tmp_path, [({"file_name": "a.png"}, labels)], CATEGORIES)
    numbers = [*map(float, (tmp_path / "a.txt").read_text().splitlines()[0].split())]
    np.testing.assert_allclose(np.reshape(numbers[1:], (4, 2))[0] * SIZE[::-1], first, atol=0.02)


def test_boxes_that_are_missing_are_those_of_polygons_and_masks(tmp_path):
    _, *others = ANNOTATIONS
    annotations = [{k: v for k, v in a.items() if k not in ("bbox", "id")} for a in others]
    polygon, crowd = read_coco(write(tmp_path, annotations=annotations)).labels(0).instances.boxes
    np.testing.assert_array_equal(polygon, [1, 2, 21, 12])
    np.testing.assert_array_equal(crowd, [30, 10, 50, 20])


def test_empty_coco_files(tmp_path):
    assert not len(read_coco(write(tmp_path, annotations=[])).labels(0).instances)
    assert len(read_coco(write(tmp_path, images=[], annotations=[], categories=[]))) == 0


# -- YOLO -----------------------------------------------------------------------------------------


def yolo(folder, text, **more):
    write_pictures(folder, "images/train/a.png", "images/val/b.png")
    (folder / "labels" / "train").mkdir(parents=True, exist_ok=True)
    (folder / "labels" / "train" / "a.txt").write_text(text)
    (folder / "data.yaml").write_text(yaml.safe_dump({"names": ["person", "dog"]} | more))
    return read_yolo(folder)


def test_yolo_is_read(tmp_path):
    data = yolo(tmp_path, "1 0.5 0.5 0.25 0.5\n\n0 0.1 0.1 0.5 0.1 0.5 0.9\n")
    assert list(data.files) == ["images/train/a.png", "images/val/b.png"]
    assert data.categories == [{"id": 0, "name": "person"}, {"id": 1, "name": "dog"}]
    instances = data.labels(0).instances
    np.testing.assert_allclose(instances.boxes[0], [30, 15, 50, 45])
    np.testing.assert_allclose(instances.outlines[1], [[[8, 6], [40, 6], [40, 54]]])
    assert instances.labels.tolist() == [1, 0] and not len(data.labels(1).instances)


@pytest.mark.parametrize(
    ("picture", "text", "classes"),
    [
        ("images/a.png", "labels/a.txt", "data.yaml"),
        ("train/images/a.png", "train/labels/a.txt", "data.yaml"),
        ("a.png", "a.txt", "classes.txt"),
        ("images/images/a.png", "images/labels/a.txt", "data.yaml"),
    ],
)
def test_where_yolo_has_its_labels(tmp_path, picture, text, classes):
    write_pictures(tmp_path, picture)
    (tmp_path / text).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / text).write_text("0 0.5 0.5 1 1\n")
    (tmp_path / classes).write_text("names: {0: dog}" if classes == "data.yaml" else "dog\n")
    data = open_labels(tmp_path)
    np.testing.assert_allclose(data.labels(0).instances.boxes, [[0, 0, 80, 60]])
    write_yolo(tmp_path / "new", [({"file_name": picture}, data.labels(0))], data.categories)
    assert (tmp_path / "new" / text).read_text() == "0 0.500000 0.500000 1.000000 1.000000\n"


def test_yolo_keypoints(tmp_path):
    data = yolo(tmp_path, "0 .5 .5 .2 .2 .4 .5 2 0 0 0\n", kpt_shape=[2, 3])
    write_yolo(tmp_path / "new", [({"file_name": data.files[0]}, data.labels(0))], data.categories)
    write_pictures(tmp_path / "new", data.files[0])
    flat = yolo(tmp_path / "flat", "0 .5 .5 .2 .2 .4 .5 0 0\n", kpt_shape=[2, 2])
    for labels in (data, read_yolo(tmp_path / "new"), flat):
        (points,) = labels.labels(0).instances.keypoints
        np.testing.assert_allclose(points, [[32, 30, 2], [np.nan, np.nan, 0]])


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_parts_of_an_outline_are_joined_for_yolo(tmp_path, parts):
    """What OpenCV fills is the same."""
    corners = np.array([[4.0, 4], [14, 4], [9, 14]])
    polygons = [corners + np.array([20, 10]) * k for k in range(parts)]
    columns = dict(boxes=np.array([[4.0, 4, 60, 50]] * 2), labels=np.array([0, 0]))
    both = Instances(**columns, outlines=[polygons, []], more={"crowd": np.array([False, True])})
    labels = Labels(both, SIZE)
    write_yolo(tmp_path, [({"file_name": "images/a.png"}, labels)], [{"id": 0, "name": "dog"}])
    write_pictures(tmp_path, "images/a.png")
    (joined,) = read_yolo(tmp_path).labels(0).instances.outlines  # without the crowd
    pictures = [np.zeros(SIZE, np.uint8) for _ in range(2)]
    for picture, shapes in zip(pictures, (polygons, joined), strict=True):
        cv2.fillPoly(picture, [np.round(16 * p).astype(int) for p in shapes], 1, shift=4)
    bridges = 2 * np.hypot(20, 10) * (parts - 1)
    assert np.abs(pictures[0].astype(int) - pictures[1]).sum() <= bridges
    area = cv2.contourArea(joined[0].astype(np.float32))
    assert area == pytest.approx(50 * parts, abs=0.01)


NUMBERS, AREA = "be a class below 2 and 4 numbers", "have an area"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        *((line, NUMBERS) for line in ("2 0.5 0.5 1 1", "-1 0.5 0.5 1 1", "0.5 .5 .5 1 1", "0",
          "0 0.5 0.5 1", "0 0.1 0.1 0.5 0.1 0.5", "0 nan 0.5 1 1", "0 a b c d")),
        ("0 .5 .5 0 .1", AREA), ("0 .1 .1 .1 .1 .1 .1", AREA), 
        *((line, "lie in its picture, with numbers that are shares of the sides")
          for line in ("0 9e9 0 1 1", "0 1.5 .5 .2 .2", "0 .1 .1 .5 .1 4.5 .9")),
    ],
)  # fmt: skip
def test_wrong_lines_of_yolo(tmp_path, line, said):
    """They are named, and the others are read."""
    data = yolo(tmp_path, f"0 0.5 0.5 1 1\n{line}\n")
    refused(rf"a\.txt, line 2 must {said}", data.labels, 0)
    labels, wrong = data.read(data.raw[0], SIZE)
    assert len(labels.instances) == len(wrong) == 1


def test_folders_that_are_not_yolo(tmp_path):
    said = r"no labels in .*: give a COCO file"
    refused(said, open_labels, tmp_path, error=FileNotFoundError)
    write_pictures(tmp_path, "images/a.png")
    (tmp_path / "data.yaml").write_text("names: [dog]")
    said = r"the first would be .*labels/a\.txt"
    refused(said, read_yolo, tmp_path, error=FileNotFoundError)
    (tmp_path / "data.yaml").write_text("names: {1: dog}")
    refused("must name the classes 0, 1", read_yolo, tmp_path)


# -- WoodScape ------------------------------------------------------------------------------------


def test_the_boxes_of_woodscape(tmp_path):
    data = read_woodscape_boxes(write_woodscape(tmp_path, 4))
    assert data.files[0] == "00000_FV.png" and data.categories == [{"id": 0, "name": "vehicles"}]
    np.testing.assert_array_equal(data.labels(0).instances.boxes, [[10, 10, 41, 41]])
    assert data.lenses is not None and len(open_labels(tmp_path)) == 4
    camera = data.lenses.camera_of(data.folder / data.files[1])
    assert camera.calibration.endswith("00001_RV.json")
    file = tmp_path / "box_2d_annotations" / "box_2d_annotations" / "00001_RV.txt"
    for text, said in (
        ("car,0,1,2,3\n", "line 1: must be name,index,left,top,right,bottom"),
        ("vehicles,0,1,2,nan,4\n", "line 1: must be"),
        ("person,0,1,2,3,4\n", "names the class 0 person, not vehicles"),
    ):
        file.write_text(text)
        refused(said, lambda: read_woodscape_boxes(tmp_path).labels(1))
    file.write_text("")
    assert not len(read_woodscape_boxes(tmp_path).labels(1).instances)
