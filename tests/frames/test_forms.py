"""Every public form of a detector's outputs: twelve known boxes are found, or a question is asked.

Each form is written here as its exporter writes it, without the code that reads it.
"""

import itertools
import json
import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import refused, slow_but
from torch import nn
from torch.utils import _pytree as pytree

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from graphs import write_detector

from darswin.boxes import Instances
from darswin.frames.forms import decode
from darswin.frames.onnx import OnnxNetwork
from darswin.frames.recognise import Network, form_of
from darswin.lens import Spherical
from darswin.models import LensAdapter
from darswin.views import make_view

pytestmark = pytest.mark.unsanitized  # nothing of it is compiled

SIZE = HEIGHT, WIDTH = 160, 224
K = 12
RANDOM = np.random.default_rng(5)
X, Y = np.array([(24 + 48 * (k % 4), 24 + 48 * (k // 4)) for k in range(K)]).T
MIDDLE = np.stack((X, Y), 1) + RANDOM.uniform(-3, 3, (K, 2))
SIDES = RANDOM.uniform(14, 40, (K, 2))
BOXES = np.concatenate((MIDDLE - SIDES / 2, MIDDLE + SIDES / 2), 1)
CENTRED = np.concatenate((MIDDLE, SIDES), 1)
SCORES = np.linspace(0.95, 0.4, K)
LABELS = 3 + RANDOM.permutation(K)
NAMES = {k: f"class {k}" for k in range(80)}
POINTS = np.concatenate((MIDDLE[:, None] + RANDOM.uniform(-20, 20, (K, 17, 2)),
                         RANDOM.uniform(0, 1, (K, 17, 1))), 2)  # fmt: skip
ANGLES = RANDOM.uniform(-math.pi / 4, 3 * math.pi / 4, (K, 1))
ACROSS = np.array([WIDTH, HEIGHT] * 2)
YX = [1, 0, 3, 2]


def one_hot(classes, high=SCORES, low=0.01, labels=LABELS):
    found = np.full((K, classes), low)
    found[np.arange(K), labels] = high
    return found


def logit(p):
    return np.log(p / (1 - p))


def priors(*strides):
    return np.array([
        (x, y, s) for s in strides
        for y, x in itertools.product(range(-(-HEIGHT // s)), range(-(-WIDTH // s)))
    ])  # fmt: skip


def dense(rows, of_cell, strides=(8, 16, 32), each=1):
    """The rows of things in the cells of grids, in which all others are `of_cell(x, y, s)`."""
    cells = np.array([of_cell(*cell) for cell in priors(*strides)], float)
    cells = np.concatenate([cells] * each)
    cells[places(rows, strides, each)] = rows
    return cells


def places(rows, strides=(8, 16, 32), each=1):
    return np.linspace(5, each * len(priors(*strides)) - 9, len(rows)).astype(int)


def beside(*parts):
    return np.concatenate([np.reshape(part, (K, -1)) for part in parts], 1)


def cell_row(width, *, first=()):
    rest = [*first, *[0.01] * (width - len(first))]
    return lambda x, y, s: [(x + 0.5) * s, (y + 0.5) * s, s, s, *rest]


def yolo(rows):
    """Ultralytics' outputs: cells last."""
    return dense(rows, cell_row(rows.shape[1] - 4)).T


def yolox(decoded):
    rows = beside(CENTRED, np.full(K, 0.98), one_hot(80, SCORES / 0.98))
    if decoded:
        return dense(rows, cell_row(81, first=(0.01,)))
    cells = dense(rows, lambda x, y, s: [0.5, 0.4, 0, 0, 0.01, *[0.01] * 80])
    x, y, s = priors(8, 16, 32)[places(rows)].T[..., None]
    cells[places(rows), :4] = np.hstack((MIDDLE / s - np.hstack((x, y)), np.log(SIDES / s)))
    return cells + np.sin(np.arange(85) + np.arange(len(cells))[:, None]) * [1e-7]


def nanodet():
    """A distance is the mean of two bins: 8 bins, of which two have the weight."""
    cells = dense(np.zeros((K, 112)), lambda x, y, s: [0.01] * 80 + [0.1] * 32, (8, 16, 32, 64))
    strides = priors(8, 16, 32, 64)
    near = [np.abs(strides[:, :2] * strides[:, 2:] - m).max(1) + 100 * (strides[:, 2] != 8)
            for m in MIDDLE]  # fmt: skip
    for k, distances in enumerate(near):
        at = int(np.argmin(distances))
        x, y, s = strides[at]
        x0, y0, x1, y1 = BOXES[k]
        for side, length in enumerate((x * s - x0, y * s - y0, x1 - x * s, y1 - y * s)):
            low, part = divmod(length / s, 1)
            share = np.full(8, 1e-9)
            share[int(low)], share[int(low) + 1] = 1 - part, max(part, 1e-9)
            cells[at, 80 + 8 * side : 88 + 8 * side] = np.log(share)
        cells[at, :80] = one_hot(80)[k]
    return cells


def protos(count=32):
    """A mask for each thing, of its box and half a pixel more, and others."""
    y, x = np.mgrid[: HEIGHT // 4, : WIDTH // 4] * 4 + 2
    masks = np.full((count, HEIGHT // 4, WIDTH // 4), -8.0)
    for k, (x0, y0, x1, y1) in enumerate(BOXES):
        masks[k][(x > x0 - 9) & (x < x1 - 5) & (y > y0) & (y < y1 + 9)] = 8
    return masks


WEIGHTS = -np.eye(K, 64)
UPPER = np.zeros((K, 28, 28))  # the upper half of each box
UPPER[:, :14] = 1
IN_PARTS, CENTRED_PARTS = BOXES / ACROSS, CENTRED / ACROSS


def full(rows, to=300):
    """A table of K things, and nothing in the rest, as networks fill it up."""
    return np.concatenate((rows, np.zeros((to - K, *rows.shape[1:]))))


ULTRA = dict(names=NAMES, author="Ultralytics", imgsz=[*SIZE])
SOFTMAX_ = np.log(np.column_stack((one_hot(91, low=1e-9), 1 - SCORES - 90e-9)))
POSE = ULTRA | dict(task="pose", kpt_shape=[17, 3], names={0: "person"})
ROWS = beside(BOXES, SCORES, LABELS)


def of(task):
    return dict(metadata=ULTRA | dict(task=task))


def row(values, *more):
    return beside(np.arange(K) * 0, values, *more)


# Each form: its outputs without their batch, and how the network is written and read.
FORMS = {
    "own": (dict(boxes=full(BOXES), scores=full(SCORES), labels=full(LABELS).astype(int)), {}),
    "own, one masked": (dict(boxes=BOXES, scores=SCORES, labels=LABELS * 1.0), {}),
    "own, by other names, in parts": (
        dict(bboxes=full(IN_PARTS), class_idx=full(LABELS).astype(int), conf=full(SCORES)), {},
    ),
    "own, of all cells": (
        dict(boxes=full(BOXES, 735), scores=full(SCORES, 735),
             class_ids=full(LABELS, 735).astype(int)), {},
    ),
    "own, counted, with keypoints": (
        dict(num_dets=np.array([K]), boxes=full(BOXES), scores=np.r_[SCORES, np.full(288, 0.99)],
             labels=full(LABELS).astype(int), keypoints=full(POINTS)), {},
    ),
    "table": (dict(out=full(ROWS)), {}),
    "table beside a map": (dict(out=full(ROWS), features=np.zeros((8, 40, 56))), {}),
    "table in parts": (dict(out=full(beside(IN_PARTS, SCORES, LABELS))), dict(form="table")),
    "table of all cells": (dict(out=full(ROWS, 735)), {}),
    "detect": (dict(output0=yolo(beside(CENTRED, one_hot(80)))), of("detect")),
    "detect without task": (
        dict(output0=yolo(beside(CENTRED, one_hot(80)))),
        dict(metadata={"names": [*NAMES.values()]}),
    ),
    "detect beside a map": (
        dict(output0=yolo(beside(CENTRED, one_hot(80))), features=np.zeros((8, 40, 56))),
        of("detect"),
    ),
    "detect of 51": (dict(output0=yolo(beside(CENTRED, one_hot(51)))), dict(form="detect")),
    "segment": (
        dict(output0=yolo(beside(CENTRED, one_hot(80), WEIGHTS)), output1=-protos(64)),
        of("segment"),
    ),
    "pose": (dict(output0=yolo(beside(CENTRED, SCORES, POINTS))), dict(metadata=POSE)),
    "pose of 2": (
        dict(output0=yolo(beside(CENTRED, SCORES, POINTS[..., :2]))),
        dict(metadata=POSE | {"kpt_shape": [17, 2]}),
    ),
    "obb": (dict(output0=yolo(beside(CENTRED, one_hot(80), ANGLES))), of("obb")),
    "detect, end to end": (dict(output0=full(ROWS)), of("detect")),
    "segment, end to end": (
        dict(output0=full(beside(ROWS, WEIGHTS[:, :16])), output1=-protos(16)), of("segment"),
    ),
    "pose, end to end": (
        dict(output0=full(beside(BOXES, SCORES, 0 * X, POINTS))), dict(metadata=POSE),
    ),
    "obb, end to end": (dict(output0=full(beside(CENTRED, SCORES, LABELS, ANGLES))), of("obb")),
    "RT-DETR of Ultralytics": (
        dict(output0=full(beside(CENTRED_PARTS, one_hot(80)))), of("detect"),
    ),
    "RT-DETR of Ultralytics, the best": (
        dict(output0=full(beside(CENTRED_PARTS, SCORES, LABELS))),
        dict(metadata=ULTRA | {"task": "detect", "head": "RTDETRDecoder"}),
    ),
    "RT-DETR of Ultralytics, older": (
        dict(output0=full(beside(CENTRED_PARTS, SCORES, LABELS))), of("detect"),
    ),
    "RT-DETR of Ultralytics, 2 classes": (
        dict(output0=beside(CENTRED_PARTS, one_hot(2, labels=LABELS % 2))),
        dict(metadata=ULTRA | {"task": "detect", "names": ["a", "b"]}),
    ),
    "RT-DETR of Ultralytics, one class": (
        dict(output0=beside(CENTRED_PARTS, SCORES)),
        dict(metadata=ULTRA | {"task": "detect", "names": ["a"]}),
    ),
    "YOLOv5": (
        dict(output=dense(beside(CENTRED, np.full(K, 0.98), one_hot(80, SCORES / 0.98)),
                          cell_row(81, first=(0.01,)), each=3),
             head=np.zeros((3, 20, 28, 85))), dict(metadata=dict(stride=32, names=NAMES)),
    ),
    "YOLOv5 P6": (
        dict(output=dense(beside(CENTRED, np.full(K, 0.98), one_hot(80, SCORES / 0.98)),
                          cell_row(81, first=(0.01,)), (8, 16, 32, 64), 3)), {},
    ),
    "YOLOv5 of one class": (
        dict(output=dense(beside(CENTRED, SCORES, np.ones(K)),  # as 16 bits round it
                          cell_row(2, first=(0.01, 1)), each=3)), {},
    ),
    "YOLOv5 segment": (
        dict(output0=dense(beside(CENTRED, np.full(K, 0.98), one_hot(80, SCORES / 0.98),
                                  WEIGHTS[:, :32]),
                           cell_row(113, first=(0.01,)), each=3), output1=-protos()), {},
    ),
    "YOLOv6": (
        dict(outputs=dense(beside(CENTRED, np.ones(K), one_hot(80)), cell_row(81, first=(1,)))), {},
    ),
    "YOLOX": (dict(output=yolox(False)), {}),
    "YOLOX, decoded": (dict(output=yolox(True)), {}),
    "NanoDet-Plus": (dict(output=nanodet()), {}),
    "RF-DETR": (
        dict(dets=full(CENTRED_PARTS),
             labels=full(logit(one_hot(91))) - 9 * (np.arange(300)[:, None] >= K)), {},
    ),
    "RF-DETR segment": (
        dict(dets=CENTRED_PARTS, labels=logit(one_hot(91)), masks=protos()[:K]), {},
    ),
    "RF-DETR with a column for nothing, and keypoints": (
        dict(dets=CENTRED_PARTS, labels=np.hstack((logit(one_hot(80)), np.full((K, 1), 9.0))),
             keypoints=np.concatenate((POINTS[..., :2] / SIZE[::-1], POINTS[..., 2:]), 2)),
        dict(metadata={"names": NAMES}),
    ),
    "RT-DETR": (dict(labels=LABELS, boxes=IN_PARTS, scores=SCORES), dict(sized="boxes")),
    "DETR": (dict(logits=SOFTMAX_, pred_boxes=CENTRED_PARTS), dict(model_type="detr", masked=True)),
    "DETR, told": (
        dict(logits=SOFTMAX_, pred_boxes=CENTRED_PARTS, last_hidden_state=np.zeros((K, 256))),
        dict(form="softmax"),
    ),
    "D-FINE of transformers": (
        dict(logits=logit(one_hot(80)), pred_boxes=CENTRED_PARTS), dict(model_type="d_fine"),
    ),
    "TensorFlow with masks of boxes, and keypoints": (
        {"detection_boxes:0": IN_PARTS[:, YX], "detection_scores:0": SCORES,
         "detection_classes:0": LABELS * 1.0, "num_detections:0": np.array(K * 1.0),
         "detection_masks": UPPER, "detection_keypoint_scores": POINTS[..., 2],
         "detection_keypoints": POINTS[..., 1::-1] / SIZE, "raw_detection_boxes": IN_PARTS}, {},
    ),
    "EfficientDet": (dict(detections=row(BOXES[:, YX], SCORES, LABELS)), {}),
    "MMDeploy": (dict(dets=beside(BOXES, SCORES), labels=LABELS), {}),
    "MMDeploy with masks of boxes": (
        dict(dets=beside(BOXES, SCORES), labels=LABELS, masks=UPPER), {},
    ),
    "MMPose with keypoints, one class": (dict(dets=beside(BOXES, SCORES), keypoints=POINTS), {}),
    "EfficientNMS": (
        dict(num_dets=np.array([K]), det_boxes=full(BOXES, 100),
             det_scores=full(SCORES, 100) - (np.arange(100) >= K),
             det_classes=full(LABELS, 100).astype(int)), {},
    ),
    "YOLO-NAS": (
        dict(boxes=dense(BOXES, lambda x, y, s: (x * s, y * s, x * s + s, y * s + s)),
             scores=dense(one_hot(80), lambda *_: [0.01] * 80)), {},
    ),
    "YOLO-NAS with NMS": (
        dict(num_predictions=np.array([K]), pred_boxes=BOXES, pred_scores=SCORES,
             pred_classes=LABELS), {},
    ),
}  # fmt: skip
# Those of all pictures in one table, or of one picture without a batch.
FLAT = {
    "YOLOv7, end to end": (dict(output=row(BOXES, LABELS, SCORES)), {}),
    "YOLO-NAS, flat": (dict(graph2_flat_predictions=row(BOXES, SCORES, LABELS)), {}),
    "SSD": (dict(detection_out=row(LABELS, SCORES, IN_PARTS)[None, None]), {}),
    "torchvision": ({"1": BOXES, "2": LABELS, "3": SCORES}, {}),
    "torchvision masks": (
        {"1": BOXES, "2": LABELS, "3": SCORES,
         "4": (protos()[:K].repeat(4, 1).repeat(4, 2) > 0)[:, None] * 1.0}, {},
    ),
    "torchvision keypoints": (
        {"1": BOXES, "2": LABELS, "3": SCORES, "4": POINTS, "5": np.zeros((K, 17))}, {},
    ),
}  # fmt: skip
# What is only known by names, metadata or a word, so that it is asked for without them.
ASKED = {
    "own, one masked", "table in parts", "detect", "detect beside a map", "detect without task",
    "detect of 51", "pose", "pose of 2", "obb", "pose, end to end", "obb, end to end",
    "RT-DETR of Ultralytics", "RT-DETR of Ultralytics, 2 classes",
    "RT-DETR of Ultralytics, one class", "RT-DETR of Ultralytics, the best",
    "RT-DETR of Ultralytics, older", "RF-DETR", "RF-DETR segment",
    "RF-DETR with a column for nothing, and keypoints", "DETR", "DETR, told", "EfficientDet",
    "D-FINE of transformers", "TensorFlow with masks of boxes, and keypoints",
}  # fmt: skip
ALL = FORMS | FLAT


def written(folder, form, dtype=np.float32, batch=1, renamed=False):
    """The network of a form, and the words that it needs."""
    outputs, how = ALL[form]
    how = dict(how)
    words = {"form": how.pop("form", None)}
    if "model_type" in how:
        config = dict(model_type=how.pop("model_type"), id2label=NAMES)
        (folder / "config.json").write_text(json.dumps(config))
    if renamed:
        names = dict(zip(outputs, "abcdefgh", strict=False))
        outputs = {names[name]: value for name, value in outputs.items()}
        how["sized"] = names.get(how.get("sized"))
        how.pop("metadata", None)
        words = {}
    given = {}
    for name, value in outputs.items():
        value = np.asarray(value)
        value = value.astype(np.int64 if value.dtype.kind == "i" else dtype)
        given[name] = value if form in FLAT else value[None]
    path = write_detector(folder / "n.onnx", SIZE, given, batch=batch, **how)
    return path, {key: word for key, word in words.items() if word}


def check_known(form, found, *, px=1e-3, in_scores=1e-4, within=2e-3):
    order = np.argsort(-found.scores)
    turned = "obb" in form
    labels = LABELS % 2 if "2 classes" in form else LABELS
    labels = 0 * LABELS if "pose" in form or "one class" in form else labels
    expected = np.concatenate((CENTRED, ANGLES), 1) if turned else BOXES
    np.testing.assert_allclose(found.boxes[order], expected, atol=px)
    np.testing.assert_allclose(found.scores[order], SCORES, atol=in_scores)
    assert found.labels[order].tolist() == labels.tolist()
    assert (found.keypoints is None) != ("pose" in form or "keypoints" in form)
    if found.keypoints is not None:
        numbers = found.keypoints.shape[2]
        assert numbers == (2 if form == "pose of 2" else 3)
        np.testing.assert_allclose(found.keypoints[order], POINTS[..., :numbers], atol=px)
    assert (found.masks is None) != ("segment" in form or "masks" in form)
    if "masks of boxes" in form:
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        for mask, (x0, y0, x1, y1) in zip(found.masks[order], BOXES, strict=True):
            upper = (x > x0) & (x < x1) & (y > y0) & (y < (y0 + y1) / 2)
            assert ((mask > 0.5) != upper).sum() < 0.08 * upper.sum()
    elif found.masks is not None:
        for mask, box, known in zip(found.masks[order], found.boxes[order], protos(), strict=False):
            scale = HEIGHT // mask.shape[0]
            y, x = np.mgrid[: mask.shape[0], : mask.shape[1]] * scale + scale / 2
            inside = (x >= box[0]) & (x < box[2]) & (y >= box[1]) & (y < box[3])
            known = known.repeat(4 // scale, 0).repeat(4 // scale, 1) > 0
            is_cut = "DETR" not in form and "torchvision" not in form  # to their boxes
            assert ((mask > 0.5) == (known & inside if is_cut else known)).all()


@pytest.mark.parametrize(
    ("form", "dtype"),
    slow_but(
        itertools.product(ALL, [np.float32, np.float16]),
        *((form, np.float32) for form in ALL),
        *((form, np.float16) for form in [*ALL][::5]),
    ),
)
def test_every_form_is_found(tmp_path, form, dtype):
    near = {} if dtype == np.float32 else dict(px=0.3, in_scores=2e-3)
    for batch in (1,) if form in FLAT else (1, "B"):
        path, words = written(tmp_path, form, dtype, batch)
        network = OnnxNetwork(path, count=2, threshold=0.3, **words)
        assert network.kind == "detections" and network.batch == (2 if batch == "B" else 1)
        found = network(np.zeros((3, 3, *SIZE), np.float32))
        assert len(found) == 3
        for one in found:
            check_known(form, one, **near)


class Returns(nn.Module):
    """A network with these results, and attributes that tell what it is."""

    def __init__(self, results, told):
        super().__init__()
        self.results = results
        vars(self).update(told)

    def forward(self, pictures):
        of_each = partial(expanded, count=len(pictures))
        return pytree.tree_map_only(torch.Tensor, of_each, self.results)


def expanded(of, count):
    return of.expand(count, *of.shape[1:])


def by_adapter(results, told=None, view="none", **options):
    """What an adapter finds: in the pixels of the network, if the view is the picture itself."""
    adapter = LensAdapter(Returns(results, told or {}), view=make_view(view, SIZE), **options)
    lens = Spherical.from_fov(0.5, 2.8, 80.0, image_size=SIZE)
    return adapter.eval()(torch.zeros(1, 3, *SIZE), lens)


def check_found(form, found):
    names = ("boxes", "scores", "labels", "keypoints", "masks")
    columns = {name: found[name].double().numpy() for name in names if name in found}
    if "masks" in columns:
        columns["masks"] = masks = columns["masks"][:, 0]
        if "masks of boxes" not in form:  # at the middles of the pixels that the network gave
            blocks = masks.reshape(K, HEIGHT // 4, 4, WIDTH // 4, 4)
            columns["masks"] = blocks[:, :, 1:3, :, 1:3].mean((2, 4))
    check_known(form, Instances(**columns))


# That one has parts of the picture by the names of pixels, as no network of torch returns them.
@pytest.mark.parametrize("form", [form for form in FORMS if form != "RT-DETR"])
def test_an_adapter_reads_the_same_forms_in_torch(form):
    outputs, how = FORMS[form]
    told = how.get("metadata", {}) | {"config": SimpleNamespace(id2label=NAMES, **how)}
    results = {name: torch.tensor(np.asarray(value))[None] for name, value in outputs.items()}
    (found,) = by_adapter(results, told, form=how.get("form"), threshold=0.35)
    check_found(form, found)


def test_an_adapter_reads_what_networks_of_ultralytics_return():
    """A table alone, or before maps and other results; and masks, wherever they are."""
    told = dict(task="detect", names=NAMES)
    heads = [torch.rand(1, 144, HEIGHT // s, WIDTH // s) for s in (8, 16, 32)]
    table, ended, shared = (torch.tensor(of)[None] for of in (
        yolo(beside(CENTRED, one_hot(80))), full(ROWS), -protos(64)))  # fmt: skip
    masked = torch.tensor(yolo(beside(CENTRED, one_hot(80), WEIGHTS)))[None]
    for results, of in (
        (table, told), ((table, heads), told), ([table, {"feats": heads}], {"names": NAMES}),
        ((ended, {"one2many": heads}), {}), (ended, told),
        ((masked, (heads, masked[:, -64:], shared)), dict(task="segment", names=NAMES)),
        (((masked, shared), {"feats": heads, "proto": shared}), dict(names=NAMES)),
    ):  # fmt: skip
        (found,) = by_adapter(results, of, threshold=0.35)
        check_found("segment" if "masks" in found else "detect", found)
        assert len(by_adapter(results, of, "tiles")) == 1
    refused("may be detect or obb: say which by `form`", by_adapter, (table, heads), view="tiles")
    refused(r"\(1, 84, 735\).*`boxes` makes", by_adapter, table)
    for results, of in (
        (heads, told),  # in training
        ({"boxes": table[:, :4], "scores": table[:, 4:]}, {}),
        (table[:, :2], {}),
        (SimpleNamespace(boxes=table), {}),
    ):
        refused("of no known form.*`boxes` makes detections", by_adapter, results, of)


def test_an_adapter_leaves_what_are_no_detections():
    random = torch.Generator().manual_seed(3)
    for more in ((10,), (197, 64), (10, 4), (10, 6), (10, 7), (50, 57), (9, 2)):
        features = torch.randn((1, *more), generator=random)
        for results in (features, (features, features[:, :1]), {"a": [features], "b": features}):
            found = by_adapter(results, view="tiles")
            expected = pytree.tree_map(partial(expanded, count=5), results)
            torch.testing.assert_close(found, expected)
    table = torch.tensor(yolo(beside(CENTRED, one_hot(80))))[None]
    assert by_adapter(table, view="tiles", form="numbers").shape == (5, *table.shape[1:])
    refused("`form` must be one of detect, pose", by_adapter, table, form="yolo")
    refused("`form` must be one that its outputs may have", by_adapter, table, form="table")
    refused("`threshold` must be from 0 to 1, got 30", by_adapter, table, threshold=30)


@pytest.mark.parametrize("form", ALL)
def test_no_form_is_taken_for_another(tmp_path, form):
    """With its outputs renamed a, b, c, and without its metadata and words, a form is still right,
    or a sentence asks for what cannot be known."""
    path, _ = written(tmp_path, form, renamed=True)
    (tmp_path / "config.json").unlink(missing_ok=True)
    try:
        network = OnnxNetwork(path)
    except ValueError as error:
        assert form in ASKED, error
        said = ("say which by `form`", "known are")
        assert "has the outputs" in str(error) and any(words in str(error) for words in said)
    else:
        assert form not in ASKED
        (found,) = network(np.zeros((1, 3, *SIZE), np.float32))
        check_known(form, found)


def test_what_a_black_picture_leaves_open_the_first_things_tell():
    """And it is kept: what does not fit then is an error."""
    some, parts = dict(a=BOXES, b=LABELS, c=SCORES), dict(a=IN_PARTS, b=LABELS, c=SCORES)
    for black in (0, 1, 2):
        outputs = {name: 0 * values[:black] for name, values in some.items()}
        form = form_of(Network(outputs, SIZE, {}, 0, ()))
        for first, other in ((some, some), (parts, parts), (parts, some)):
            kept, (found,) = decode(form, first, 1, SIZE, 0.3)
            check_known("own", found)
            if first is other:
                check_known("own", decode(kept, other, 1, SIZE, 0.3)[1][0])
            else:
                said = "boxes must be parts of the picture, but reach"
                refused(said, decode, kept, other, 1, SIZE, 0.3)
    flat = Network(dict(a=np.zeros((0, 7))), SIZE, {}, 0, ())
    for pair, label, score in (
        ((1, 17), 17, 1), ((17, 1), 17, 1), ((0.5, 0), 0, 0.5), ((1, 0), 0, 1), ((1, 1), 1, 1)
    ):  # fmt: skip
        rows = np.array([[0, 10, 20, 30, 40, *pair]], np.float16)
        form, (found,) = decode(form_of(flat), dict(a=rows), 1, SIZE, 0.3)
        assert (found.labels, found.scores) == (label, score)
        assert ("either" in form.where) == (pair == (1, 1))  # both are the same
    rows[0, 5:] = 17, 1.5
    refused(r"score up to 1 and a class, got 17, 1\.5", decode, form, dict(a=rows), 1, SIZE, 0.3)


@pytest.mark.filterwarnings("error")
def test_logits_may_be_very_low(tmp_path):
    """They have a probability of 0, and masks of them show nothing."""
    low = np.full((1, 2, 3), -1000.0, np.float32)
    low[0, 0, 1] = 0
    outputs = dict(dets=np.full((1, 2, 4), 0.5, np.float32), labels=low,
                   masks=np.full((1, 2, HEIGHT // 4, WIDTH // 4), -1000.0, np.float32))  # fmt: skip
    path = write_detector(tmp_path / "n.onnx", SIZE, outputs)
    (found,) = OnnxNetwork(path)(np.zeros((1, 3, *SIZE), np.float32))
    assert (found.labels.tolist(), found.scores.tolist()) == ([1], [0.5])
    assert found.masks.shape[0] == 1 and not found.masks.any()


def test_words_that_do_not_fit_are_told(tmp_path):
    for form, word, said in (
        ("detect", "pose", "`form` must be one that its outputs may have, detect, got pose"),
        ("table", "pose", "may have, detect or rtdetr or table, got pose"),
        ("own", "sigmoid", "may have, boxes, got sigmoid"),
        ("own", "tanh", "`form` must be one of detect, pose, .*, numbers, got tanh"),
        ("own", "numbers", "known are the forms"),
        ("table in parts", None, "may be rtdetr or table: say which by `form`"),
    ):
        path, _ = written(tmp_path, form)
        refused(said, OnnxNetwork, path, form=word)


def test_names_are_those_of_the_file_or_of_the_configuration(tmp_path):
    for form, count in (("detect", 80), ("detect without task", 80), ("own", 0), ("DETR", 80)):
        (tmp_path / form / "onnx").mkdir(parents=True)
        path, words = written(tmp_path / form / "onnx", form)
        config = tmp_path / form / "onnx/config.json"
        if config.is_file():
            config.rename(tmp_path / form / "config.json")
        network = OnnxNetwork(path, **words)
        assert network.names == dict(list(NAMES.items())[:count])


def test_what_is_no_detector_stays_numbers_or_maps(tmp_path):
    seven = np.array([[0.0, 0.5, 0.1, 0.1, 0.1, 0.15, 0.05]], np.float32)  # as of emotions
    pooled = np.zeros((1, 1, 5, 7), np.float32)  # a map of a 32nd
    best = dict(score=np.full(1, 0.6, np.float32), label=np.array([2]))  # of a classifier
    four = np.array([[0.1, 0.2, 3.0, 0.5]], np.float32)
    for outputs, kind, word in (
        (dict(out=seven), "numbers", None), (dict(out=pooled), "maps", None),
        (dict(ids=np.ones((1, 5, 7), np.int64)), "maps", None),
        (best | dict(logits=four), "numbers", None),
        (best | dict(a=four[:, ::-1]), "numbers", None),
        (best | dict(a=four), "numbers", "numbers"),
    ):  # fmt: skip
        network = OnnxNetwork(write_detector(tmp_path / "n.onnx", SIZE, outputs), form=word)
        assert (network.kind, network.form) == (kind, None)
    refused("may be boxes or numbers: say which by `form`", OnnxNetwork, tmp_path / "n.onnx")


def test_boxes_of_cells_are_corners_with_probabilities(tmp_path):
    """As of YOLO-NAS. Middles and sizes, or logits, are refused."""
    cells = priors(8, 16, 32)
    middles = np.column_stack(((cells[:, :2] + 0.5) * cells[:, 2:], cells[:, 2], cells[:, 2]))
    scores = np.full((len(cells), 9), 0.1)
    for boxes, given in ((middles, scores), (np.abs(middles).cumsum(1), scores - 2)):
        outputs = dict(a=boxes[None].astype(np.float32), b=given[None].astype(np.float32))
        path = write_detector(tmp_path / "n.onnx", SIZE, outputs)
        with pytest.raises(ValueError, match=r"outputs a .*, b .*; known are the forms"):
            OnnxNetwork(path)
