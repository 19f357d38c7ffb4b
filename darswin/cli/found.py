"""What a detector finds in a view, in the pixels of the picture: carried, drawn, and written."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from darswin import boxes
from darswin.boxes.turned import upright
from darswin.frames.onnx import Detections
from darswin.utils.image import with_channels
from darswin.views import Remap
from darswin.viz.pixels import MOST_CLASSES, draw_boxes, overlay, palette

Found = dict[str, Any]  # columns of things; masks are in run-length encoding
Size = tuple[int, int]


def without_overlaps(one: Detections) -> Detections:
    """The best of the boxes that show the same thing, for a network that leaves this to others."""
    kept = boxes.merge(_boxes_of(one), one.scores, one.labels, inside=1.0)
    return Detections._make(None if values is None else values[kept] for values in one)


def _boxes_of(one: Detections) -> np.ndarray:
    """The boxes, turned if the network turns them: (K, 4 or 5)."""
    return one.boxes if one.turned is None else one.turned


def in_picture(
    remap: Remap, found: Sequence[Detections], floor: Mapping[str, Any] | None = None
) -> Found:
    """The detections in a view, or in all tiles, as columns of things in the picture, the best
    first: boxes, visible, scores and labels; keypoints, turned and masks if there are any; and
    their places on the floor, if the arguments of `Remap.floor` are given.

    Things come by the ellipses in their boxes, turned or not; keypoints as points; and masks by
    their pixels. What the picture does not show is left out, and keypoints of it are NaN.
    """
    parts = []
    for number, (tile, one) in enumerate(zip(remap.tiles, found, strict=True)):
        part = {"scores": one.scores, "labels": one.labels}
        part["boxes"], part["visible"], _ = tile.boxes_to_image(_boxes_of(one))
        if floor is not None:
            part["floor"] = tile.floor(one.boxes, **floor)
        if one.keypoints is not None:
            places = boxes.carry_points(one.keypoints[..., :2], tile.to_image)
            part["keypoints"] = np.concatenate((places, one.keypoints[..., 2:]), -1)
        if one.masks is not None:
            part["masks"] = np.stack(
                (np.full(len(one.masks), number), np.arange(len(one.masks))), 1
            )
        parts.append({key: values[part["visible"] > 0] for key, values in part.items()})
    joined: Found = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    if len(found) == 1:  # a network knows best which of its own boxes are one thing
        order = np.argsort(-joined["scores"], kind="stable")
    else:
        order = boxes.merge(joined["boxes"], joined["scores"], joined["labels"])
    joined = {key: values[order] for key, values in joined.items()}
    if joined["boxes"].shape[1] == 5:
        joined["turned"] = joined["boxes"]
        joined["boxes"] = upright(joined["turned"])
    if "masks" in joined:
        joined["masks"] = [
            boxes.encode_rle(remap.tiles[tile].back(found[tile].masks[row, None])[0] > 0.5)
            for tile, row in joined["masks"].tolist()
        ]  # one by one: those of all things could fill the memory
    return joined


def drawn(image: np.ndarray, found: Found, texts: Sequence[str]) -> np.ndarray:
    """Boxes with their texts, masks and keypoints on an image (H, W, C): (H, W, 3)."""
    colors = [palette(MOST_CLASSES)[label % MOST_CLASSES] for label in found["labels"].tolist()]
    picture = with_channels(image, 3)
    if found.get("masks"):
        laid, where = np.zeros_like(picture), np.zeros(picture.shape[:2], bool)
        for rle, color in reversed(list(zip(found["masks"], colors, strict=True))):
            mask = boxes.decode_rle(rle)
            laid[mask], where[mask] = color, True
        picture = overlay(picture, laid, where=where)
    outlines = boxes.corners(found["turned"]) if "turned" in found else None
    picture = draw_boxes(picture, found["boxes"], texts, colors, outlines)
    for points, color in zip(found.get("keypoints", ()), colors, strict=False):
        for x, y in points[np.isfinite(points[:, 0]), :2].astype(int).tolist():
            cv2.circle(picture, (x, y), max(2, max(picture.shape) // 500), color, cv2.FILLED)
    return picture


def coco_ids(names: Iterable[str]) -> dict[str, int]:
    """The ids of pictures in COCO by their names: like other tools, the numbers that their files
    have as names, if no two are the same. All others are known by their names."""
    stems = {name: name.rpartition("/")[2] for name in names}
    found = {name: int(stem) for name, stem in stems.items() if stem.isdecimal()}
    return found if len({*found.values()}) == len(found) else {}


def coco_results(picture: int | str, found: Found) -> list[dict[str, Any]]:
    """The things in one picture with this id as entries of COCO's results."""
    results = []
    for k, (x0, y0, x1, y1) in enumerate(found["boxes"].tolist()):
        one = {
            "image_id": picture,
            "category_id": int(found["labels"][k]),
            "bbox": rounded([x0, y0, x1 - x0, y1 - y0], 2),
            "score": rounded(float(found["scores"][k]), 4),
        }
        if "masks" in found:
            one["segmentation"] = found["masks"][k]
        if "turned" in found:
            one["segmentation"] = [rounded(boxes.corners(found["turned"][k, None])[0].ravel(), 2)]
        if "keypoints" in found:
            one["keypoints"] = rounded(_three(found["keypoints"][k]).ravel(), 2)
        results.append(one)
    return results


def yolo_lines(size: Size, found: Found) -> str:
    """The things in one picture of (H, W) as the lines of YOLO's text files, with their scores."""
    sides, lines = np.array(size[::-1], float), []
    for k, (x0, y0, x1, y1) in enumerate(found["boxes"]):
        row = np.array((x0 + x1, y0 + y1, 2 * (x1 - x0), 2 * (y1 - y0))).reshape(2, 2) / 2 / sides
        if "turned" in found:
            row = boxes.corners(found["turned"][k, None])[0] / sides
        if "masks" in found:
            mask = boxes.decode_rle(found["masks"][k]).astype(np.uint8)
            outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            outline = max(outlines, key=cv2.contourArea, default=np.zeros(0)).reshape(-1, 2)
            if len(outline) > 2:  # or it would read as a box
                row = (outline + 0.5) / sides
        numbers = [*row.ravel()]
        if "keypoints" in found:
            numbers += (_three(found["keypoints"][k]) / [*sides, 1]).ravel().tolist()
        text = " ".join(f"{number:.6g}" for number in (*numbers, found["scores"][k]))
        lines.append(f"{int(found['labels'][k])} {text}\n")
    return "".join(lines)


def _three(points: np.ndarray) -> np.ndarray:
    """Keypoints (P, 2 or 3) as (P, 3); 0, 0, 0 if they are not shown."""
    points = np.column_stack((points, np.ones(len(points))))[:, :3]
    return np.where(np.isfinite(points).all(1, keepdims=True), points, 0.0)


def rounded(values: Any, digits: int) -> Any:
    """Numbers in lists for JSON, which has no NaN and no infinity."""
    if np.ndim(values):
        return [rounded(value, digits) for value in values]
    return round(float(values), digits) if math.isfinite(values) else None


def entries(found: Found, columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """The things in JSON: these columns, and what else there is."""
    more = {
        key: rounded(found[key], digits)
        for key, digits in (("keypoints", 3), ("turned", 4)) if key in found
    }  # fmt: skip
    if "floor" in found:
        more["floor"] = [None if None in place else place for place in rounded(found["floor"], 3)]
    more |= {"mask": found["masks"]} if "masks" in found else {}
    columns = {**columns, **more}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
