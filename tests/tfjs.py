"""Graphs of TensorFlow.js for tests: a writer, and an interpreter in NumPy that shares no code with
the one of the pretrained study."""

import base64
import json
import math
from pathlib import Path

import numpy as np

_TYPES = {"float32": "DT_FLOAT", "int32": "DT_INT32"}


def text(*values: str, one: bool = True) -> dict:
    coded = [base64.b64encode(value.encode()).decode() for value in values]
    return {"s": coded[0]} if one else {"list": {"s": coded}}


def ints(*values: int) -> dict:
    return {"list": {"i": [str(value) for value in values]}}


class Writer:
    """Writes NAME.json and NAME.bin. Floats are stored in 16 bits, as converters do."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        sides = {"shape": {"dim": [{"size": str(side)} for side in shape]}}
        self.nodes = [{"name": "image", "op": "Placeholder", "attr": {"shape": sides}}]
        self.weights: list[dict] = []
        self.data = b""

    def constant(self, value: np.ndarray) -> str:
        name = f"constant{len(self.weights)}"
        weight = {"name": name, "shape": list(value.shape), "dtype": str(value.dtype)}
        if value.dtype == np.float32:
            weight["quantization"] = {"dtype": "float16"}
            value = value.astype(np.float16)
        self.data += value.tobytes()
        self.weights.append(weight)
        self.nodes.append({"name": name, "op": "Const", "attr": {}})
        return name

    def node(self, op: str, *inputs, name: str | None = None, **attributes) -> str:
        name = name or f"{op}{len(self.nodes)}"
        given = [self.constant(i) if isinstance(i, np.ndarray) else i for i in inputs]
        self.nodes.append({"name": name, "op": op, "input": given, "attr": attributes})
        return name

    def convolution(self, op: str, *inputs, stride=1, padding="SAME", fused=(), **named) -> str:
        attributes = {"strides": ints(1, stride, stride, 1), "padding": text(padding)}
        if fused:
            attributes["fused_ops"] = text(*fused, one=False)
        return self.node(op, *inputs, **named, **attributes)

    def write(self, folder: Path, name: str) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        half = len(self.data) // 2  # in two files, as large networks are
        paths = [f"{name}-{k}.bin" for k in (1, 2)]
        for path, part in zip(paths, (self.data[:half], self.data[half:]), strict=True):
            (folder / path).write_bytes(part)
        manifest = [{"paths": paths, "weights": self.weights}]
        model = {"modelTopology": {"node": self.nodes[::-1]}, "weightsManifest": manifest}
        (folder / f"{name}.json").write_text(json.dumps(model))
        return folder / f"{name}.json"


# -- the interpreter ----------------------------------------------------------------------------


def run(file: Path, image: np.ndarray, outputs: list[str], resize_of: tuple[int, int]) -> list:
    """The outputs of a graph for an image. The sizes of resizes count in images of `resize_of`,
    (its side in the file, its side here)."""
    model = json.loads(file.read_text())
    (group,) = model["weightsManifest"]
    data = b"".join((file.parent / path).read_bytes() for path in group["paths"])
    values: dict[str, np.ndarray] = {}
    start = 0
    for weight in group["weights"]:
        stored = np.dtype(weight.get("quantization", weight)["dtype"])
        end = start + stored.itemsize * math.prod(weight["shape"])
        values[weight["name"]] = (
            np.frombuffer(data[start:end], stored).reshape(weight["shape"]).astype(weight["dtype"])
        )
        start = end
    nodes = {node["name"]: node for node in model["modelTopology"]["node"]}

    def value(name: str):
        name, _, which = name.partition(":")
        if name not in values:
            node = nodes[name]
            if node["op"] == "Placeholder":
                values[name] = image.astype(np.float64)
            else:
                inputs = [value(of) for of in node["input"]]
                if node["op"] == "ResizeBilinear":
                    inputs[1] = inputs[1] * resize_of[1] // resize_of[0]
                values[name] = _compute(node["op"], node.get("attr", {}), inputs)
        found = values[name]
        return found[int(which or 0)] if isinstance(found, list) else found

    return [value(name) for name in outputs]


def _decoded(attribute: dict) -> list[str]:
    coded = attribute["list"]["s"] if "list" in attribute else [attribute["s"]]
    return [base64.b64decode(one).decode() for one in coded]


def _windows(x, size, attr, fill):
    """The windows (B, H', W', kh, kw, C) of (B, H, W, C)."""
    strides = [int(n) for n in attr["strides"]["list"]["i"]][1:3]
    if _decoded(attr["padding"]) == ["SAME"]:
        pads = []
        for side, kernel, stride in zip(x.shape[1:3], size, strides, strict=True):
            after = -(-side // stride)
            total = max((after - 1) * stride + kernel - side, 0)
            pads.append((total // 2, total - total // 2))
        x = np.pad(x, ((0, 0), *pads, (0, 0)), constant_values=fill)
    found = np.lib.stride_tricks.sliding_window_view(x, size, (1, 2))
    return found[:, :: strides[0], :: strides[1]].transpose(0, 1, 2, 4, 5, 3)


def _compute(op: str, attr: dict, inputs: list):
    x = inputs[0]
    if "Conv2" in op or "Depthwise" in op:
        kernel = inputs[1].astype(np.float64)
        windows = _windows(x, kernel.shape[:2], attr, 0.0)
        if "Depthwise" in op:
            found = np.einsum("bhwijc,ijcm->bhwcm", windows, kernel)
            found = found.reshape(*found.shape[:3], -1)
        else:
            found = np.tensordot(windows, kernel, 3)
        fused = _decoded(attr["fused_ops"]) if "fused_ops" in attr else []
        found = found + inputs[2] if "BiasAdd" in fused else found
        found = np.maximum(found, 0) if {"Relu", "Relu6"} & set(fused) else found
        return np.minimum(found, 6) if "Relu6" in fused else found
    if op == "MaxPool":
        size = [int(n) for n in attr["ksize"]["list"]["i"]][1:3]
        return _windows(x, size, attr, -np.inf).max((3, 4))
    if op == "ResizeBilinear":
        for axis, after in ((1, int(inputs[1][0])), (2, int(inputs[1][1]))):
            side = x.shape[axis]
            at = np.arange(after) * side / after
            if attr["half_pixel_centers"]["b"]:
                at = (np.arange(after) + 0.5) * side / after - 0.5
            low = np.floor(at).astype(int)
            share = (at - low).reshape([-1 if k == axis else 1 for k in range(4)])
            x = (1 - share) * x.take(low.clip(0, side - 1), axis) + share * x.take(
                (low + 1).clip(0, side - 1), axis
            )
        return x
    if op == "SplitV":
        return np.split(x, np.cumsum(inputs[1])[:-1], int(inputs[2]))
    if op in ("Pad", "PadV2"):
        fill = float(inputs[2]) if op == "PadV2" else 0.0
        return np.pad(x, inputs[1], constant_values=fill)
    simple = {
        "Add": lambda: x + inputs[1],
        "AddV2": lambda: x + inputs[1],
        "Sub": lambda: x - inputs[1],
        "Mul": lambda: x * inputs[1],
        "Relu": lambda: np.maximum(x, 0),
        "Relu6": lambda: np.clip(x, 0, 6),
        "LeakyRelu": lambda: np.where(x < 0, attr["alpha"]["f"] * x, x),
        "Sigmoid": lambda: 1 / (1 + np.exp(-x)),
        "Identity": lambda: x,
        "Mean": lambda: x.mean(tuple(inputs[1]), keepdims=attr["keep_dims"]["b"]),
        "ConcatV2": lambda: np.concatenate(inputs[:-1], int(inputs[-1])),
        "Transpose": lambda: x.transpose(inputs[1]),
    }
    return simple[op]()
