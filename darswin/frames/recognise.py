"""Which form the outputs of a detector have: by metadata, names, shapes and types."""

import ast
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from darswin.frames.forms import Form, Outputs, Pixels, Size, Where, cells, grids
from darswin.utils.parameters import check, naming

TASKS = ("detect", "pose", "obb", "segment")  # of Ultralytics
_PARTS = {"pose": ("points", "keypoints"), "obb": ("turn", "turned boxes")}
SCORES = ("softmax", "sigmoid")
_RT_DETR = "RT-DETR of Ultralytics"
_PART = 1.5  # boxes in parts of the picture end there, if they are not cut at its border
_IMAGENET = Pixels((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
_NANODET = Pixels(_IMAGENET.mean[::-1], _IMAGENET.std[::-1], "bgr")
_BYTES = Pixels(std=(1 / 255,), channels="bgr")  # from 0 to 255
# What makes probabilities of the scores of transformers, by the `model_type`.
_SOFTMAX: dict[str, Any] = dict(scores="softmax", pixels=_IMAGENET)
_SIGMOID: dict[str, Any] = dict(scores="sigmoid")
_MODELS = dict.fromkeys(("softmax", "detr", "yolos", "table-transformer"), _SOFTMAX)
_MODELS |= dict.fromkeys(("sigmoid", "rt_detr", "rt_detr_v2", "d_fine"), _SIGMOID)
_MODELS |= dict.fromkeys(
    ("conditional_detr", "dab-detr", "deformable_detr", "deta"), _SIGMOID | dict(pixels=_IMAGENET)
)
_NAMED = {
    "boxes scores labels -": Form("boxes, scores and labels", {}),
    "det_boxes det_scores det_classes num_dets": Form("EfficientNMS", {}),
    "pred_boxes pred_scores pred_classes num_predictions": Form("SuperGradients", {}),
    "detection_boxes detection_scores detection_classes num_detections": Form(
        "TensorFlow's detection API", {}, "rows", in_parts=True
    ),
}


def form_of(
    outputs: Outputs, size: Size, metadata: Mapping[str, Any],
    task: str | None = None, scores: str | None = None,
) -> Form | None:  # fmt: skip
    """The form of the outputs (B, …) for black pictures of (H, W); None if it is no detector's.

    Args:
        metadata: of the file, and of the config.json of transformers.
        task, scores: what the user says of outputs that do not tell it.

    Raises:
        ValueError: the outputs may have several forms.
    """
    own = metadata.get("task") if metadata.get("task") in TASKS else task
    check("task", task, task in (None, own), str(own))
    outputs = {name: values for name, values in outputs.items() if values.ndim < 5}  # no raw heads
    form = _named(outputs) or _typed(outputs) or _pair(outputs, size)
    form = form or _table(outputs, size, own or "", metadata)
    part, found = _PARTS.get(str(task), ("boxes", "boxes"))
    if form is not None and part not in form.where:
        text = f"`task` is {task}, but the form {form.name!r} has no {found}"
        raise naming(ValueError(text), "task")
    if form is not None and form.scores == "?":
        kind = _MODELS.get(scores or str(metadata.get("model_type")))
        if kind is None:
            of = "the scores are logits, of softmax (DETR, YOLOS) or of sigmoid (RT-DETR, D-FINE)"
            raise _question("scores", of, "put the model's config.json beside the file")
        return replace(form, **kind)
    if scores is not None:
        text = "`scores` is for the logits of transformers, so leave it out"
        raise naming(ValueError(text), "scores")
    if form is not None and form.overlaps:
        _check_scores(form, outputs)
    return form


def _check_scores(form: Form, outputs: Outputs) -> None:
    """ValueError for scores that are no probabilities, of a form whose scores are some."""
    for name, columns in (form.where[key] for key in ("scores", "objectness") if key in form.where):
        values = outputs[name].swapaxes(1, 2) if form.things_last else outputs[name]
        low, high = values[..., columns].min(), values[..., columns].max()
        if low < -0.01 or high > 1.01:
            raise ValueError(
                f"its shape is that of {form.name}, but its scores must be from 0 to 1, got "
                f"{low:.3g} to {high:.3g}: export it with its sigmoid"
            )


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


def _question(word: str, found: str, instead: str) -> ValueError:
    return naming(ValueError(f"{found}: say which by `{word}`, or {instead}"), word)


def _whole(**names: str | None) -> Where:
    return {key: (name, slice(None)) for key, name in names.items() if name}


def _columns(output: str, **widths: int) -> Where:
    """Parts that are beside each other in a table."""
    ends = np.cumsum([0, *widths.values()]).tolist()
    parts = zip(widths, ends, ends[1:], strict=False)
    return {key: (output, slice(start, end)) for key, start, end in parts if start < end}


def _named(outputs: Outputs) -> Form | None:
    low = {name.split(":")[0].lower(): name for name in outputs}
    if "detections" in low and outputs[low["detections"]].shape[2:] == (7,):
        where = _columns(low["detections"], number=1, boxes=4, scores=1, labels=1)
        return Form("EfficientDet", where, "rows")
    for words, form in _NAMED.items():
        boxes, scores, labels, count = map(low.get, words.split())
        if boxes and scores and labels:
            same = {4 * outputs[scores].size, 4 * outputs[labels].size} == {outputs[boxes].size}
            more = dict(count=count, masks=low.get("masks"), points=low.get("keypoints"))
            where = _whole(boxes=boxes, scores=scores, labels=labels, **more)
            return replace(form, where=where) if same and outputs[boxes].shape[-1] == 4 else None
    return None


def _typed(outputs: Outputs) -> Form | None:
    """Boxes (…, N, 4), scores (…, N) and integer labels (…, N), as torchvision gives them."""
    for boxes, values in outputs.items():
        *of, last = values.shape or (0,)
        same = [name for name, other in outputs.items() if other.shape == (*of,)]
        labels = [name for name in same if outputs[name].dtype.kind in "iu"]
        if last != 4 or len(of) not in (1, 2) or len(same) != 2 or len(labels) != 1:
            continue
        where = _whole(boxes=boxes, labels=labels[0], scores=({*same} - {*labels}).pop())
        for name, other in outputs.items():
            if other.dtype.kind in "iu" and other.shape in ((*of[:-1],), (*of[:-1], 1)):
                where |= _whole(count=name)
            elif other.shape[:-2] == (*of,) and other.shape[-1] == 3:
                where |= _whole(points=name)
            elif other.shape[:2] == (*of, 1)[:2] and other.ndim == 4:
                where |= _whole(masks=name)
        return Form("torchvision" if len(of) == 1 else "boxes, scores and labels", where)
    return None


def _pair(outputs: Outputs, size: Size) -> Form | None:
    """Boxes (B, N, 4) and scores (B, N, C), or boxes with scores (B, N, 5) and labels (B, N)."""
    if {"logits", "pred_boxes"} <= outputs.keys():  # and what the network has inside
        names = ("logits", "pred_boxes", "pred_masks")
        outputs = {name: outputs[name] for name in names if name in outputs}
    masks = next((name for name, values in outputs.items() if values.ndim == 4), None)
    flat = {name: values.shape for name, values in outputs.items() if name != masks}
    tables = [name for name, shape in flat.items() if shape[2:] in ((4,), (5,))]
    tables = [name for name in tables if name in ("dets", "pred_boxes")] or tables
    if len(flat) != 2 or len(tables) != 1:
        return None
    (boxes,), (other,) = tables, flat.keys() - {*tables}
    where, (*things, width) = _whole(boxes=boxes, scores=other, masks=masks), flat[boxes]
    if width == 5 and flat[other] == (*things,):
        where = _columns(boxes, boxes=4, scores=1) | _whole(labels=other, masks=masks)
        return Form("MMDeploy", where)
    if width == 5 or flat[other][:-1] != (*things,):
        return None
    if things[1] in grids(size):
        corners, scores = outputs[boxes], outputs[other]
        share = (corners[..., :2] <= corners[..., 2:]).all(-1).mean()
        are_read = share > 0.9 and scores.min() >= 0 and scores.max() <= 1
        return Form("YOLO-NAS", where, overlaps=True) if are_read else None
    if boxes == "dets":
        return Form("RF-DETR", where, "middle", True, "sigmoid", pixels=_IMAGENET)
    return Form("transformers", where, "middle", True, "?")


def _table(outputs: Outputs, size: Size, task: str, metadata: Mapping[str, Any]) -> Form | None:
    """One table, and perhaps the masks that all things share."""
    quarter = 32, size[0] // 4, size[1] // 4
    protos = [name for name, values in outputs.items() if values.shape[1:] == quarter]
    tables = [name for name in outputs if name not in protos]
    if len(tables) != 1 or len(protos) > 1:
        return None
    name, values, shape = tables[0], outputs[tables[0]], outputs[tables[0]].shape
    if shape[:2] == (1, 1) and shape[3:] == (7,) and size[0] * 7 != size[1] * shape[2]:
        return Form("SSD", _columns(name, image=1, labels=1, scores=1, boxes=4), in_parts=True)
    if shape[1:] == (7,) and not (values[:, 0] % 1).any() and _has_whole(values[:, 5:]):
        where = _columns(name, image=1, boxes=4, labels=1, scores=1)
        return Form("YOLOv7 or YOLO-NAS with NMS", where)
    if len(shape) != 3:
        return None
    (_, count, width), known, masks = shape, grids(size), 32 * len(protos)
    strides, each = known.get(count, ((), 0))
    last = count > 4 and known.get(width, ((), 0))[1] == 1
    shared = _whole(protos=protos[0] if protos else None)
    parts = 0 < values[..., :4].max(initial=0) < _PART
    if last or ((task or protos) and not each):
        task = task or "segment" * len(protos)
        form = _ultralytics(name, count if last else width, last, task, metadata, shared)
        is_decoder = metadata.get("head") == "RTDETRDecoder" or ("head" not in metadata and parts)
        if form and width == 6 and is_decoder:
            return replace(form, name=_RT_DETR, code="middle", in_parts=True)
        return form
    where = _columns(name, boxes=4, objectness=1, scores=width - 5 - masks, weights=masks) | shared
    if each and width > 5 + masks:
        if each == 3:
            return Form("YOLOv5 or YOLOv7", where, "middle", overlaps=True)
        if (values[..., 4] == 1).all():
            return Form("YOLOv6", where, "middle", overlaps=True)
        if len(strides) == 4 and width > 32:
            where = _columns(name, scores=width - 32, boxes=32)
            return Form("NanoDet-Plus", where, "nanodet", overlaps=True, pixels=_NANODET)
        x, _, side = cells(size, strides).T  # a decoded x is near that of its cell
        code = "middle" if np.corrcoef(values[0, :, 0], x * side)[0, 1] > 0.7 else "yolox"
        return Form("YOLOX", where, code, overlaps=True, pixels=_BYTES)
    if width == 6 and parts:
        found = "the boxes are parts of the picture, perhaps as of Ultralytics' RT-DETR (detect)"
        raise _question("task", found, "export corners in pixels")
    if width == 6:
        return Form("boxes, score and class", _columns(name, boxes=4, scores=1, labels=1))
    if width in (7, 57):
        kind = "turned boxes (obb)" if width == 7 else "keypoints (pose)"
        found = f"they may be {kind} of Ultralytics, or something else"
        raise _question("task", found, "keep the metadata that `yolo export` writes")
    return None


def _has_whole(columns: np.ndarray) -> bool:
    return bool((columns % 1 == 0).all(0).any())


def _ultralytics(
    name: str, total: int, last: bool, task: str, metadata: Mapping[str, Any], shared: Where
) -> Form | None:
    """The columns of a task, by the names of classes; without these, a pose has one class."""
    classes = len(names_of(metadata))
    if not task:
        rest = total - 4 - classes if classes else 0 if total == 5 else -1
        if rest not in (0, 1):
            found = (
                f"they may be boxes of {total - 4} classes (detect), "
                f"turned boxes of {total - 5} (obb), or keypoints (pose)"
            )
            raise _question("task", found, "export it by `yolo export`, which writes metadata")
        task = ("detect", "obb")[rest]
    if last:
        one = {"detect": total - 4, "obb": total - 5, "segment": total - 36, "pose": 1}[task]
        columns = dict(boxes=4, scores=classes or one)
    else:
        columns = dict(boxes=4, scores=1, labels=1)
    rest = total - sum(columns.values())
    if task == "detect" and not last and classes > 2 and rest == classes - 2:
        where = _columns(name, boxes=4, scores=classes)
        return Form(_RT_DETR, where, "middle", in_parts=True)
    point = 2 if rest % 3 else 3
    if "kpt_shape" in metadata:
        point = ast.literal_eval(str(metadata["kpt_shape"]))[1]
    more: dict[str, int] = {"obb": {"turn": 1}, "segment": {"weights": 32}}.get(task, {})
    if task == "pose" and rest % point == 0:
        more = {"points": rest}
    if sum(more.values()) != rest or min(columns.values()) < 1:
        return None
    where = _columns(name, **columns, **more) | shared
    code = "middle" if last or task == "obb" else "corners"
    return Form(f"Ultralytics {task}", where, code, things_last=last, overlaps=last, point=point)
