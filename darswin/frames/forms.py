"""The forms in which detectors write what they find, decoded to boxes in pixels."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from darswin.boxes import Instances
from darswin.boxes.turned import upright

Outputs = Mapping[str, np.ndarray]
Size = tuple[int, int]
Where = dict[str, tuple[str, slice]]
_PART = 1.5  # coordinates in parts of the picture end there: boxes need not be cut at its border
_BOX_MASK = 33  # px: no mask of a whole picture is that small, unless the picture is


class Pixels(NamedTuple):
    """What a network expects: (pixel/255 - mean) / std, in this order of colours."""

    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    channels: str = "rgb"


RGB = Pixels()


@dataclass(frozen=True)
class Form:
    """The form of a detector's outputs.

    Attributes:
        name: a word of `darswin.frames.recognise.FORMS`.
        where: the output and the columns of each part of a detection; "either" are those of score
            and class, whose order the first rows tell.
        code: how boxes are written: corners x0, y0, x1, y1; rows y0, x0, y1, x1; middle and size;
            or relative to the cells of grids, as yolox or nanodet do.
        in_parts, points_in_parts: boxes and keypoints are parts of the picture, not pixels; None
            until the first of them tell it.
        scores: softmax or sigmoid, which makes probabilities of the scores; "" if they are some.
        things_last: the last axis counts the things.
        overlaps: several boxes show one thing, so `darswin.boxes.merge` must keep the best.
        point: how many numbers a keypoint has.
        pixels: those that such networks expect, unless they take uint8.
    """

    name: str
    where: Where
    code: str = "corners"
    in_parts: bool | None = None
    points_in_parts: bool | None = None
    scores: str = ""
    things_last: bool = False
    overlaps: bool = False
    point: int = 3
    pixels: Pixels = RGB


def grids(size: Size) -> dict[int, tuple[tuple[int, ...], int]]:
    """The strides of the grids that have so many cells, and 1, or a third of them, and 3."""
    strides_of: dict[int, tuple[tuple[int, ...], int]] = {}
    for strides in ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32)):
        count = sum(math.ceil(size[0] / of) * math.ceil(size[1] / of) for of in strides)
        strides_of = {count: (strides, 1), 3 * count: (strides, 3)} | strides_of
    return strides_of


def cells(size: Size, strides: Sequence[int]) -> np.ndarray:
    """The cells of all grids, x, y and the stride: (N, 3)."""
    each = []
    for stride in strides:
        y, x = np.mgrid[: math.ceil(size[0] / stride), : math.ceil(size[1] / stride)]
        each.append(np.stack((x, y, np.full(x.shape, stride)), -1).reshape(-1, 3))
    return np.concatenate(each)


@np.errstate(invalid="ignore", over="ignore")  # the caller tells of them
def decode(
    form: Form, outputs: Outputs, count: int, size: Size, threshold: float
) -> tuple[Form, list[Instances]]:
    """The detections in each of `count` pictures of (H, W) whose score is not below `threshold`;
    and the form, with what these tell of it.

    Boxes are turned, (K, 5), if the network turns them; masks are the probabilities of pixels.

    Raises:
        ValueError: the outputs are of another number of pictures, or not of this form.
    """
    if "either" in form.where:
        form = _with_order(form, outputs)
    pictures = [_kept(form, parts, size, threshold) for parts in _pictures(form, outputs, count)]
    units = [
        _in_parts(known, name, [kept[name] for kept in pictures if name in kept])
        for known, name in ((form.in_parts, "boxes"), (form.points_in_parts, "points"))
    ]
    form = replace(form, in_parts=units[0], points_in_parts=units[1])
    return form, [_instances(form, kept, size) for kept in pictures]


def _pictures(form: Form, outputs: Outputs, count: int) -> list[dict[str, np.ndarray]]:
    """The parts of each picture, a row for each thing."""
    parts = {}
    for key, (name, columns) in form.where.items():
        values = outputs[name]
        if form.things_last and values.ndim == 3:
            values = values.swapaxes(1, 2)
        parts[key] = values.reshape(-1) if key == "count" else values[..., columns]
    if "image" in parts:
        rows = {key: values.reshape(-1, values.shape[-1]) for key, values in parts.items()}
        number = rows["image"][:, 0]
        return [{key: of[number == k] for key, of in rows.items()} for k in range(count)]
    batch = 1 if parts["boxes"].ndim == 2 else len(parts["boxes"])
    if batch != count:
        raise ValueError(f"it gives the boxes of {batch} pictures for {count}")
    if parts["boxes"].ndim == 2:
        return [parts]
    return [{key: of[k] for key, of in parts.items()} for k in range(count)]


def orders_of(pairs: np.ndarray) -> list[int]:
    """The columns, 0 or 1, of pairs (N, 2) that can be scores while the others are classes."""
    both = (pairs.T, pairs.T[::-1])
    return [
        k for k, (score, label) in enumerate(both)
        if ((score > 0) & (score <= 1)).all() and not (label % 1).any()
    ]  # fmt: skip


def _with_order(form: Form, outputs: Outputs) -> Form:
    """The form with its score and its class where the rows have them, if they are not equal."""
    name, columns = form.where["either"]
    pairs = outputs[name][..., columns]
    if not (orders := orders_of(pairs)):
        text = ", ".join(f"{value:g}" for value in pairs[0])
        raise ValueError(f"its last columns must be a score up to 1 and a class, got {text}")
    score, label = columns.start + orders[0], columns.start + 1 - orders[0]
    where = dict(scores=(name, slice(score, score + 1)), labels=(name, slice(label, label + 1)))
    where |= {} if len(orders) == 1 else {"either": (name, columns)}
    return replace(form, where={k: v for k, v in form.where.items() if k != "either"} | where)


def _kept(
    form: Form, parts: dict[str, np.ndarray], size: Size, threshold: float
) -> dict[str, np.ndarray]:
    """The parts of the things that are detections, with one score and one label each."""
    rows = len(parts["boxes"])
    scores = parts["scores"].astype(float).reshape(rows, -1 if rows else 1)
    if form.scores == "softmax":  # the last class is nothing
        scores = np.exp(scores - scores.max(-1, keepdims=True))
        scores = (scores / scores.sum(-1, keepdims=True))[:, :-1]
    for values in (scores, parts.get("objectness", scores)) if form.overlaps else ():
        low, high = values.min(initial=0), values.max(initial=0)
        if low < -0.01 or high > 1.01:
            raise ValueError(
                f"its shape is that of {form.name}, but its scores must be from 0 to 1, got "
                f"{low:.3g} to {high:.3g}: export it with its sigmoid"
            )
    labels = parts["labels"].reshape(rows) if "labels" in parts else scores.argmax(-1)
    score = scores.max(-1)
    if form.scores == "sigmoid":
        score = 1 / (1 + np.exp(-score))
    if "objectness" in parts:
        score = score * parts["objectness"][:, 0]
    keep = ~(score < threshold)
    if "count" in parts:
        used = int(parts["count"].max())
        if not 0 <= used <= rows:
            raise ValueError(f"it says that {used} of {rows} boxes are things")
        keep[used:] = False
    parts = parts | {"scores": score, "labels": labels}
    if form.code in ("yolox", "nanodet"):
        parts["cells"] = cells(size, grids(size)[rows][0])
    if "points" in parts:
        points = parts["points"]
        width = points.shape[2] if points.ndim == 3 else form.point
        parts["points"] = points.reshape(rows, math.prod(points.shape[1:]) // width, width)
    whole = ("count", "protos")
    return {key: values if key in whole else values[keep] for key, values in parts.items()}


def _in_parts(known: bool | None, name: str, tables: Sequence[np.ndarray]) -> bool | None:
    """Whether coordinates are parts of the picture, by the first ones; None without any."""
    most = 0.0
    for table in tables:
        places = np.abs(table[..., : 4 if name == "boxes" else 2].astype(float))
        most = max(most, places[np.isfinite(places)].max(initial=0))
    if known and most > 2 * _PART:
        raise ValueError(f"its {name} must be parts of the picture, but reach {most:g} times it")
    return bool(most <= _PART) if known is None and most else known


def _instances(form: Form, kept: dict[str, np.ndarray], size: Size) -> Instances:
    boxes = kept["boxes"].astype(float)
    if "cells" in kept:
        corner, stride = kept["cells"][:, :2], kept["cells"][:, 2:]
        if form.code == "yolox":
            boxes = np.concatenate((boxes[:, :2] + corner, np.exp(boxes[:, 2:])), -1) * stride
        else:
            bins = boxes.reshape(-1, 4, 8)
            bins = np.exp(bins - bins.max(-1, keepdims=True))
            sides = bins @ np.arange(8) / bins.sum(-1)
            boxes = np.concatenate((corner - sides[:, :2], corner + sides[:, 2:]), -1) * stride
    if form.code == "rows":
        boxes = boxes[:, [1, 0, 3, 2]]
    if form.in_parts:
        boxes *= (*size[::-1], *size[::-1])
    if "turn" in kept:
        boxes = np.concatenate((boxes, kept["turn"]), -1)
    elif form.code in ("middle", "yolox"):
        middle, half = boxes[:, :2], boxes[:, 2:] / 2
        boxes = np.concatenate((middle - half, middle + half), -1)
    points = kept.get("points")
    if points is not None:
        points = points.astype(float)
        if form.code == "rows":
            points[..., :2] = points[..., 1::-1]
        if form.points_in_parts:
            points[..., :2] *= size[::-1]
        if "point_scores" in kept:
            points = np.concatenate((points, kept["point_scores"][..., None]), -1)
    masks = _masks(form, kept, boxes, size)
    return Instances(boxes, kept["scores"], kept["labels"], points, masks)


def _masks(form: Form, kept: Outputs, boxes: np.ndarray, size: Size) -> np.ndarray | None:
    """The masks of instances, as they are, of those that all share, or each of its box alone; None
    without any."""
    masks: np.ndarray
    if "protos" in kept:
        weights, protos = kept["weights"], kept["protos"]
        masks = np.tensordot(weights.astype(np.float32), protos.astype(np.float32), 1)
    elif "masks" in kept:
        masks = kept["masks"]
        masks = masks.reshape(len(boxes), *masks.shape[-2:]).astype(np.float32)
    else:
        return None
    if "protos" in kept or form.scores:
        masks = 1 / (1 + np.exp(-masks))
    if "masks" in kept:
        return whole_masks(masks, boxes, size)
    # Those that all share have meaning inside the box only.
    x0, y0, x1, y1 = boxes.T[..., None, None] * masks.shape[1] / size[0] - 0.5
    y, x = np.ogrid[: masks.shape[1], : masks.shape[2]]
    return masks * ((x0 <= x) & (x < x1) & (y0 <= y) & (y < y1))


def whole_masks(masks: np.ndarray, boxes: np.ndarray, size: Size) -> np.ndarray:
    """Masks (K, h, w) of pictures (H, W), as they are, or made of those of each box alone."""
    scale = size[0] / masks.shape[1]
    is_small = scale > 4 and max(masks.shape[1:]) <= _BOX_MASK
    if scale % 1 == 0 and masks.shape[2] * scale == size[1] and not is_small:
        return masks
    boxes = upright(boxes).clip(-1e6, 1e6)  # they may end nowhere
    pasted = [*map(partial(_pasted, size=size), masks, boxes)]
    return np.array(pasted, np.float32).reshape(-1, *size)


def _pasted(mask: np.ndarray, box: np.ndarray, size: Size) -> np.ndarray:
    """The mask of a box in a picture (H, W), in between its pixels by both nearest ones."""
    weights = []
    for low, high, pixels, side in zip(box[1::-1], box[3:1:-1], mask.shape, size, strict=True):
        places = (np.arange(side) + 0.5 - low) / max(high - low, 1e-9) * pixels - 0.5
        weights.append(np.maximum(0, 1 - np.abs(places[:, None] - np.arange(pixels))))
    return weights[0] @ mask @ weights[1].T
