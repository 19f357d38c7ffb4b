"""Small networks in ONNX files whose answers are known."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import onnx.parser
from onnx import TensorProto, helper, numpy_helper

# Of pictures x, (B, 3, H, W), in [0, 1]: the box of all pixels above 0.5; as its score the share of
# their number in that number and 20, and half of it if one is at a border; as its class the channel
# with most light.
_FINDS = """
    one = Constant<value_int=1>() half = Constant<value_float=0.5>()
    some = Constant<value_float=20.0>() a0 = Constant<value_ints=[0]>()
    a1 = Constant<value_ints=[1]>() a2 = Constant<value_ints=[2]>()
    a12 = Constant<value_ints=[1, 2]>() a23 = Constant<value_ints=[2, 3]>()
    peak = ReduceMax<keepdims=0>(x, a1) above = Greater(peak, half) lit = Cast<to=1>(above)
    across = ReduceMax<keepdims=0>(lit, a1) down = ReduceMax<keepdims=0>(lit, a2)
    x0 = ArgMax<axis=1>(across) xl = ArgMax<axis=1, select_last_index=1>(across) x1 = Add(xl, one)
    y0 = ArgMax<axis=1>(down) yl = ArgMax<axis=1, select_last_index=1>(down) y1 = Add(yl, one)
    corners = Concat<axis=1>(x0, y0, x1, y1) box = Cast<to=1>(corners) box1 = Unsqueeze(box, a1)
    first = Constant<value_int=0>() end = Constant<value_int=-1>()
    left = Gather<axis=1>(across, first) right = Gather<axis=1>(across, end)
    top = Gather<axis=1>(down, first) bottom = Gather<axis=1>(down, end)
    unit = Constant<value_float=1.0>() cut = Max(left, right, top, bottom) by = Add(cut, unit)
    area = ReduceSum<keepdims=0>(lit, a12) more = Add(area, some) part_ = Div(area, more)
    share = Div(part_, by) score1 = Unsqueeze(share, a1)
    light = ReduceMean<keepdims=0>(x, a23) label1 = ArgMax<axis=1>(light)
    score2 = Unsqueeze(score1, a2) label2 = Unsqueeze(label1, a2) class2 = Cast<to=1>(label2)
    table = Concat<axis=2>(box1, score2, class2)
"""
# Each form of outputs: what the graph declares, and its last nodes.
OUTPUTS = {
    "named": (
        "int64[B,N] labels, float[B,N,4] boxes, float[B,N] scores",
        "labels = Identity(label1) boxes = Identity(box1) scores = Identity(score1)",
    ),
    "of one picture": (
        "float[N,4] boxes, float[N] scores, float[N] labels",
        "boxes = Squeeze(box1, a0) scores = Squeeze(score1, a0) class1 = Squeeze(class2, a2) "
        "labels = Squeeze(class1, a0)",
    ),
    "columns and more": (
        "float[B,N,4] Boxes, float[B,N,K] Scores, int64[B,N,K] Labels, float[B,K] other",
        "Boxes = Identity(box1) Scores = Identity(score2) Labels = Identity(label2) "
        "other = Identity(light)",
    ),
    "table": ("float[B,N,6] found", "found = Identity(table)"),
    "table of one picture": (  # whatever its input says
        "float[B,N,6] found",
        "whole = Constant<value_ints=[1, 1, 6]>() found = Reshape(table, whole)",
    ),
    "maps": (
        "float[B,K,h,w] halves, float[B,H,W] grey",
        "halves = AveragePool<kernel_shape=[2, 2], strides=[2, 2]>(x) "
        "grey = ReduceMean<keepdims=0>(x, a1)",
    ),
    "map and numbers": ("float[B,K,h,w] same, float[B,K] light_",
                        "same = Identity(x) light_ = Identity(light)"),
    "numbers": ("float[B,K] logits", "logits = Identity(light)"),
    "undecoded": (
        "float[B,4,K] output0",
        "box2 = Unsqueeze(box, a2) shape = Constant<value_ints=[1, 1, 11]>() "
        "output0 = Expand(box2, shape)",
    ),
    "boxes of other shape": (
        "float[B,N,6] boxes, float[B,N] scores, int64[B,N] labels",
        "boxes = Identity(table) scores = Identity(score1) labels = Identity(label1)",
    ),
    "class before score": (
        "float[B,N,6] found", "found = Concat<axis=2>(box1, class2, score2)",
    ),
    "nan boxes": (
        "float[B,N,6] found",
        "zero = Sub(score2, score2) nan = Div(zero, zero) "
        "nans = Concat<axis=2>(nan, nan, nan, nan) found = Concat<axis=2>(nans, score2, class2)",
    ),
    "infinite boxes": (
        "float[B,N,6] found",
        "zero = Sub(score2, score2) inf = Div(score2, zero) "
        "far = Concat<axis=2>(inf, inf, inf, inf) found = Concat<axis=2>(far, score2, class2)",
    ),
    "infinite scores": (
        "float[B,N,6] found",
        "zero = Sub(score2, score2) inf = Div(score2, zero) "
        "found = Concat<axis=2>(box1, inf, class2)",
    ),
    "infinite": ("float[B,K] logits", "zero = Sub(light, light) inf = Div(score1, zero) "
                 "logits = Add(light, inf)"),
    "texts": (
        "string[B,N] labels, float[B,N,4] boxes, float[B,N] scores",
        "labels = Cast<to=8>(label1) boxes = Identity(box1) scores = Identity(score1)",
    ),
    "nan": ("float[B,K] logits", "zero = Sub(light, light) logits = Div(zero, zero)"),
}  # fmt: skip
DETECTORS = ("named", "of one picture", "columns and more", "table", "table of one picture")


def write_graph(
    path: Path, outputs: str = "named", *, batch: str | int | None = "B",
    size: tuple[str | int, str | int] = ("H", "W"), dtype: str = "float",
    channels_last: bool = False, extra: str = "",
) -> Path:  # fmt: skip
    """Writes a network. A batch of None is one picture (C, H, W); extra: another input."""
    sides = [*size, 3] if channels_last else [3, *size]
    axes = ",".join(map(str, sides if batch is None else [batch, *sides]))
    declared, last = OUTPUTS[outputs]
    reads = ["read = Cast<to=1>(images)", "scale = Constant<value_float=255.0>()"]
    reads.append("part = Div(read, scale)" if dtype == "uint8" else "part = Identity(read)")
    reads.append("z = Constant<value_ints=[0]>()")
    reads.append("four = Identity(part)" if batch is not None else "four = Unsqueeze(part, z)")
    reads.append(
        "x = Transpose<perm=[0, 3, 1, 2]>(four)" if channels_last else "x = Identity(four)"
    )
    text = f"""<ir_version: 8, opset_import: ["" : 18]>
        network ({dtype}[{axes}] images{extra}) => ({declared}) {{ {" ".join(reads)}
        {_FINDS} {last} }}"""
    onnx.save(onnx.parser.parse_model(text), path)
    return path


def write_constants(path: Path, size: tuple[int, int], **outputs: np.ndarray) -> Path:
    """Writes a network of pictures (1, 3, H, W) that always gives the same outputs."""
    return write_detector(path, size, outputs)


def write_detector(
    path: Path, size: tuple[int, int], outputs: Mapping[str, np.ndarray], *, batch: int | str = 1,
    metadata: Mapping[str, object] | None = None, sized: str | None = None, masked: bool = False,
) -> Path:  # fmt: skip
    """Writes a network of pictures (B, 3, H, W) that always gives the same outputs (1 or B, …).

    Args:
        sized: the output that `orig_target_sizes`, an input (B, 2) of widths and heights,
            multiplies. masked: whether there is an input `pixel_mask`.
    """
    inputs = [helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch, 3, *size])]
    nodes, declared = [], []
    if sized is not None:
        of = helper.make_tensor_value_info("orig_target_sizes", TensorProto.INT64, [batch, 2])
        inputs.append(of)
        nodes += onnx.parser.parse_graph("""g (int64[B,2] orig_target_sizes) => (float[B,1,4] by) {
            sides = Cast<to=1>(orig_target_sizes) four = Concat<axis=1>(sides, sides)
            middle = Constant<value_ints=[1]>() by = Unsqueeze(four, middle) }""").node
    if masked:
        shape = [batch, 64, 64]
        inputs.append(helper.make_tensor_value_info("pixel_mask", TensorProto.INT64, shape))
    for number, (name, value) in enumerate(outputs.items()):
        kind = helper.np_dtype_to_tensor_dtype(value.dtype)
        first = "value" if name == sized else name
        if batch == "B" and value.ndim:
            one, to = f"one{number}", f"to{number}"
            rest = numpy_helper.from_array(np.array(value.shape[1:], np.int64))
            constant = numpy_helper.from_array(value)
            nodes += [
                helper.make_node("Shape", ["images"], [f"n{number}"], start=0, end=1),
                helper.make_node("Constant", [], [f"k{number}"], value=rest),
                helper.make_node("Concat", [f"n{number}", f"k{number}"], [to], axis=0),
                helper.make_node("Constant", [], [one], value=constant),
            ]
            nodes.append(helper.make_node("Expand", [one, to], [first]))
        else:
            constant = numpy_helper.from_array(value)
            nodes.append(helper.make_node("Constant", [], [first], value=constant))
        if name == sized:
            like = helper.make_node("Cast", ["by"], ["as"], to=kind)
            nodes += [like, helper.make_node("Mul", ["value", "as"], [name])]
        shape = [batch, *value.shape[1:]] if batch == "B" and value.ndim else value.shape
        declared.append(helper.make_tensor_value_info(name, kind, shape))
    graph = helper.make_graph(nodes, "network", inputs, declared)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=8)
    helper.set_model_props(model, {key: str(value) for key, value in (metadata or {}).items()})
    onnx.save(model, path)
    return path
