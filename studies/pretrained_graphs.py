"""Networks of the pretrained study: graphs of TensorFlow.js as torch modules and as ONNX files.

A graph is a file `NAME.json` of nodes and a file `NAME.bin` of weights. `Graph` runs it, and
`CenterNet` and `NanoDet` add the decoding that their outputs need. So each is a network from
images (B, 3, H, W) to `boxes` (B, 100, 4), `scores` (B, 100) and `labels` (B, 100), best first, and
`export` writes it as an ONNX file that needs no code of this study.
"""

import base64
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

FOUND = 100  # detections of an image


def read_graph(file: Path) -> tuple[list[dict], dict[str, np.ndarray], dict[str, list[int]]]:
    """The nodes of a graph, its constants by name, and the shapes of its inputs by name."""
    model = json.loads(file.read_text())
    constants = {}
    for group in model["weightsManifest"]:
        data = b"".join((file.parent / path).read_bytes() for path in group["paths"])
        start = 0
        for weight in group["weights"]:
            stored = weight.get("quantization", {}).get("dtype", weight["dtype"])
            if stored not in ("float32", "float16", "int32"):
                raise ValueError(f"{file}: weights must be float32, float16 or int32, got {stored}")
            count = math.prod(weight["shape"])
            value = np.frombuffer(data, stored, count, start)
            start += value.nbytes
            constants[weight["name"]] = value.astype(weight["dtype"]).reshape(weight["shape"])
    shapes = {
        node["name"]: [int(side["size"]) for side in node["attr"]["shape"]["shape"]["dim"]]
        for node in model["modelTopology"]["node"]
        if node["op"] == "Placeholder"
    }
    return model["modelTopology"]["node"], constants, shapes


def texts(attribute: dict) -> list[str]:
    """The texts of an attribute, which are stored in base64."""
    stored = attribute["list"].get("s", []) if "list" in attribute else [attribute["s"]]
    return [base64.b64decode(text).decode() for text in stored]


def integers(attribute: dict) -> list[int]:
    return [int(number) for number in attribute["list"]["i"]]


class Graph(nn.Module):
    """Computes the tensors `outputs` of a graph with one input.

    A name ends in `:k` for the k-th result of a node. Sides of the image may be another than those
    of the file, if every part of the graph allows it.
    """

    def __init__(self, file: Path, outputs: Sequence[str]) -> None:
        super().__init__()
        nodes, constants, shapes = read_graph(file)
        ((self.input, self.shape),) = shapes.items()
        by_name = {node["name"]: node for node in nodes}
        self.outputs, self.nodes = list(outputs), []
        waiting, needed = [name.split(":")[0] for name in outputs], set()
        while waiting:
            name = waiting.pop()
            if name not in needed:
                needed.add(name)
                waiting += [of.split(":")[0] for of in by_name[name].get("input", [])]
        for node in _ordered([node for node in nodes if node["name"] in needed]):
            if node["op"] not in ("Const", "Placeholder") and node["op"] not in OPERATORS:
                raise ValueError(f"{file}: the operator {node['op']} is not known")
            if node["op"] != "Placeholder":
                self.nodes.append(node)
        self.places = {name: f"value{k}" for k, name in enumerate(constants) if name in needed}
        for name, place in self.places.items():
            value = constants[name]
            if value.dtype == np.float32 and value.ndim:
                self.register_buffer(place, torch.from_numpy(value.copy()))
            else:
                setattr(self, place, value.tolist())  # scalars, shapes, axes and paddings
        # The file gives the sizes after a resize for images of its own size: they become factors.
        self.factors: dict[str, float] = {}
        with torch.no_grad():
            self(torch.zeros(self.shape))

    def forward(self, x: Tensor) -> list[Tensor]:
        values = {f"{self.input}:0": x}
        for node in self.nodes:
            name = node["name"]
            if node["op"] == "Const":
                values[f"{name}:0"] = getattr(self, self.places[name])
                continue
            given = [values[of if ":" in of else f"{of}:0"] for of in node["input"]]
            if node["op"] == "ResizeBilinear":
                given[1] = self.factors.setdefault(name, given[1][0] / given[0].shape[1])
            found = OPERATORS[node["op"]](node.get("attr", {}), *given)
            found = found if isinstance(found, (list, tuple)) else [found]
            values.update({f"{name}:{k}": value for k, value in enumerate(found)})
        return [values[name if ":" in name else f"{name}:0"] for name in self.outputs]


def _ordered(nodes: list[dict]) -> list[dict]:
    """The nodes in an order in which each follows its inputs."""
    waiting, done, ordered = nodes, set(), []
    while waiting:
        ready = [n for n in waiting if all(i.split(":")[0] in done for i in n.get("input", []))]
        if not ready:
            raise ValueError("the graph has a circle")
        ordered += ready
        done |= {node["name"] for node in ready}
        waiting = [node for node in waiting if node["name"] not in done]
    return ordered


# -- operators of TensorFlow; images are (B, H, W, C) -------------------------------------------


def same_padding(x: Tensor, kernel: tuple[int, int], strides: tuple[int, int]) -> list[int]:
    """TensorFlow's padding "SAME" of (B, C, H, W), as `F.pad` takes it: the odd pixel is last."""
    padding = []
    for side, size, stride in zip(x.shape[:-3:-1], kernel[::-1], strides[::-1], strict=True):
        total = max((math.ceil(side / stride) - 1) * stride + size - side, 0)
        padding += [total // 2, total - total // 2]
    return padding


def _window(attributes: dict, x: Tensor, kernel: tuple[int, int], fill: float) -> tuple:
    """x as (B, C, H, W), padded, and the strides."""
    strides = tuple(integers(attributes["strides"])[1:3])
    x = x.permute(0, 3, 1, 2)
    if texts(attributes["padding"]) == ["SAME"]:
        x = F.pad(x, same_padding(x, kernel, strides), value=fill)
    return x, strides


def _convolution(attributes: dict, x: Tensor, weight: Tensor, *bias: Tensor) -> Tensor:
    x, strides = _window(attributes, x, tuple(weight.shape[:2]), 0.0)
    return _finished(attributes, F.conv2d(x, weight.permute(3, 2, 0, 1), *bias, stride=strides))


def _depthwise(attributes: dict, x: Tensor, weight: Tensor, *bias: Tensor) -> Tensor:
    x, strides = _window(attributes, x, tuple(weight.shape[:2]), 0.0)
    height, width, channels, each = weight.shape
    weight = weight.permute(2, 3, 0, 1).reshape(channels * each, 1, height, width)
    found = F.conv2d(x, weight, *bias, stride=strides, groups=channels)
    return _finished(attributes, found)


def _finished(attributes: dict, x: Tensor) -> Tensor:
    fused = texts(attributes["fused_ops"]) if "fused_ops" in attributes else []
    if others := set(fused) - {"BiasAdd", "Relu", "Relu6"}:
        raise ValueError(f"a fused operator is not known: {', '.join(others)}")
    x = x.relu() if "Relu" in fused else F.relu6(x) if "Relu6" in fused else x
    return x.permute(0, 2, 3, 1)


def _max_pool(attributes: dict, x: Tensor) -> Tensor:
    kernel = tuple(integers(attributes["ksize"])[1:3])
    x, strides = _window(attributes, x, kernel, -math.inf)
    return F.max_pool2d(x, kernel, strides).permute(0, 2, 3, 1)


def _resize(attributes: dict, x: Tensor, factor: float) -> Tensor:
    if attributes["align_corners"]["b"]:
        raise ValueError("a resize that aligns corners is not known")
    if attributes["half_pixel_centers"]["b"]:
        x = F.interpolate(x.permute(0, 3, 1, 2), scale_factor=factor, mode="bilinear")
        return x.permute(0, 2, 3, 1)
    if factor != 2:
        raise ValueError(f"a resize without half pixels must double the sides, got × {factor}")
    for axis in (1, 2):  # an even pixel is an old one; an odd one is the mean of two
        last = x.shape[axis] - 1
        following = torch.cat((x.narrow(axis, 1, last), x.narrow(axis, last, 1)), axis)
        x = torch.stack((x, (x + following) / 2), axis + 1).flatten(axis, axis + 1)
    return x


def _pad(attributes: dict, x: Tensor, paddings: list[list[int]], value: float = 0.0) -> Tensor:
    return F.pad(x, [n for pair in reversed(paddings) for n in pair], value=float(value))


OPERATORS = {
    "Add": lambda a, x, y: x + y,
    "AddV2": lambda a, x, y: x + y,
    "Sub": lambda a, x, y: x - y,
    "Mul": lambda a, x, y: x * y,
    "Relu": lambda a, x: x.relu(),
    "Relu6": lambda a, x: F.relu6(x),
    "LeakyRelu": lambda a, x: F.leaky_relu(x, a["alpha"]["f"]),
    "Sigmoid": lambda a, x: x.sigmoid(),
    "Identity": lambda a, x: x,
    "Mean": lambda a, x, axes: x.mean(axes, keepdim=a["keep_dims"]["b"]),
    "ConcatV2": lambda a, *x: torch.cat(x[:-1], x[-1]),
    "SplitV": lambda a, x, sizes, axis: x.split(sizes, axis),
    "Transpose": lambda a, x, order: x.permute(order),
    "Pad": _pad,
    "PadV2": _pad,
    "Conv2D": _convolution,
    "_FusedConv2D": _convolution,
    "DepthwiseConv2dNative": _depthwise,
    "FusedDepthwiseConv2dNative": _depthwise,
    "MaxPool": _max_pool,
    "ResizeBilinear": _resize,
}


# -- decoding, in the network's own graph -------------------------------------------------------


def best(boxes: Tensor, scores: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The detections with the best scores, after suppression of those that overlap a better one.

    Greedy suppression (IoU above 0.6, of one class) without a loop over detections: a detection
    stays if no better one that stays overlaps it, until nothing changes. Chains are short.
    """
    scores, order = scores.topk(FOUND, 1)
    boxes = boxes.gather(1, order[..., None].expand(-1, -1, 4))
    labels = labels.gather(1, order)
    low = torch.maximum(boxes[:, :, None, :2], boxes[:, None, :, :2])
    high = torch.minimum(boxes[:, :, None, 2:], boxes[:, None, :, 2:])
    common = (high - low).clamp(min=0).prod(-1)
    area = (boxes[..., 2:] - boxes[..., :2]).prod(-1)
    overlap = common > 0.6 * (area[:, :, None] + area[:, None] - common)
    overlap = overlap & (labels[:, :, None] == labels[:, None])
    worse = torch.ones(FOUND, FOUND, device=boxes.device).tril(-1)  # [i, j]: i is worse than j
    covers = overlap.to(boxes.dtype) * worse
    stays = torch.ones_like(scores)
    for _ in range(8):
        stays = ((covers @ stays[..., None])[..., 0] < 0.5).to(scores.dtype)
    scores, order = (scores * stays).topk(FOUND, 1)
    return boxes.gather(1, order[..., None].expand(-1, -1, 4)), scores, labels.gather(1, order)


def cells(x: Tensor) -> tuple[Tensor, Tensor]:
    """Columns and rows (H·W,) of the cells of maps (B, C, H, W)."""
    rows, columns = (torch.arange(side, dtype=x.dtype, device=x.device) for side in x.shape[2:])
    columns, rows = torch.meshgrid(columns, rows, indexing="xy")
    return columns.flatten(), rows.flatten()


class CenterNet(nn.Module):
    """MobileNetV3-CenterNet of 80 COCO classes.

    Images are RGB, (B, 3, H, W), normalised by `mean` and `std`. A detection is a cell whose score
    is the highest of its 3 × 3 neighbours. The map of sizes gives the distances from the cell's
    place to the four sides of its box.
    """

    mean, std = (0.0, 0.0, 0.0), (1 / 255, 1 / 255, 1 / 255)  # pixels are 0 … 255
    side = 512

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.body = Graph(folder / "centernet.json", ["tower_0/keypoints", "tower_0/wh"])

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        heat, sides = (x.permute(0, 3, 1, 2) for x in self.body(images.permute(0, 2, 3, 1)))
        peaks = heat * (heat == F.max_pool2d(heat, 3, 1, 1))
        count = heat.shape[2] * heat.shape[3]
        scores, order = peaks.flatten(1).topk(FOUND, 1)
        labels, place = order.div(count, rounding_mode="floor"), order.remainder(count)
        columns, rows = (4 * of[place] for of in cells(heat))
        sides = sides.flatten(2).gather(2, place[:, None].expand(-1, 4, -1))
        left, top, right, bottom = sides.unbind(1)
        boxes = torch.stack((columns - left, rows - top, columns + right, rows + bottom), -1)
        return boxes, scores, labels


class NanoDet(nn.Module):
    """NanoDet of 80 COCO classes.

    Images are RGB, (B, 3, H, W), normalised by `mean` and `std`. Each cell has a score for each
    class and, for each side of a box, a distribution over 11 distances, whose mean counts in cells.
    """

    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    side = 416
    strides = 8, 16, 32

    def __init__(self, folder: Path) -> None:
        super().__init__()
        name = "PartitionedCall/onnx_tf_prefix_"
        outputs = [f"{name}Sigmoid_{k}" for k in (154, 165, 176)]
        outputs += [f"{name}Split_{k}:1" for k in (153, 164, 175)]
        self.body = Graph(folder / "nanodet.json", outputs)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        maps = self.body(images.flip(1))  # it was trained with BGR
        boxes, scores = [], []
        for score, sides, stride in zip(maps[:3], maps[3:], self.strides, strict=True):
            columns, rows = (stride * (of + 0.5) for of in cells(score))
            steps = torch.arange(11, dtype=score.dtype, device=score.device)
            sides = (sides.flatten(2).unflatten(1, (4, 11)).softmax(2) * steps[:, None]).sum(2)
            left, top, right, bottom = (stride * sides).unbind(1)
            sides = columns - left, rows - top, columns + right, rows + bottom
            boxes.append(torch.stack(sides, -1))
            scores.append(score.flatten(2).transpose(1, 2))
        scores = torch.cat(scores, 1)
        best_scores, order = scores.flatten(1).topk(5 * FOUND, 1)
        place = order.div(scores.shape[2], rounding_mode="floor")
        boxes = torch.cat(boxes, 1).gather(1, place[..., None].expand(-1, -1, 4))
        return best(boxes, best_scores, order.remainder(scores.shape[2]))


DETECTORS = {"CenterNet": CenterNet, "NanoDet": NanoDet}


def export(network: nn.Module, size: tuple[int, int], file: Path) -> None:
    """Writes a detector for images of one size as an ONNX file of one input and three outputs."""
    file.parent.mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        network.eval(), (torch.zeros(1, 3, *size),), file, dynamo=True, external_data=False,
        input_names=["images"], output_names=["boxes", "scores", "labels"], verbose=False,
    )  # fmt: skip
