"""Writes graphs of TensorFlow.js for tests."""

import base64
import json
from pathlib import Path

import numpy as np


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
