"""What a detector finds in a view, in the pixels of the picture: carried, drawn, and written."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from darswin import boxes
from darswin.boxes.regions import box_of, shown_parts
from darswin.frames.onnx import Detections
from darswin.utils.image import with_channels
from darswin.views import Remap
from darswin.viz.pixels import MOST_CLASSES, draw_boxes, overlay, palette

Found = dict[str, Any]  # columns of things; masks are in run-length encoding
Size = tuple[int, int]

_ANGLES = np.linspace(0, 2 * np.pi, 288, endpoint=False)
_CIRCLE = np.stack((np.cos(_ANGLES), np.sin(_ANGLES)), 1)
_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2


def without_overlaps(one: Detections) -> Detections:
    """The best of the boxes that show the same thing, for a network that leaves this to others."""
    kept = boxes.merge(one.boxes, one.scores, one.labels, inside=1.0)
    return Detections(*(None if values is None else values[kept] for values in one))  # type: ignore[arg-type]


def in_picture(remap: Remap, found: Sequence[Detections]) -> Found:
    """The detections in a view, or in all tiles, as columns of things in the picture, the best
    first: boxes, visible, scores and labels; and keypoints, turned and masks if there are any.

    Things come by the ellipses in their boxes, turned or not; keypoints as points; and masks by
    their pixels. What the picture does not show is left out, and keypoints of it are NaN.
    """
    parts = []
    for number, (tile, one) in enumerate(zip(remap.tiles, found, strict=True)):
        part = {"scores": one.scores, "labels": one.labels}
        if one.turned is None:
            part["boxes"], part["visible"], _ = tile.boxes_to_image(one.boxes)
        else:
            part["turned"], part["boxes"], part["visible"] = _turned(tile, one.turned)
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
    if "masks" in joined:
        joined["masks"] = [
            boxes.encode_rle(remap.tiles[tile].back(found[tile].masks[row, None])[0] > 0.5)
            for tile, row in joined["masks"].tolist()
        ]  # one by one: those of all things could fill the memory
    return joined


def _turned(tile: Remap, turned: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turned boxes (K, 5) of a view, those around their ellipses in the picture, upright boxes
    (K, 4), and the shares that are visible (K,)."""
    frames = [_frame(*one) for one in turned]
    shown = shown_parts(
        [middle + _CIRCLE @ axes.T for middle, axes in frames],
        lambda points: boxes.carry_points(points, tile.to_image), tile.size,
    )  # fmt: skip
    found, around = np.full((len(turned), 5), np.nan), np.full((len(turned), 4), np.nan)
    for k, ((middle, axes), (parts, _)) in enumerate(zip(frames, shown, strict=True)):
        if not parts:
            continue
        old, new = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        around[k] = box_of([new])
        # The map of the ellipse that is nearest to a linear one, and the turn nearest to it.
        local = np.column_stack((np.ones(len(old)), (old - middle) @ np.linalg.inv(axes).T))
        w, h = np.linalg.lstsq(local, new, rcond=None)[0][1:]
        w, h = w / np.linalg.norm(w), h / np.linalg.norm(h)
        h = h if w[0] * h[1] > w[1] * h[0] else -h  # a view may be mirrored
        angle = math.atan2(w[1] - h[0], w[0] + h[1])
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        low, high = (new @ turn).min(0), (new @ turn).max(0)
        found[k] = *(turn @ (low + high) / 2), *(high - low), angle
    return found, around, np.array([share for _, share in shown])


def _frame(x: float, y: float, w: float, h: float, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """The middle of a turned box, and the halves of its sides, the columns of (2, 2)."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array((x, y)), np.array([[cos * w, -sin * h], [sin * w, cos * h]]) / 2


def corners(turned: np.ndarray) -> np.ndarray:
    """The corners of turned boxes (K, 5): (K, 4, 2)."""
    frames = [_frame(*one) for one in turned]
    return np.array([m + 2 * _CORNERS @ axes.T for m, axes in frames]).reshape(-1, 4, 2)


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
    outlines = corners(found["turned"]) if "turned" in found else None
    picture = draw_boxes(picture, found["boxes"], texts, colors, outlines)
    for points, color in zip(found.get("keypoints", ()), colors, strict=False):
        for x, y in points[np.isfinite(points[:, 0]), :2].astype(int).tolist():
            cv2.circle(picture, (x, y), max(2, max(picture.shape) // 500), color, cv2.FILLED)
    return picture


def coco_results(name: str, found: Found) -> list[dict[str, Any]]:
    """The things in one picture as entries of COCO's results. Like other tools, the id of a picture
    is the number that its file has as a name, and else this name."""
    stem = name.rpartition("/")[2]
    results = []
    for k, (x0, y0, x1, y1) in enumerate(found["boxes"].tolist()):
        one = {
            "image_id": int(stem) if stem.isdecimal() else name,
            "category_id": int(found["labels"][k]),
            "bbox": rounded([x0, y0, x1 - x0, y1 - y0], 2),
            "score": rounded(float(found["scores"][k]), 4),
        }
        if "masks" in found:
            one["segmentation"] = found["masks"][k]
        if "turned" in found:
            one["segmentation"] = [rounded(corners(found["turned"][k, None])[0].ravel(), 2)]
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
            row = corners(found["turned"][k, None])[0] / sides
        if "masks" in found:
            mask = boxes.decode_rle(found["masks"][k]).astype(np.uint8)
            outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            if outlines:
                row = (max(outlines, key=cv2.contourArea).reshape(-1, 2) + 0.5) / sides
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
    """Numbers in lists for JSON, which has no NaN."""
    if np.ndim(values):
        return [rounded(value, digits) for value in values]
    return None if math.isnan(values) else round(float(values), digits)


def entries(found: Found, columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """The things in JSON: these columns, and what else there is."""
    more = {
        key: rounded(found[key], digits)
        for key, digits in (("keypoints", 3), ("turned", 4)) if key in found
    }  # fmt: skip
    more |= {"mask": found["masks"]} if "masks" in found else {}
    columns = {**columns, **more}
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
