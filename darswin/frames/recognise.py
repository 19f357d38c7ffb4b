"""Which form the outputs of a detector have: by names, shapes, types, ranges and metadata."""

import ast
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from darswin.frames.forms import RGB, Form, Outputs, Pixels, Size, Where, cells, grids, orders_of
from darswin.utils.parameters import check, naming
from darswin.utils.tasks import DETECTOR_TASKS

FORMS = (
    *DETECTOR_TASKS, "rtdetr", "yolov5", "yolov6", "yolox", "nanodet", "rfdetr", "softmax",
    "sigmoid", "boxes", "table", "flat", "tensorflow", "mmdeploy", "efficientdet", "ssd", "numbers",
)  # fmt: skip
_IMAGENET = Pixels((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_NANODET = Pixels(_IMAGENET.mean[::-1], _IMAGENET.std[::-1], "bgr")
_BYTES = Pixels(std=(1 / 255,), channels="bgr")  # from 0 to 255
# What makes probabilities of the logits of transformers, and the pixels, by the `model_type`.
_MODELS = dict.fromkeys(("detr", "yolos", "table-transformer"), ("softmax", _IMAGENET))
_MODELS |= dict.fromkeys(("rt_detr", "rt_detr_v2", "d_fine"), ("sigmoid", RGB))
_MODELS |= dict.fromkeys(
    ("conditional_detr", "dab-detr", "deformable_detr", "deta"), ("sigmoid", _IMAGENET)
)
# The words in the names of outputs.
_BOX, _SCORE, _LABEL = ("box", "det"), ("score", "conf", "prob", "logit"), ("label", "class", "cls")
_POINT, _COUNT = ("keypoint", "kpt"), ("num", "valid_det", "count")
_PART = 1.5  # boxes in parts of the picture end there, if they are not cut at its border
_MOST = 1000  # boxes, of which none shows a thing that another one shows
# How sure a form is: by all that is there, one of several that fit, or only if it is asked for.
SURE, PERHAPS, ASKED = 2, 1, 0
Candidates = Iterator[tuple[int, Form]]


@dataclass(frozen=True)
class Network:
    """What is known of a network.

    Attributes:
        outputs: (B, …) of black pictures. size: (H, W) of these.
        metadata: of the file, and of the config.json of transformers.
        classes: how many have names, with all before the last one; 0 if it is not known.
        batched: the outputs whose first axis counts the pictures, as the graph says.
    """

    outputs: Outputs
    size: Size
    metadata: Mapping[str, Any]
    classes: int
    batched: Collection[str]

    @property
    def task(self) -> str | None:
        """That of Ultralytics."""
        return task if (task := self.metadata.get("task")) in DETECTOR_TASKS else None


def form_of(network: Network, word: str | None = None) -> Form | None:
    """The form of the outputs of a network, or None if it is no detector.

    Args:
        word: one of `FORMS`, which the user says.

    Raises:
        ValueError: the outputs may have several forms, or not the one that the user says.
    """
    fitting = [] if word == "numbers" else [*_separate(network), *_tables(network)]
    best = max((how for how, _ in fitting), default=ASKED)
    forms = [form for how, form in fitting if word or how == best > ASKED]
    words = [*dict.fromkeys(form.name for form in forms)]
    if not words or all(values.ndim < 3 for values in network.outputs.values()):
        words.append("numbers")
    if word in FORMS[:-1]:
        check("form", word, word in words, f"one that its outputs may have, {' or '.join(words)}")
        forms = [form for form in forms if form.name == word]
    elif best == PERHAPS:
        text = f"their form may be {' or '.join(words)}: say which by `form`, or keep what tells "
        text += "it: the task and names of Ultralytics, or the config of transformers"
        raise naming(ValueError(text), "form")
    for form in forms[:1]:
        count = network.outputs[form.where["boxes"][0]].shape[-1 if form.things_last else -2]
        is_raw = not form.scores and (count in grids(network.size) or count > _MOST)
        return replace(form, overlaps=is_raw and "count" not in form.where)
    return None


def unused(form: Form, outputs: Collection[str]) -> list[str]:
    """The outputs that the form does not read."""
    return [name for name in outputs if name not in {of for of, _ in form.where.values()}]


def names_of(metadata: Mapping[str, Any]) -> dict[int, str]:
    """The names of classes in metadata, by their numbers."""
    names = metadata.get("names", metadata.get("id2label", {}))
    try:
        names = ast.literal_eval(names) if isinstance(names, str) else names
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        return {int(number): str(name) for number, name in pairs}
    except (ValueError, TypeError, SyntaxError):
        return {}


def imgsz_of(metadata: Mapping[str, Any]) -> tuple[int, int] | None:
    """The (H, W) in the metadata of Ultralytics, which graphs of any size have too."""
    found = re.fullmatch(r"\[(\d+), (\d+)\]", str(metadata.get("imgsz")))
    return (int(found[1]), int(found[2])) if found else None


def counts_in(outputs: Mapping[str, Any], pictures: int) -> Any | None:
    """The output that tells how many rows of each picture are things, by its name; or None."""
    counts = (of for name, of in outputs.items() if _says(name, *_COUNT))
    return next((of for of in counts if math.prod(of.shape) == pictures), None)


def _whole(**names: str | None) -> Where:
    return {key: (name, slice(None)) for key, name in names.items() if name}


def _columns(output: str, **widths: int) -> Where:
    """Parts that are beside each other in a table."""
    ends = np.cumsum([0, *widths.values()]).tolist()
    parts = zip(widths, ends, ends[1:], strict=False)
    return {key: (output, slice(start, end)) for key, start, end in parts if start < end}


def _says(name: str, *words: str) -> bool:
    """Whether an output has one of these words in its name."""
    return any(word in name.lower() for word in words)


def _one(names: Collection[str], *words: str) -> str | None:
    """The only output that has one of these words in its name; or the only one, if none has."""
    named = [name for name in names if _says(name, *words)] or [*names]
    return named[0] if len(named) == 1 else None


def _are_corners(boxes: np.ndarray) -> bool:
    return not boxes.size or bool((boxes[..., :2] <= boxes[..., 2:4]).all(-1).mean() > 0.9)


def _are_whole(values: np.ndarray) -> bool:
    return not (values % 1).any()


def _are_scores(values: np.ndarray) -> bool:
    """Whether they are from 0 to 1, also if 16 bits round them; NaN and infinity are told later."""
    finite = values[np.isfinite(values)]
    return finite.min(initial=0) > -0.01 and finite.max(initial=0) < 1.01


def _separate(network: Network) -> Candidates:
    """Boxes (B, N, 4), scores (B, N) or (B, N, C), and labels (B, N); or the same without B."""
    outputs = network.outputs
    for boxes in sorted(outputs, key=lambda name: not _says(name, *_BOX)):
        *of, width = outputs[boxes].shape or (0,)
        if width not in (4, 5) or len(of) not in (1, 2) or _says(boxes, *_SCORE):
            continue
        more = _beside(network, of, boxes)
        rest = [
            name for name in outputs if name not in {boxes, *(read for read, _ in more.values())}
        ]
        flat = [name for name in rest if outputs[name].shape in ((*of,), (*of, 1))]
        whole = [name for name in flat if outputs[name].dtype.kind in "iu"]
        named = [name for name in flat if _says(name, *_LABEL) and not _says(name, *_SCORE)]
        labels = _one(named or whole)
        scores = _one([name for name in flat if name not in (labels, *whole)], *_SCORE)
        where = _whole(boxes=boxes, scores=scores, labels=labels) | more
        wide = [name for name in rest if outputs[name].shape[:-1] == (*of,)]
        if width == 5:
            if len(of) == 2 and (flat or "points" in more) and flat in ([], [labels]):
                where = _columns(boxes, boxes=4, scores=1) | _whole(labels=labels) | more
                yield SURE, Form("mmdeploy", where)
        elif labels and scores:
            is_sure = len(of) == 2 or boxes not in network.batched or _says(boxes, *_BOX)
            if boxes.lower().split(":")[0] == "detection_boxes":
                yield SURE, Form("tensorflow", where, "rows")
            elif is_sure or _are_corners(outputs[boxes]):
                yield SURE if is_sure else PERHAPS, Form("boxes", where)
        elif len(of) == 2 and (scores := _one(wide, *_SCORE, *_LABEL)):
            yield from _by_class(network, boxes, scores, more)


def _by_class(network: Network, boxes: str, scores: str, more: Where) -> Candidates:
    """Boxes (B, N, 4) and scores of each class (B, N, C)."""
    where, values = _whole(boxes=boxes, scores=scores) | more, network.outputs[scores]
    is_named = boxes in ("dets", "pred_boxes")
    if not is_named and _are_scores(values):
        if _are_corners(network.outputs[boxes]):
            yield SURE, Form("boxes", where)
    elif is_named or values.shape[1] not in grids(network.size):
        # A column more than there are classes is for nothing.
        is_more = values.shape[2] == network.classes + 1 > 1
        known = where | {"scores": (scores, slice(0, network.classes))} if is_more else where
        middle: dict[str, Any] = dict(code="middle", in_parts=True)
        if boxes != "pred_boxes":
            form = Form("rfdetr", known, scores="sigmoid", pixels=_IMAGENET, **middle)
            yield SURE if is_named else PERHAPS, form
        kind, pixels = _MODELS.get(str(network.metadata.get("model_type")), (None, RGB))
        usual = ASKED if boxes == "dets" else PERHAPS
        form = Form("softmax", where, scores="softmax", pixels=_IMAGENET, **middle)
        yield SURE if kind == "softmax" else usual, form
        form = Form("sigmoid", known, scores="sigmoid", pixels=pixels, **middle)
        yield SURE if kind == "sigmoid" else usual, form


def _beside(network: Network, of: Sequence[int], boxes: str) -> Where:
    """Masks, keypoints and the number of things beside boxes (…, N, 4); `of` is (…, N)."""
    (height, width), parts = network.size, dict[str, str]()
    for name, values in network.outputs.items():
        rest, same = values.shape[len(of) :], values.shape[: len(of)] == (*of,)
        if _says(name, *_COUNT) or (values.dtype.kind in "iu" and not same):
            if values.size == math.prod(of[:-1]):
                parts["count"] = name
        elif not same or name == boxes:
            continue
        elif len(rest) == 1 and _says(name, *_POINT) and _says(name, *_SCORE):
            parts["point_scores"] = name
        elif len(rest) == 2 and rest[1] in (2, 3):
            parts["points"] = name
        elif len(rest) in (2, 3) and rest[-3:-2] in ((), (1,)):
            is_square = rest[-2] in (rest[-1], rest[-1] * height / width)
            parts |= {"masks": name} if is_square or _says(name, "mask") else {}
    if "points" not in parts or network.outputs[parts["points"]].shape[-1] != 2:
        parts.pop("point_scores", None)
    return _whole(**parts)


def _tables(network: Network) -> Candidates:
    """One table, and perhaps the masks (B, M, H/4, W/4) that all things share."""
    outputs, quarter = network.outputs, (network.size[0] // 4, network.size[1] // 4)
    count = _one([name for name in outputs if _says(name, *_COUNT) and outputs[name].ndim < 3])
    protos = _one([name for name, values in outputs.items() if values.shape[2:] == quarter])
    name = _one(
        [name for name in outputs if outputs[name].ndim < 5 and name not in (count, protos)]
    )
    for shared in dict.fromkeys((protos, None)) if name else ():  # or it is another map
        yield from _table(network, str(name), shared, _whole(protos=shared, count=count))


def _table(network: Network, name: str, protos: str | None, more: Where) -> Candidates:
    outputs, size = network.outputs, network.size
    values, shape = outputs[name], outputs[name].shape
    if shape[:2] == (1, 1) and shape[3:] == (7,) and size[0] * 7 != size[1] * shape[2]:
        yield SURE, Form("ssd", _columns(name, image=1, labels=1, scores=1, boxes=4))
    is_flat = shape[1:] == (7,) and _are_whole(values[:, 0]) and _are_corners(values[:, 1:])
    if is_flat and orders_of(values[:, 5:]):
        where = _columns(name, image=1, boxes=4, scores=1, labels=1)
        is_sure = name not in network.batched or not len(values)
        yield SURE if is_sure else PERHAPS, Form("flat", where | {"either": (name, slice(5, 7))})
    if len(shape) != 3 or shape[1:] == size or values.dtype.kind != "f":  # or a map
        return
    masks, (_, count_of, width) = outputs[protos].shape[1] if protos else 0, shape
    strides, each = grids(size).get(count_of, ((), 0))
    if count_of > 4 and grids(size).get(width, ((), 0))[1] == 1:
        yield from _ultralytics(network, name, count_of, True, masks, more)
    elif not each or (width == 6 and _has_class(values)):
        yield from _final(network, name, masks, more)
    elif width > 5 + masks:
        where = _columns(name, boxes=4, objectness=1, scores=width - 5 - masks, weights=masks)
        where |= more
        x, _, side = cells(size, strides).T
        if each == 3:
            yield SURE, Form("yolov5", where, "middle")
        elif (values[..., 4] == 1).all():
            yield SURE, Form("yolov6", where, "middle")
        elif len(strides) == 4 and width > 32:
            where = _columns(name, scores=width - 32, boxes=32)
            yield SURE, Form("nanodet", where, "nanodet", False, pixels=_NANODET)
        elif np.corrcoef(values[0, :, 0], x * side)[0, 1] > 0.7:  # x is near that of its cell
            yield SURE, Form("yolox", where, "middle", pixels=_BYTES)
        else:
            yield SURE, Form("yolox", where, "yolox", False, pixels=_BYTES)


def _has_class(values: np.ndarray) -> bool:
    """Whether the last of 6 columns is a class, not a probability, which 16 bits make 1."""
    label = values[..., 5]
    return _are_whole(label) and (not label.any() or _are_corners(values))


def _final(network: Network, name: str, masks: int, more: Where) -> Candidates:
    """Rows (B, N, …) of which each is one thing, or all cells."""
    values, task, head = network.outputs[name], network.task, network.metadata.get("head")
    width = values.shape[2]
    in_parts = 0 < values[..., :4].max(initial=0) <= _PART and values.min(initial=0) > -_PART
    ends = _are_scores(values[..., 4]) and _are_whole(values[..., 5]) if width > 5 else False
    has_class = width == 6 and ends
    in_parts &= has_class or _are_scores(values[..., 4:])
    is_rtdetr = in_parts if head is None else head == "RTDETRDecoder"
    for how, form in _ultralytics(network, name, width, False, masks, more):
        yield how if ends and not (form.name == "detect" and is_rtdetr) else ASKED, form
    if width > 4 and not masks and task in (None, "detect"):
        columns = dict(scores=1, labels=1) if has_class else dict(scores=width - 4)
        fits = has_class or width - 4 == network.classes
        is_sure = task and fits and (is_rtdetr or width != 6)
        how = SURE if is_sure else PERHAPS if in_parts and task is None else ASKED
        yield how, Form("rtdetr", _columns(name, boxes=4, **columns) | more, "middle", True)
    if width == 6 and not masks:
        where = _columns(name, boxes=4, scores=1, labels=1) | more
        how = PERHAPS if in_parts else SURE
        yield how if ends else ASKED, Form("table", where)
    if width == 7 and not masks:
        where = _columns(name, number=1, boxes=4, scores=1, labels=1) | more
        how = PERHAPS if _are_scores(values[..., 5]) and _are_whole(values[..., 6]) else ASKED
        yield SURE if _says(name, "detections") else how, Form("efficientdet", where, "rows")


def _ultralytics(
    network: Network, name: str, total: int, last: bool, masks: int, more: Where
) -> Candidates:
    """Each task whose columns these may be, by the number of classes if it is known."""
    own, shape = network.task, ast.literal_eval(str(network.metadata.get("kpt_shape")))
    for classes in (network.classes, 0):
        forms = []
        for task in (own,) if own else DETECTOR_TASKS:
            beside = {"obb": 1, "segment": masks}.get(task, 0)
            scores = (classes or (1 if task == "pose" else total - 4 - beside)) if last else 1
            columns = dict(boxes=4, scores=scores) | ({} if last else dict(labels=1))
            rest = total - sum(columns.values())
            point = shape[1] if shape else 2 if rest % 3 else 3
            if task == "pose":
                beside = rest if rest > 0 and rest % point == 0 else -1
            if scores > 0 and rest == beside and (task == "segment") == (masks > 0):
                key = {"pose": "points", "obb": "turn", "segment": "weights"}.get(task)
                where = _columns(name, **columns, **({key: rest} if key else {})) | more
                code = "middle" if last or task == "obb" else "corners"
                forms.append(Form(task, where, code, things_last=last, point=point))
        if forms:
            break
    is_usual = last or masks or total in (7, 57)  # or else they ask for any table
    has_weights = masks and (network.outputs[name] < 0).any()  # as no probabilities are
    is_sure = own or (len(forms) == 1 and (has_weights if masks else last))
    yield from ((SURE if is_sure else PERHAPS if is_usual else ASKED, form) for form in forms)
