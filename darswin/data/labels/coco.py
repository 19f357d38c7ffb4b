"""COCO's instances and keypoints: a JSON file of boxes, polygons, masks and keypoints.

Pictures are looked for as `file_name` says, in the folder of the file, in `images/` beside it, and
where COCO has them: in `val2017/` or `images/val2017/` for `annotations/instances_val2017.json`. A
calibration `lens.json` beside the file, or beside its folder if the pictures are there too, is the
lens of all pictures.

Source: cocodataset.org/#format-data.
"""

import json
import math
import os
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np

from darswin.boxes import Instances, corners, decode_rle
from darswin.boxes.regions import NO_AREA, area_of, box_of, box_of_mask
from darswin.boxes.turned import as_turned
from darswin.data.cameras import Calibrations
from darswin.data.labels.judge import SIDES, check_form, check_pixels
from darswin.data.labels.labels import (
    LabelledPictures,
    Labels,
    Size,
    check_labels,
    known_keypoints,
    labelled,
)
from darswin.data.scenes.files import calibration_in
from darswin.data.splits import some
from darswin.utils.files import replace_file
from darswin.utils.image import read_header
from darswin.utils.text import read_json
from darswin.utils.words import counted, in_px

_OWN = {"segmentation", "bbox", "area", "iscrowd", "category_id", "keypoints", "num_keypoints",
        "visible"}  # fmt: skip
_DIGITS = 3  # after the point, in pixels
_SHARE_DIGITS = 4  # of scores, visible shares and degrees
_SAME = 0.1  # px, of corners that are rounded


def read_coco(path: str | Path, pictures: str | Path | None = None) -> LabelledPictures:
    """The pictures and instances of a COCO file of instances or keypoints.

    Args:
        pictures: the folder to which `file_name` is relative, if it is in none of the usual places.

    Raises:
        FileNotFoundError: a missing file, or no pictures where they should be.
        ValueError: another form. All errors name the file. Single pictures and annotations that
            cannot be used are left out and named in `wrong`, or by `labels(k)`.
    """
    path = Path(path)
    content = read_json(path)
    if not isinstance(content, Mapping) or not all(
        isinstance(content.get(name), list) for name in ("images", "annotations", "categories")
    ):
        raise ValueError(f'{path} must have the lists "images", "annotations" and "categories"')
    annotations = [entry for entry in content["annotations"] if isinstance(entry, Mapping)]
    if any("segments_info" in annotation for annotation in annotations):
        raise ValueError(f"{path} is COCO's panoptic file, with segments_info: give the instances")
    try:
        entries, categories = content["images"], content["categories"]
        files = [os.fspath(entry["file_name"]) for entry in entries]
        of_picture: dict[Any, list[dict]] = {entry["id"]: [] for entry in entries}
        points = {
            category["id"]: (len(names := category.get("keypoints") or ()), _mirror(names))
            for category in categories
        }
        if nameless := [category for category in categories if "name" not in category]:
            raise ValueError(f"{path}: a category must have a name, got {nameless[0]}")
        wrong = [
            f"{path}: {said}" for annotation in content["annotations"]
            if (said := _placed(annotation, of_picture, points))
        ]  # fmt: skip
    except KeyError as error:
        raise ValueError(f"{path} is not in COCO's form: it lacks {error}") from error
    except (AttributeError, TypeError) as error:
        raise ValueError(f"{path} is not in COCO's form: {error}") from error
    if len(of_picture) < len(entries) or len(set(files)) < len(files):
        raise ValueError(f"{path} lists a picture twice")
    _judge(path, entries, of_picture)
    folder = Path(pictures) if pictures is not None else _folder(path, files)
    there = [(folder / file).is_file() for file in files]
    if missing := [file for file, is_there in zip(files, there, strict=True) if not is_there]:
        text = f"{path}: {len(missing)} of {counted(len(files), 'picture')} missing in {folder}"
        if len(missing) == len(files):
            raise FileNotFoundError(f"{text}: {some(missing)}")
        wrong += [f"{path}: there is no picture {file} in {folder}" for file in missing]
    # A lens.json above the data set may be that of any camera, such as the one to warp to.
    beside, above = path.parent, path.parent.parent
    root = os.path.commonpath([os.path.abspath(beside), os.path.abspath(folder)])
    calibration = calibration_in(beside, *[above] * (root == os.path.abspath(above)))
    entries = list(compress(entries, there))
    return LabelledPictures(
        folder, list(compress(files, there)),
        [(entry, of_picture[entry["id"]]) for entry in entries],
        partial(_labels, path=str(path), folder=folder, points=points), categories, entries,
        Calibrations(calibration, folder) if calibration else None, wrong,
    )  # fmt: skip


def _judge(path: Path, entries: Sequence[Mapping], of_picture: Mapping[Any, list[dict]]) -> None:
    """ValueError if all boxes, outlines or keypoints are no pixels, or if boxes are no sides."""
    annotations = [annotation for group in of_picture.values() for annotation in group]

    def column(name: str) -> Iterable[Any]:
        return (annotation[name] for annotation in annotations if annotation.get(name))

    outlines = (
        part for parts in column("segmentation") if isinstance(parts, list) for part in parts
    )
    check_pixels(path, "boxes", (_table(box, 4) for box in column("bbox")))
    check_pixels(path, "outlines", (_table(part, 2) for part in outlines))
    check_pixels(path, "keypoints", (_table(points, 3)[:, :2] for points in column("keypoints")))
    rows = [
        _table([*box, bare.get("area") or 0, entry.get("width"), entry.get("height")], 7)
        for entry in entries for bare in of_picture[entry["id"]]
        if isinstance(box := bare.get("bbox"), list) and not bare.get("segmentation")
    ]  # fmt: skip
    table = np.concatenate([np.zeros((0, 7)), *rows])
    table = table[np.isfinite(table).all(1) & (table[:, 5:] > 0).all(1)]
    boxes, areas, sides = np.split(table, [4, 5], 1)
    check_form(path, SIDES, boxes / np.tile(sides, 2), areas[:, 0] / sides.prod(1))


def coco_files(folder: Path) -> list[Path]:
    """The COCO files of instances or keypoints of a folder: in it, or in `annotations/`."""
    return [
        file for file in sorted((*folder.glob("*.json"), *folder.glob("annotations/*.json")))
        if b'"annotations"' in (text := file.read_bytes()) and b'"categories"' in text
    ]  # fmt: skip


def _placed(
    annotation: Any, of_picture: Mapping[Any, list[dict]], categories: Mapping[Any, Any]
) -> str | None:
    """Adds an annotation to those of its picture, or says why this cannot be."""
    try:
        name = f"the annotation {annotation.get('id')}"
        category, picture = annotation["category_id"], annotation["image_id"]
        if category not in categories:
            known = some(list(categories))
            return f"{name} has the category {category!r}, but the categories are {known}"
        if picture not in of_picture:
            return f"{name} is of the picture {picture!r}, which the file does not list"
    except KeyError as error:
        return f"{name} lacks {error}"
    except (AttributeError, TypeError):
        return f"an annotation must be a JSON object with ids, got {reprlib.repr(annotation)}"
    of_picture[picture].append(annotation)
    return None


def write_coco(
    path: str | Path,
    pictures: Sequence[tuple[Mapping[str, Any], Labels]],
    categories: Sequence[Mapping[str, Any]],
) -> None:
    """Writes a COCO file.

    Box and area are those of the labels, and "visible" is the share that a picture shows. Ids that
    several pictures or instances have, or none, are numbered anew.

    Args:
        pictures: of each picture, its entry, such as {"file_name": "a.png"}, and its labels.
        categories: as in `LabelledPictures`.

    Raises:
        ValueError: an instance has no label or that of no category, or its box is NaN because its
            picture does not show it.
    """
    known = {category["id"] for category in categories}
    for _, labels in pictures:
        check_labels(labels.instances, known)
    entries = [
        {**entry, "height": labels.size[0], "width": labels.size[1]} for entry, labels in pictures
    ]
    _number(entries)
    annotations = [
        annotation | {"image_id": entry["id"]}
        for entry, (_, labels) in zip(entries, pictures, strict=True)
        for annotation in coco_annotations(labels.instances)
    ]
    _number(annotations)
    content = {"images": entries, "annotations": annotations, "categories": list(categories)}
    replace_file(path, json.dumps(content, allow_nan=False))


def _number(entries: Sequence[dict]) -> None:
    ids = [entry.get("id") for entry in entries]
    if None in ids or len(set(ids)) < len(ids):
        for number, entry in enumerate(entries, 1):
            entry["id"] = number


def coco_annotations(instances: Instances) -> list[dict[str, Any]]:
    """The instances of one picture as COCO's annotations or results, without ids of their own.

    A turned box is written as its outline, its angle in degrees, as CVAT's `rotation`, and as
    `bbox` the upright box around it, where CVAT has the box before it is turned. Keypoints that
    are not known or not shown are 0, 0, 0.
    """
    more, areas, labels = instances.more, instances.areas.tolist(), instances.labels.tolist()
    turns = np.degrees(as_turned(instances.boxes)[:, 4]).tolist()
    annotations = []
    for k, (x0, y0, x1, y1) in enumerate(instances.upright):
        annotation: dict[str, Any] = dict(more["entry"][k]) if "entry" in more else {}
        annotation["category_id"] = labels[k]
        annotation["bbox"] = _rounded((x0, y0, x1 - x0, y1 - y0))
        annotation["area"] = round(areas[k], _DIGITS)
        if "crowd" in more:
            annotation["iscrowd"] = int(more["crowd"][k])
        if "visible" in more:
            annotation["visible"] = round(float(more["visible"][k]), _SHARE_DIGITS)
        if instances.scores is not None:
            annotation["score"] = round(float(instances.scores[k]), _SHARE_DIGITS)
        if (mask := instances.mask_of(k)) is not None:
            annotation["segmentation"] = mask
        elif len(outline := instances.outline_of(k)):
            annotation["segmentation"] = [_rounded(polygon.ravel()) for polygon in outline]
        if degrees := round(turns[k] % 360, _SHARE_DIGITS) % 360:
            attributes = annotation.get("attributes")
            attributes = attributes if isinstance(attributes, Mapping) else {}
            annotation["attributes"] = {**attributes, "rotation": degrees}
            points = corners(instances.boxes[k, None])
            annotation.setdefault("segmentation", [_rounded(points.ravel())])
        if len(points := known_keypoints(instances, k)):
            annotation["keypoints"] = _rounded(points.ravel())
            annotation["num_keypoints"] = int((points[:, 2] > 0).sum())
        annotations.append(annotation)
    return annotations


def picture_ids(names: Iterable[str]) -> dict[str, int]:
    """The ids of pictures in COCO by their names: like other tools, the numbers that their files
    have as names, if no two are the same. All others need numbers of their own."""
    stems = {name: name.rpartition("/")[2] for name in names}
    ids = {name: int(stem) for name, stem in stems.items() if re.fullmatch(r"[0-9]{1,18}", stem)}
    return ids if len({*ids.values()}) == len(ids) else {}


def _rounded(values: Any) -> list[float]:
    return np.round(np.asarray(values, float), _DIGITS).tolist()


def _folder(path: Path, files: Sequence[str]) -> Path:
    """The folder of the pictures: of the usual places, the first that has the first picture."""
    name = path.stem.rpartition("_")[2]
    places = [
        place
        for root in (path.parent, path.parent.parent)
        for place in (root, root / "images", root / name, root / "images" / name)
    ]
    return next((place for place in places if files and (place / files[0]).is_file()), places[1])


def _labels(
    raw: tuple[Mapping, Sequence[Mapping]], size: Size, path: str, folder: Path, points: Mapping
) -> tuple[Labels, list[str]]:
    entry, annotations = raw
    said = tuple(map(_side, (entry.get("height"), entry.get("width"))))
    if said not in (size, (None, None)):
        name, why = entry["file_name"], ""
        if said == size[::-1]:
            is_upright = read_header(folder / name).size == size
            why = ": its width and height are swapped" if is_upright else (
                " when its EXIF orientation turns it upright, as labels need it"
            )  # fmt: skip
        sides = "{} × {}".format(*said)  # which may be no numbers
        raise ValueError(f"{path} says that {name} has {sides}, but it has {in_px(size)}{why}")
    instances, wrong = [], []
    for annotation in annotations:
        try:
            instances.append(_instance(annotation, size, *points[annotation["category_id"]]))
        except ValueError as error:
            wrong.append(f"{path}: the annotation {annotation.get('id')} {error}")
    return Labels(Instances.joined(instances), size), wrong


def _side(side: Any) -> Any:
    """A side in px, which some tools write as text; what is none stays as it is."""
    try:
        return int(number) if (number := float(side)).is_integer() else side
    except (TypeError, ValueError, OverflowError):
        return side


def _table(values: Any, group: int) -> np.ndarray:
    """The numbers that a file has, in rows; one row of NaN for what is no such table."""
    try:
        return np.asarray(values, float).reshape(-1, group)
    except (TypeError, ValueError):
        return np.full((1, group), math.nan)


def _numbers(name: str, values: Any, group: int, least: int = 1) -> np.ndarray:
    table = _table(values, group)
    if len(table) < least or not np.isfinite(table).all():
        raise ValueError(
            f"has the {name} {reprlib.repr(values)}, which must be finite numbers, {group} each"
        )
    return table


def _instance(
    annotation: Mapping[str, Any], size: Size, count: int, mirror: Sequence[int]
) -> Instances:
    segments = annotation.get("segmentation") or ()
    polygons, rle, mask = [], None, np.zeros(size, bool)
    if isinstance(segments, Mapping):
        rle = dict(segments)
        if (sides := list(map(_side, np.ravel(np.asarray(rle.get("size"), object))))) == list(size):
            rle["size"] = sides  # which may have been texts
        elif len(sides) == 2:
            raise ValueError(f"has a mask of {rle['size']} px in a picture of {list(size)}")
        try:
            mask = decode_rle(rle)
        except (TypeError, ValueError) as error:
            raise ValueError(f"has a mask that cannot be read: {error}") from error
        rle = rle if mask.any() else None
    else:
        parts = segments if isinstance(segments, Sequence) else [segments]
        polygons = [_numbers("polygon", part, 2, 0) for part in parts]
        polygons = [polygon for polygon in polygons if area_of(polygon) > NO_AREA]
    x, y, width, height = _numbers("box", annotation.get("bbox", [0] * 4), 4)[0]
    box = np.array([x, y, x + width, y + height])
    if not (width > 0 and height > 0):  # what is there in its place
        box = box_of_mask(mask) if rle is not None else box_of(polygons)
        if np.isnan(box).any():
            said = annotation.get("bbox", "no bbox")
            raise ValueError(f"has {said}, and neither an outline nor a mask with an area")
    keypoints = annotation.get("keypoints")
    if keypoints is not None:
        keypoints = _numbers("keypoints", keypoints, 3, 0)
        if count and len(keypoints) not in (0, count):
            raise ValueError(f"has {len(keypoints)} keypoints x, y, v, but its category {count}")
    if str(mode := annotation.get("bbox_mode", 1)).split(".")[-1] not in ("1", "XYWH_ABS"):
        raise ValueError(f"has bbox_mode {mode}, but COCO's boxes are {SIDES}, bbox_mode 1")
    is_crowd = {"0": False, "1": True}.get(str(_side(annotation.get("iscrowd") or 0)))
    if is_crowd is None:
        raise ValueError(f"has iscrowd {annotation['iscrowd']!r}, which must be 0 or 1")
    entry = {name: value for name, value in annotation.items() if name not in _OWN}
    attributes = entry.get("attributes")
    attributes = attributes if isinstance(attributes, Mapping) else {}
    rotation = attributes.get("rotation")
    if rle is None and rotation and (not polygons or isinstance(rotation, int | float)):
        degrees = _numbers("rotation", rotation, 1)[0, 0]
        turned = _turned(box, polygons, math.radians(degrees)) if degrees else None
        if turned is not None:
            box, polygons = turned, []
            entry["attributes"] = {k: v for k, v in attributes.items() if k != "rotation"}
    visible = annotation.get("visible", 1.0)
    if not (isinstance(visible, int | float) and 0 <= visible <= 1):
        raise ValueError(f"has visible {visible!r}, which must be a share from 0 to 1")
    return labelled(
        annotation["category_id"], box, size, outline=polygons, mask=rle, crowd=is_crowd,
        visible=visible, keypoints=keypoints, mirror=mirror, entry=entry,
    )  # fmt: skip


def _turned(box: np.ndarray, polygons: Sequence[np.ndarray], angle: float) -> np.ndarray | None:
    """The turned box (5,) of CVAT's rotation, whose `bbox` is the box before it is turned; or that
    of `coco_annotations`, whose outline is its corners. None for another outline."""
    if not polygons:
        return np.array([*(box[:2] + box[2:]) / 2, *(box[2:] - box[:2]), angle])
    if len(polygons) > 1 or len(outline := polygons[0]) != 4:
        return None
    sides = np.linalg.norm(outline[[1, 3]] - outline[0], axis=1)
    turned = np.array([*outline.mean(0), *sides, angle])
    return turned if np.abs(corners(turned[None])[0] - outline).max() < _SAME else None


def _mirror(names: Sequence[str]) -> list[int]:
    """For each keypoint, the number of the one on the other side; none without sides."""
    swap = {"left": "right", "right": "left"}
    other = ["_".join(swap.get(word, word) for word in name.split("_")) for name in names]
    return [names.index(name) for name in other] if set(other) == set(names) else []
