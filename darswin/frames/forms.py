"""The forms in which detectors write what they find, decoded to boxes in pixels."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

Outputs = Mapping[str, np.ndarray]
Size = tuple[int, int]
Where = dict[str, tuple[str, slice]]


class Detections(NamedTuple):
    """What a detector finds in a picture.

    Shapes: boxes (K, 4), the corners x0, y0, x1, y1 in px, where the picture covers (0, 0) to
    (W, H); scores (K,); labels (K,), the numbers of the classes. None if the network has none:
    keypoints (K, P, 2 or 3), x and y in px, and a score; masks (K, h, w), the probabilities of
    pixels, of the picture or of a whole fraction of it; turned (K, 5), boxes by their middle x and
    y, width and height in px, and the angle of the width in rad, from x to y.
    """

    boxes: np.ndarray
    scores: np.ndarray
    labels: np.ndarray
    keypoints: np.ndarray | None = None
    masks: np.ndarray | None = None
    turned: np.ndarray | None = None


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
    found: dict[int, tuple[tuple[int, ...], int]] = {}
    for strides in ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32)):
        count = len(cells(size, strides))
        found = {count: (strides, 1), 3 * count: (strides, 3)} | found
    return found


def cells(size: Size, strides: Sequence[int]) -> np.ndarray:
    """The cells of all grids, x, y and the stride: (N, 3)."""
    each = []
    for stride in strides:
        y, x = np.mgrid[: math.ceil(size[0] / stride), : math.ceil(size[1] / stride)]
        each.append(np.stack((x, y, np.full(x.shape, stride)), -1).reshape(-1, 3))
    return np.concatenate(each)


def decode(
    form: Form, outputs: Outputs, count: int, size: Size, threshold: float
) -> list[Detections]:
    """The detections in each of `count` pictures of (H, W) whose score is not below `threshold`.

    Raises:
        ValueError: the outputs are of another number of pictures.
    """
    found = {}
    for key, (name, columns) in form.where.items():
        values = outputs[name]
        if form.things_last and values.ndim == 3:
            values = values.swapaxes(1, 2)
        found[key] = values[..., columns] if values.ndim else values
    if "image" in found:
        rows = {key: values.reshape(-1, values.shape[-1]) for key, values in found.items()}
        number = rows["image"][:, 0]
        each = [{key: values[number == k] for key, values in rows.items()} for k in range(count)]
    elif found["boxes"].ndim == 2:
        each = [found]
    else:
        of = range(len(found["boxes"]))
        each = [{key: values[k] for key, values in found.items()} for k in of]
    if len(each) != count:
        raise ValueError(f"it gives the boxes of {len(each)} pictures for {count}")
    return [_decoded(form, one, size, threshold) for one in each]


@np.errstate(invalid="ignore", over="ignore")  # the caller tells of them
def _decoded(form: Form, found: dict[str, np.ndarray], size: Size, threshold: float) -> Detections:
    things, scores = len(found["boxes"]), found["scores"].astype(float)
    scores = scores[:, None] if scores.ndim == 1 else scores
    if form.scores == "softmax":  # the last class is nothing
        scores = np.exp(scores - scores.max(-1, keepdims=True))
        scores = (scores / scores.sum(-1, keepdims=True))[:, :-1]
    labels = found["labels"].reshape(things) if "labels" in found else scores.argmax(-1)
    score = scores.max(-1)
    # SuperGradients has the class after the score.
    if "image" in found and ((labels % 1).any() or (score > 1).any()):
        labels, score = score, labels
    if form.scores == "sigmoid":
        score = 1 / (1 + np.exp(-score))
    if "objectness" in found:
        score = score * found["objectness"][:, 0]
    keep = ~(score < threshold)
    if "count" in found:
        keep[int(found["count"].reshape(-1)[0]) :] = False
    part = {key: v[keep] for key, v in found.items() if key not in ("count", "protos")}
    boxes = part["boxes"].astype(float)
    if form.code in ("yolox", "nanodet"):
        *corner, stride = cells(size, grids(size)[things][0])[keep].T[..., None]
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
    turned = None
    if form.code in ("middle", "yolox"):
        middle, half = boxes[:, :2], boxes[:, 2:] / 2
        if "turn" in part:
            turned = np.concatenate((boxes, part["turn"]), -1)
            along, across = np.abs((np.cos(turned[:, 4:]), np.sin(turned[:, 4:])))
            half = half * along + half[:, ::-1] * across
        boxes = np.concatenate((middle - half, middle + half), -1)
    points = part.get("points")
    if points is not None:
        width = points.shape[2] if points.ndim == 3 else form.point
        shape = len(boxes), math.prod(points.shape[1:]) // width, width
        points = points.reshape(shape).astype(float)
    masks = _masks(form, found, part, boxes, size)
    return Detections(boxes, score[keep], labels[keep], points, masks, turned)


def _masks(
    form: Form, found: Outputs, part: Outputs, boxes: np.ndarray, size: Size
) -> np.ndarray | None:
    """The masks of things, as they are or of those that all things share; None without any."""
    masks: np.ndarray
    if "protos" in found:
        weights, protos = part["weights"], found["protos"]
        masks = np.tensordot(weights.astype(np.float32), protos.astype(np.float32), 1)
    elif "masks" in part:
        masks = part["masks"]
        masks = masks.reshape(len(boxes), *masks.shape[-2:]).astype(np.float32)
    else:
        return None
    scale = size[0] / masks.shape[1]
    if scale % 1 or masks.shape[2] * scale != size[1]:
        return None  # each of its box alone
    if "protos" in found or form.scores:
        masks = 1 / (1 + np.exp(-masks))
    if "protos" in found:  # they have meaning inside the box only
        x0, y0, x1, y1 = boxes.T[..., None, None] / scale - 0.5
        y, x = np.ogrid[: masks.shape[1], : masks.shape[2]]
        masks *= (x0 <= x) & (x < x1) & (y0 <= y) & (y < y1)
    return masks
