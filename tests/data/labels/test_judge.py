"""Files of labels as a whole: what is in another unit, order or form is named, and nothing else."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import refused

from darswin.data.labels import read_coco, read_yolo
from darswin.data.labels.judge import CORNERS, MIDDLE, SIDES, check_form

PART = "within the first pixel, so they look like shares"
LOW = np.array([[120, 75], [140, 90], [160, 105]])
INSIDE = [[100, 60, 50, 40], [1, 2, 30, 20], [200, 100, 20, 20]]


def boxes(rows, area=0):
    return [{"bbox": list(map(float, row)), "area": area} for row in rows]


def outline(*numbers):
    return {"bbox": [100, 60, 50, 40], "segmentation": [list(numbers)]}


COCO = {
    "shares": (boxes([[0.25, 0.3, 0.2, 0.25], [0.6, 0.1, 0.1, 0.2]]), PART),
    "outlines as shares": ([outline(0.1, 0.2, 0.4, 0.2, 0.4, 0.5)], f"outlines lie all {PART}"),
    "keypoints as shares": ([{"bbox": [9, 9, 50, 40], "keypoints": [0.2, 0.3, 2]}], PART),
    "corners": (boxes(np.hstack((LOW, 2 * LOW))), f"look like {CORNERS}"),
    "corners by their areas": (boxes([[20, 20, 60, 70]], 2000), f"look like {CORNERS}"),
    "panoptic": ([{"segments_info": []}], "is COCO's panoptic file"),
    "nothing": ([], None), "inside": (boxes(INSIDE), None), 
    "a pixel": (boxes([[0, 0, 1, 1]]), None),
    "tiny": (boxes([[0.2, 0.3, 0.4, 0.4], [90.2, 60.5, 0.5, 0.5]]), None),
    "all of the picture": (boxes([[0, 0, 320, 240]], 320 * 240), None),
    "beyond the picture": (boxes([[300, 10, 40, 20], [-9, 10, 40, 20], [40, 230, 40, 20]]), None),
    "only beyond": (boxes([[300, 10, 40, 20], [290, 10, 50, 20], [280, 9, 60, 20]]), None),
}  # fmt: skip
TRIANGLES = ["0 .1 .1 .5 .1 .5 .9", "0 .2 .1 .5 .1 .5 .9", "0 0 0 1 0 0 1", "0 .5 .5 .2 .2 .9 1"]
TRACK = "line 1 must be a class below 1 and 4 numbers .*, without a score or a track"
POINT = ["0 .5 .5 .2 .2 .4 .5 2"]
YOLO = {
    "per cent": (["0 50 50 20 20"], {}, r"a\.txt, line 1 has numbers that look like per cent or p"),
    "an outline in per cent": (["0 40 40 60 40 60 60 40 60"], {}, "look like per cent or pixels"),
    "pixels": (["0 132 24 10 12", "0 1 1 1 1", "0 40 40 60 60 50 20"], {}, "like pixels, as 2 of"),
    "corners": ([f"0 .{x} .{x} .9{x}1 .9" for x in (1, 2, 3)], {}, f"look like {CORNERS}"),
    "tracks": (["0 .5 .5 .2 .2 .91 7", "0 .1 .1 .1 .1 .9 8"], {}, TRACK),
    "tracks and scores": (["0 .5 .5 .2 .2 7 .91"], {}, TRACK),
    "the same track": ([f"0 .5 .5 .2 .{k} .9 1" for k in (1, 2, 3)], {}, TRACK),
    "tracks of corners": (["0 .1 .1 .5 .1 .5 .9 .1 .9 .8 2"], {}, TRACK),
    "keypoints without kpt_shape": ([f"{POINT[0]} .6 .7 1"], {}, TRACK),
    "a score": (["0 .5 .5 .2 .2 .9"], {}, TRACK),
    "fewer keypoints": (POINT, {"kpt_shape": [2, 3]}, "4 numbers of a box, or 6 of keypoints"),
    "more keypoints": (POINT * 2, {"kpt_shape": [1, 2]}, "4 numbers of a box, or 2 of keypoints"),
    "keypoints of another form": (POINT, {"kpt_shape": [1, 4]}, "kpt_shape is a count, and 2 or 3"),
    "keypoints": (POINT, {"kpt_shape": [1, 3]}, None), "triangles": (TRIANGLES, {}, None),
    "small and large": (["0 .001 .001 .001 .001", "0 .5 .5 1 1"], {}, None),
    "frames": (["0 0 0 1 0 1 1 0 1"] * 3, {}, None), "nothing": ([], {}, None),
}  # fmt: skip


def picture(file):
    file.parent.mkdir()
    cv2.imwrite(str(file), np.zeros((240, 320, 3), np.uint8))


def check(said, read, *arguments):
    if said is None:
        read(*arguments).labels(0)
    else:
        refused(said, lambda: read(*arguments).labels(0))


@pytest.mark.parametrize("name", COCO)
def test_a_file_of_coco(tmp_path, name):
    annotations, said = COCO[name]
    picture(tmp_path / "images" / "a.png")
    own = [{"id": k, "image_id": 1, "category_id": 1} | a for k, a in enumerate(annotations)]
    images = [{"id": 1, "file_name": "a.png", "width": 320, "height": 240}]
    content = {"images": images, "annotations": own, "categories": [{"id": 1, "name": "cone"}]}
    (tmp_path / "a.json").write_text(json.dumps(content))
    check(said, read_coco, tmp_path / "a.json")


@pytest.mark.parametrize("name", YOLO)
def test_texts_of_yolo(tmp_path, name):
    lines, content, said = YOLO[name]
    picture(tmp_path / "images" / "a.png")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text("\n".join(lines))
    (tmp_path / "data.yaml").write_text(json.dumps({"names": ["cone"]} | content))
    check(said, read_yolo, tmp_path)


@pytest.mark.parametrize("form", [SIDES, MIDDLE])
def test_the_form_of_many_boxes(form):
    rng = np.random.default_rng(0)
    middle, half = rng.uniform(0, 1, (2, 300, 2)) * [[[1]], [[0.3]]]
    low, high = (middle - half).clip(0, 1), (middle + half).clip(0, 1)
    written = {
        CORNERS: (low, high),
        SIDES: (low, high - low),
        MIDDLE: (low / 2 + high / 2, high - low),
    }
    check_form(Path("a"), MIDDLE, np.hstack((middle, 2 * half)))  # some reach beyond the picture
    for other, boxes in written.items():
        if other == form:
            check_form(Path("a"), form, np.hstack(boxes))
        else:
            said = f"boxes cannot be .* look like {other}"
            refused(said, check_form, Path("a"), form, np.hstack(boxes))
