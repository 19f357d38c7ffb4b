"""The forms in which detectors write what they find, decoded to boxes in pixels."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from darswin.boxes import Instances

Outputs = Mapping[str, np.ndarray]
Size = tuple[int, int]
Where = dict[str, tuple[str, slice]]


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
        name: whose it is.
        where: the output and the columns of each part of a detection.
        code: how boxes are written: corners x0, y0, x1, y1; rows y0, x0, y1, x1; middle and size;
            or relative to the cells of grids, as yolox or nanodet do.
        in_parts: boxes are parts of the picture, not pixels.
        scores: softmax or sigmoid, which makes probabilities of the scores; "" if they are some.
        things_last: the last axis counts the things.
        overlaps: several boxes show one thing, so `darswin.boxes.merge` must keep the best.
        point: how many numbers a keypoint has.
        pixels: those that such networks expect, unless they take uint8.
    """

    name: str
    where: Where
    code: str = "corners"
    in_parts: bool = False
    scores: str = ""
    things_last: bool = False
    overlaps: bool = False
    point: int = 3
    pixels: Pixels = RGB


def grids(size: Size) -> dict[int, tuple[tuple[int, ...], int]]:
    """The strides of the grids that have so many cells, and 1, or a third of them, and 3."""
    strides_of: dict[int, tuple[tuple[int, ...], int]] = {}
    for strides in ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32)):
        count = len(cells(size, strides))
        strides_of = {count: (strides, 1), 3 * count: (strides, 3)} | strides_of
    return strides_of


def cells(size: Size, strides: Sequence[int]) -> np.ndarray:
    """The cells of all grids, x, y and the stride: (N, 3)."""
    each = []
    for stride in strides:
        y, x = np.mgrid[: math.ceil(size[0] / stride), : math.ceil(size[1] / stride)]
        each.append(np.stack((x, y, np.full(x.shape, stride)), -1).reshape(-1, 3))
    return np.concatenate(each)


def decode(
    form: Form, outputs: Outputs, count: int, size: Size, threshold: float
) -> list[Instances]:
    """The detections in each of `count` pictures of (H, W) whose score is not below `threshold`.

    Boxes are turned, (K, 5), if the network turns them; masks are the probabilities of pixels.

    Raises:
        ValueError: the outputs are of another number of pictures.
    """
    parts = {}
    for key, (name, columns) in form.where.items():
        values = outputs[name]
        if form.things_last and values.ndim == 3:
            values = values.swapaxes(1, 2)
        parts[key] = values[..., columns] if values.ndim else values
    if "image" in parts:
        rows = {key: values.reshape(-1, values.shape[-1]) for key, values in parts.items()}
        number = rows["image"][:, 0]
        pictures = [{k: of[number == p] for k, of in rows.items()} for p in range(count)]
    elif parts["boxes"].ndim == 2:
        pictures = [parts]
    else:
        pictures = [{k: of[p] for k, of in parts.items()} for p in range(len(parts["boxes"]))]
    if len(pictures) != count:
        raise ValueError(f"it gives the boxes of {len(pictures)} pictures for {count}")
    return [_decoded(form, picture, size, threshold) for picture in pictures]


@np.errstate(invalid="ignore", over="ignore")  # the caller tells of them
def _decoded(form: Form, parts: dict[str, np.ndarray], size: Size, threshold: float) -> Instances:
    rows, scores = len(parts["boxes"]), parts["scores"].astype(float)
    scores = scores[:, None] if scores.ndim == 1 else scores
    if form.scores == "softmax":  # the last class is nothing
        scores = np.exp(scores - scores.max(-1, keepdims=True))
        scores = (scores / scores.sum(-1, keepdims=True))[:, :-1]
    labels = parts["labels"].reshape(rows) if "labels" in parts else scores.argmax(-1)
    score = scores.max(-1)
    # SuperGradients has the class after the score.
    if "image" in parts and ((labels % 1).any() or (score > 1).any()):
        labels, score = score, labels
    if form.scores == "sigmoid":
        score = 1 / (1 + np.exp(-score))
    if "objectness" in parts:
        score = score * parts["objectness"][:, 0]
    keep = ~(score < threshold)
    if "count" in parts:
        keep[int(parts["count"].reshape(-1)[0]) :] = False
    kept = {key: v[keep] for key, v in parts.items() if key not in ("count", "protos")}
    boxes = kept["boxes"].astype(float)
    if form.code in ("yolox", "nanodet"):
        *corner, stride = cells(size, grids(size)[rows][0])[keep].T[..., None]
        corner = np.concatenate(corner, -1)
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
        width = points.shape[2] if points.ndim == 3 else form.point
        shape = len(boxes), math.prod(points.shape[1:]) // width, width
        points = points.reshape(shape).astype(float)
    masks = _masks(form, parts, kept, boxes, size)
    return Instances(boxes, score[keep], labels[keep], points, masks)


def _masks(
    form: Form, parts: Outputs, kept: Outputs, boxes: np.ndarray, size: Size
) -> np.ndarray | None:
    """The masks of instances, as they are or of those that all share; None without any."""
    masks: np.ndarray
    if "protos" in parts:
        weights, protos = kept["weights"], parts["protos"]
        masks = np.tensordot(weights.astype(np.float32), protos.astype(np.float32), 1)
    elif "masks" in kept:
        masks = kept["masks"]
        masks = masks.reshape(len(boxes), *masks.shape[-2:]).astype(np.float32)
    else:
        return None
    scale = size[0] / masks.shape[1]
    if scale % 1 or masks.shape[2] * scale != size[1]:
        return None  # each of its box alone
    if "protos" in parts or form.scores:
        masks = 1 / (1 + np.exp(-masks))
    if "protos" in parts:  # they have meaning inside the box only
        x0, y0, x1, y1 = boxes.T[..., None, None] / scale - 0.5
        y, x = np.ogrid[: masks.shape[1], : masks.shape[2]]
        masks *= (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)
    return masks
