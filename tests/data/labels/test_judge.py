"""Files of labels as a whole: what is in another unit, order or form is named, and nothing else."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import refused

from darswin.data.labels import open_labels
from darswin.data.labels.judge import CORNERS, MIDDLE, SIDES, check_form


def boxes(*rows, area=0):
    return [{"bbox": list(map(float, row)), "area": area} for row in rows]


PART = "within the first pixel, so they look like shares"
UNIT = "line 1 has numbers that look like per cent or pixels"
TRACK = "line 1 must be a class below 1 and 4 numbers .*, without a score or a track"
LIKE = f"look like {CORNERS}"
POINT, ALL = "0 .5 .5 .2 .2 .4 .5 2", "0 0 0 1 0 1 1 0 1"
TRIANGLES = ["0 .1 .1 .5 .1 .5 .9", "0 0 0 1 0 0 1", "0 .5 .5 .2 .2 .9 1"]
OUTLINE = {"bbox": [100, 60, 50, 40], "segmentation": [[0.1, 0.2, 0.4, 0.2, 0.4, 0.5]]}
BEYOND = [[300, 10, 40, 20], [290, 10, 50, 20], [280, 9, 60, 20]]
# Annotations of COCO, or lines of YOLO and the kpt_shape; and what is said of them.
FILES = {
    "shares": (boxes([0.25, 0.3, 0.2, 0.25], [0.6, 0.1, 0.1, 0.2]), PART),
    "outlines as shares": ([OUTLINE], f"outlines lie all {PART}"),
    "keypoints as shares": ([{"bbox": [9, 9, 50, 40], "keypoints": [0.2, 0.3, 2]}], PART),
    "corners": (boxes(*([x, x, 2 * x, 2 * x] for x in (90, 100, 110))), LIKE),
    "corners by their area": (boxes([20, 20, 60, 70], area=2000), LIKE),
    "panoptic": ([{"segments_info": []}], "is COCO's panoptic file"),
    "inside": (boxes([100, 60, 50, 40], [1, 2, 30, 20], [200, 100, 20, 20]), None),
    "a pixel": (boxes([0, 0, 1, 1]), None),
    "tiny": (boxes([0.2, 0.3, 0.4, 0.4], [90.2, 60.5, 0.5, 0.5]), None),
    "all of the picture": (boxes([0, 0, 320, 240], area=320 * 240), None),
    "beyond the picture": (boxes(*BEYOND, [-9, 10, 40, 20]), None),
    "only beyond it": (boxes(*BEYOND), None),
    "per cent": (["0 50 50 20 20"], UNIT),
    "an outline in per cent": (["0 40 40 60 40 60 60 40 60"], UNIT),
    "pixels": (["0 132 24 10 12", "0 1 1 1 1", "0 40 40 60 60 50 20"], "like pixels, as 2 of 3"),
    "shares of corners": ([f"0 .{x} .{x} .9{x}1 .9" for x in (1, 2, 3)], LIKE),
    "tracks": (["0 .5 .5 .2 .2 .91 7", "0 .1 .1 .1 .1 .9 1"], TRACK),
    "tracks and scores": (["0 .5 .5 .2 .2 7 .91"], TRACK),
    "the same track": ([f"0 .5 .5 .2 .{k} .9 1" for k in (1, 2, 3)], TRACK),
    "tracks of corners": (["0 .1 .1 .5 .1 .5 .9 .1 .9 .8 2"], TRACK),
    "keypoints without kpt_shape": ([f"{POINT} .6 .7 1"], TRACK),
    "a score": (["0 .5 .5 .2 .2 .9"], TRACK),
    "fewer keypoints": ([POINT], "a box, or 6 of keypoints", [2, 3]),
    "more keypoints": ([POINT], "a box, or 2 of keypoints", [1, 2]),
    "another kpt_shape": ([POINT], "kpt_shape is a count, and 2 or 3", [1, 4]),
    "keypoints": ([POINT], None, [1, 3]), "triangles": (TRIANGLES, None),
    "small and large": (["0 .001 .001 .001 .001", "0 .5 .5 1 1"], None),
    "frames": ([ALL] * 3, None),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_files_as_a_whole(tmp_path, name):
    rows, said, *shape = FILES[name]
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((240, 320, 3), np.uint8))
    if isinstance(rows[0], str):
        (tmp_path / "labels" / "a.txt").write_text("\n".join(rows))
        content = {"names": ["cone"], "kpt_shape": shape[0] if shape else None}
        (tmp_path / "data.yaml").write_text(json.dumps(content))
    else:
        own = [{"id": k, "image_id": 1, "category_id": 1} | row for k, row in enumerate(rows)]
        images = [{"id": 1, "file_name": "a.png", "width": 320, "height": 240}]
        content = {"images": images, "annotations": own, "categories": [{"id": 1, "name": "cone"}]}
        (tmp_path / "labels.json").write_text(json.dumps(content))
    if said is None:
        assert len(open_labels(tmp_path).labels(0).instances) == len(rows)
    else:
        refused(said, lambda: open_labels(tmp_path).labels(0))


@pytest.mark.parametrize("form", [SIDES, MIDDLE])
def test_the_form_of_many_boxes(form):
    rng = np.random.default_rng(0)
    middle, half = rng.uniform(0, 1, (2, 300, 2)) * [[[1]], [[0.3]]]
    low, high = (middle - half).clip(0, 1), (middle + half).clip(0, 1)
    written = {
        CORNERS: (low, high),
        SIDES: (low, high - low),
        MIDDLE: ((low + high) / 2, high - low),
    }
    check_form(Path("a"), MIDDLE, np.hstack((middle, 2 * half)))  # some reach beyond the picture
    for other, columns in written.items():
        if other == form:
            check_form(Path("a"), form, np.hstack(columns))
        else:
            said = f"boxes cannot be .* look like {other}"
            refused(said, check_form, Path("a"), form, np.hstack(columns))
