"""Networks in ONNX files: every form of input and output, and what is wrong with others."""

import subprocess
import sys

import numpy as np
import pytest
from helpers import product, refused

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from graphs import DETECTORS, write_detector, write_graph

from darswin.frames.onnx import OnnxNetwork

pytestmark = pytest.mark.unsanitized  # nothing of it is compiled

SIZE = (16, 24)
# Of three pictures: the box and the channel of its light; the last one is empty.
BOXES = [((5, 3, 20, 9), 1), ((0, 0, 24, 16), 2), None]


def pictures(output="image"):
    found = np.zeros((len(BOXES), 3, *SIZE), np.float32)
    for picture, box in zip(found, BOXES, strict=True):
        if box is not None:
            (x0, y0, x1, y1), channel = box
            picture[channel, y0:y1, x0:x1] = 1
    return found if output == "image" else (255 * found.transpose(0, 2, 3, 1)).astype(np.uint8)


def check_found(found, expected=BOXES):
    assert len(found) == len(expected)
    for one, known in zip(found, expected, strict=True):
        assert one.boxes.dtype == np.float64 and one.labels.dtype == np.int64
        if known is None:
            columns = one.boxes, one.scores, one.labels
            assert [column.shape for column in columns] == [(0, 4), (0,), (0,)]
            continue
        (x0, y0, x1, y1), channel = known
        area, by = (x1 - x0) * (y1 - y0), 2 if x0 == 0 else 1
        assert one.boxes.tolist() == [[x0, y0, x1, y1]] and one.labels.tolist() == [channel]
        assert one.scores == pytest.approx(area / (area + 20) / by)


KINDS = [(form, batch) for form in ("named", "columns and more", "table")
         for batch in ("B", 1, 2, 5)]  # fmt: skip
KINDS += [
    (form, batch) for form in ("of one picture", "table of one picture") for batch in ("B", 1)
]
KINDS += [("of one picture", None)]  # neither has the input a batch


@pytest.mark.parametrize(
    ("kind", "dtype", "channels_last"),
    product(KINDS, ["float", "float16", "uint8"], [False, True]),
)
def test_a_detector_of_any_form(tmp_path, kind, dtype, channels_last):
    outputs, batch = kind
    assert {form for form, _ in KINDS} == set(DETECTORS)
    path = write_graph(
        tmp_path / "n.onnx", outputs, batch=batch, size=SIZE, dtype=dtype,
        channels_last=channels_last,
    )  # fmt: skip
    network = OnnxNetwork(path, count=3)
    assert (network.kind, network.size, network.channels) == ("detections", SIZE, 3)
    assert network.output == ("uint8" if dtype == "uint8" else "image")
    assert network(pictures(network.output)[:0]) == []
    with pytest.raises(TypeError, match=r"takes pictures of .*, got "):
        network(pictures("image" if dtype == "uint8" else "uint8"))
    takes = 1 if "one picture" in outputs else 3
    assert network.batch == (batch if isinstance(batch, int) else takes)
    seen = pictures(network.output)
    check_found(network(seen))
    check_found(network(seen[1]), BOXES[1:2])  # one picture, as a sampler makes it
    check_found(network(np.concatenate((seen, seen[:1]))), BOXES + BOXES[:1])


def test_low_scores_are_left_out_and_never_seen(tmp_path):
    path = write_graph(tmp_path / "n.onnx", "table", size=SIZE)
    lowest = (24 * 16) / (24 * 16 + 20) / 2  # of those of light; the other is at the border
    for threshold, count in ((0.0, 3), (0.1, 2), (lowest - 1e-6, 2), (0.5, 1), (0.9, 0)):
        network = OnnxNetwork(path, count=3, threshold=threshold)
        assert sum(len(one.boxes) for one in network(pictures())) == count
    path = write_graph(tmp_path / "n.onnx", "nan boxes", size=SIZE)
    assert not any(len(one.boxes) for one in OnnxNetwork(path, threshold=0.99)(pictures()))


@pytest.mark.parametrize("batch", ["B", 1, 2])
@pytest.mark.parametrize("channels_last", [False, True])
def test_maps_and_numbers_of_a_network(tmp_path, batch, channels_last):
    options = dict(batch=batch, size=SIZE)
    seen = pictures()
    network = OnnxNetwork(write_graph(tmp_path / "m.onnx", "maps", **options), count=3)
    found = network(seen)
    assert network.kind == "maps" and list(found) == ["halves", "grey"]
    assert network(seen[:0])["halves"].shape == (0, 3, 8, 12)
    halves = seen.reshape(3, 3, 8, 2, 12, 2).mean((3, 5))
    np.testing.assert_allclose(found["halves"], halves, atol=1e-6)
    np.testing.assert_allclose(found["grey"], seen.mean(1, keepdims=True), atol=1e-6)
    path = write_graph(tmp_path / "n.onnx", "numbers", channels_last=channels_last, **options)
    network = OnnxNetwork(path, count=3)
    assert network.kind == "numbers"
    np.testing.assert_allclose(network(seen)["logits"], seen.mean((2, 3)), atol=1e-6)
    network = OnnxNetwork(write_graph(tmp_path / "b.onnx", "map and numbers", **options), count=3)
    found = network(seen)
    assert network.kind == "maps"
    assert found["same"].shape == (3, 3, *SIZE) and found["light_"].shape == (3, 3)


def test_maps_have_the_order_of_axes_of_the_input(tmp_path):
    onnx = pytest.importorskip("onnx")
    model = onnx.parser.parse_model("""<ir_version: 8, opset_import: ["" : 18]>
        network (float[B,16,24,3] images) => (float[B,16,24,3] same) { same = Neg(images) }""")
    onnx.save(model, tmp_path / "n.onnx")
    np.testing.assert_equal(OnnxNetwork(tmp_path / "n.onnx")(pictures())["same"], -pictures())


def test_scores_of_overlapping_boxes_must_be_probabilities(tmp_path):
    """A YOLOX without its sigmoid, as some exports have it, has the shape of one with it."""
    table = np.random.default_rng(3).uniform(0, 1, (1, 189, 85)).astype(np.float32)
    for low, high, is_known in ((0, 1, True), (-9, 0, False), (0, 4, False)):
        for columns in (slice(4, 5), slice(5, 85)):
            changed = table.copy()
            changed[..., columns] = low + (high - low) * table[..., columns]
            path = write_detector(tmp_path / "n.onnx", (96, 96), {"out": changed})
            if is_known:
                assert OnnxNetwork(path).form == "yolox"
                continue
            said = "that of yolox, but its scores must be from 0 to 1, got .*sigmoid"
            refused(said, OnnxNetwork, path)


def test_the_size_is_the_graphs_or_given(tmp_path):
    free = write_graph(tmp_path / "free.onnx")
    wide = write_graph(tmp_path / "wide.onnx", size=("H", 24))
    fixed = write_graph(tmp_path / "fixed.onnx", size=SIZE)
    for path, size in ((free, SIZE), (wide, SIZE), (wide, (8, 24)), (fixed, SIZE), (fixed, None)):
        assert OnnxNetwork(path, size).size == (size or SIZE)
    for path in (free, wide):
        refused(r"missing `size`: .* takes pictures of any size", OnnxNetwork, path)
    onnx = pytest.importorskip("onnx")
    model = onnx.load(free)
    onnx.helper.set_model_props(model, {"imgsz": "[16, 24]"})  # as Ultralytics writes it
    onnx.save(model, free)
    assert OnnxNetwork(free).size == (16, 24) and OnnxNetwork(free, (32, 8)).size == (32, 8)
    text = """<ir_version: 8, opset_import: ["" : 18]> network (float[1,3,H,W] images) =>
        (float[1,3,16,24] same) { shape = Constant<value_ints=[1, 3, 16, 24]>()
        same = Reshape(images, shape) }"""
    onnx.save(onnx.parser.parse_model(text), wide)
    for path, size, said in (
        (
            wide,
            (32, 24),
            r"onnxruntime cannot run .*\{1,3,32,24\}.*Perhaps 32,24 is no `size` that",
        ),
        (
            write_graph(free, "maps"),
            (15, 25),
            r"halves .*; known are .* 15,25 is no `size` that it",
        ),
    ):
        refused(said, OnnxNetwork, path, size)
    for path, size, wanted in (
        (fixed, (24, 16), "16,24 for"), (fixed, (16, 25), "16,24"),
        (write_graph(wide, size=("H", 24)), (16, 16), "any,24"),
    ):  # fmt: skip
        refused(f"`size` must be {wanted} .*got {size[0]},{size[1]}", OnnxNetwork, path, size)


@pytest.mark.parametrize(
    ("outputs", "said"),
    [
        ("undecoded", r"has the outputs output0 \(1, 4, 11\); known are the forms of .*decoder"),
        (
            "texts",
            r"has the outputs labels \(1, 1\), boxes \(1, 1, 4\), scores \(1, 1\); known are",
        ),
        ("boxes of other shape", r"boxes \(1, 1, 6\), scores \(1, 1\), labels \(1, 1\); known are"),
    ],
)
def test_unknown_outputs_are_told_with_their_shapes(tmp_path, outputs, said):
    for batch in ("B", 1):
        path = write_graph(tmp_path / "n.onnx", outputs, size=SIZE, batch=batch)
        refused(said, OnnxNetwork, path, count=5)


def test_other_inputs_and_files_are_told(tmp_path):
    path = write_graph(tmp_path / "two.onnx", extra=", int64[B,2] sizes", size=SIZE)
    said = r"two.onnx has the inputs images \(B, 3, 16, 24\) of tensor\(float\), sizes \(B, 2\) of"
    refused(f"{said}.*; it must have one, pictures", OnnxNetwork, path)
    path = write_graph(tmp_path / "double.onnx", dtype="double", size=SIZE)
    refused(r"double.onnx has the inputs images .* of tensor\(double", OnnxNetwork, path)
    good, other = write_graph(tmp_path / "good.onnx").read_bytes(), tmp_path / "other.onnx"
    for content, said in (
        (b"\n<!DOCTYPE html><html>", r"other.onnx is a page of HTML"),
        (b"version https://git-lfs.github.com/spec/v1", "a pointer of Git LFS .* `git lfs pull`"),
        (b"PK\x03\x04\0\0", "such as a checkpoint of torch or Keras: export the network to ONNX"),
        (b"Entry not found", "is text, not a network"),
        (good[: len(good) // 2], "onnxruntime cannot read .*other.onnx: .*parsing failed"),
        (b"\x08\x63" + good[2:], "IR version 99, and onnxruntime reads [0-9]+ at most"),
        (good[:-1] + b"\x63", "operator set 99 of ai.onnx, and onnxruntime knows [0-9]+ at most"),
    ):
        other.write_bytes(content)
        refused(said, OnnxNetwork, other)
    with pytest.raises(FileNotFoundError, match=r"there is no file .*gone\.onnx"):
        OnnxNetwork(tmp_path / "gone.onnx")
    onnx = pytest.importorskip("onnx")
    text = """<ir_version: 8, opset_import: ["" : 18]>
        network (float[B,4,16,24] images) => (float[B,4,16,24] same) { same = Neg(images) }"""
    onnx.save(onnx.parser.parse_model(text), tmp_path / "four.onnx")
    with pytest.raises(ValueError, match=r"pictures \(B, 4, 16, 24\), but they must have 1 or 3"):
        OnnxNetwork(tmp_path / "four.onnx")


def test_wrong_numbers_are_told(tmp_path):
    lit = pictures()[:2]
    path = write_graph(tmp_path / "nan.onnx", "nan boxes", size=SIZE)
    with pytest.raises(FloatingPointError, match="computes NaN"):
        OnnxNetwork(path)(lit)
    with pytest.raises(FloatingPointError, match="computes NaN"):
        OnnxNetwork(write_graph(tmp_path / "n.onnx", "nan", size=SIZE))
    for form in ("infinite scores", "infinite"):
        path = write_graph(tmp_path / "inf.onnx", form, size=SIZE)
        with pytest.raises(FloatingPointError, match="computes NaN or infinity"):
            OnnxNetwork(path)(lit)
    path = write_graph(tmp_path / "b.onnx", "infinite boxes", size=SIZE)
    assert np.isinf(OnnxNetwork(path)(lit)[0].boxes).all()
    path = write_graph(tmp_path / "swapped.onnx", "class before score", size=SIZE)
    with pytest.raises(ValueError, match=r"finds the class 0\.8.*x1, y1, score and class"):
        OnnxNetwork(path)(lit)


def test_a_network_runs_without_torch(tmp_path):
    path = write_graph(tmp_path / "n.onnx", size=SIZE)
    code = f"""
import sys
from darswin.frames.onnx import OnnxNetwork
OnnxNetwork({str(path)!r})
assert not {{"torch", "cv2", "onnx"}} & sys.modules.keys()
"""
    subprocess.run([sys.executable, "-c", code], check=True)
