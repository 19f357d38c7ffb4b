"""Networks for frames: what their model gives, from any layout, in Python and in C."""

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from frame_samples import (
    MEAN,
    ROUND,
    STD,
    in_layout,
    model_of,
    network_of,
    quantized_of,
    random_frame,
)  # fmt: skip
from helpers import refused
from torch import nn

from darswin import create_model, frames, optimize
from darswin.deploy import camera
from darswin.models import Encoder, LensAdapter
from darswin.views import PolarView


def unusual():
    model = model_of()
    model.head = nn.Sequential(model.head, nn.Sigmoid())
    return model


@torch.no_grad()
def by_model(model, frame, lens=ROUND):
    """The model's result for a frame, a list of arrays; a classifier's probabilities."""
    image = torch.from_numpy(np.ascontiguousarray(frame))
    image = image[None, None] if frame.ndim == 2 else image.permute(2, 0, 1)[None]
    result = model(image, lens)
    if isinstance(model, Encoder) and model.num_classes:
        result = result.softmax(1)
    return [one[0].numpy() for one in (result if isinstance(result, list) else [result])]


def assert_close(found, expected, of=1e-5):
    """Equal up to this part of the largest number."""
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        assert one.shape == other.shape and one.dtype == other.dtype == np.float32
        np.testing.assert_allclose(one, other, rtol=of, atol=of * np.abs(other).max())


def test_a_list_of_outs_takes_the_maps(tmp_path):
    network = network_of(model_of(features_only=True), tmp_path)
    frame = random_frame(*network.size, 3)
    expected = network(frame)
    out = [np.full_like(one, np.nan) for one in expected]
    assert network(frame, out) is out
    for one, right in zip(out, expected, strict=True):
        np.testing.assert_array_equal(one, right)
    for wrong in (out[0], out[:-1], tuple(out), 1):
        refused("out must be a list of 3 arrays", network, frame, wrong, error=TypeError)
    refused("with shape", network, frame, out[::-1])
    memory = np.zeros(sum(one.size for one in out), np.float32)
    shared = [memory[: one.size].reshape(one.shape) for one in out]
    refused("the arrays of out must not share memory", network, frame, shared)


def test_labels_and_normalization(tmp_path):
    names = ["naïve", "車", "𝄞", "d", "", "f", "g", "h", "i", "j" * 99]
    model = model_of()
    assert network_of(model, tmp_path).labels == []
    assert network_of(model, tmp_path, labels=tuple(names)).labels == names
    model.pretrained_cfg["label_names"] = names[::-1]
    assert network_of(model, tmp_path).labels == names[::-1]
    assert network_of(model, tmp_path, labels=[]).labels == []
    other = network_of(model, tmp_path, mean=0.1, std=(0.5, 0.6, 0.7))
    model.view.mean, model.view.std = (0.1,) * 3, (0.5, 0.6, 0.7)
    frame = random_frame(*other.size, 3)
    assert_close([other(frame)], by_model(model, frame))


@pytest.mark.parametrize(
    ("model", "changes", "error", "words"),
    [
        (unusual, {}, TypeError, r"got DarSwin: head.1 \(Sigmoid\): .* is no instruction"),
        (lambda: model_of().to(torch.bfloat16), {}, TypeError, "float32 weights, got .*bfloat16"),
        (lambda: model_of().double(), {}, TypeError, "float32 weights, got .*float64"),
        (lambda: LensAdapter(nn.Flatten(), 8, mean=0, std=1), {}, TypeError, "got Flatten"),
        (lambda: LensAdapter(model_of("swin"), 32, view="tiles", mean=0, std=1).eval(), {},
         TypeError, "got LensAdapter: its view shows 5 pictures of each image"),
        (lambda: nn.Linear(2, 2), {}, TypeError, "got Linear"),
        (lambda: "model", {}, TypeError, "got str"),
        (lambda: optimize(model_of()), {}, TypeError, "got an optimized model"),
        (lambda: model_of().train(), {}, ValueError, "eval mode"),
        (lambda: model_of("swin"), dict(size=(40, 40)), ValueError, r"image_size, \(32, 32\)"),
        (lambda: model_of(in_chans=2, mean=0, std=1), {}, ValueError, "1 mean, or 3 for RGB"),
        (model_of, dict(lens=None), TypeError, "lens must be"),
        (model_of, dict(size=(50, 40_000)), ValueError, "at most 32767"),
        (model_of, dict(size=(50.5, 40)), TypeError, "size must be a pair of ints"),
        (model_of, dict(labels=["a"]), ValueError, "labels must be 10 names"),
        (model_of, dict(labels=[1] * 10), ValueError, "labels must be 10 names"),
        (model_of, dict(mean=(0.1, 0.2)), ValueError, "one per channel"),
        (model_of, dict(path="camera.onnx"), ValueError, r"must end in \.safetensors"),
    ],
)  # fmt: skip
def test_what_cannot_be_exported_is_explained(model, changes, error, words, tmp_path):
    options = dict(lens=ROUND, size=(50, 60), path="camera.safetensors") | changes
    path = tmp_path / options.pop("path")
    with pytest.raises(error, match=words):
        camera.export_network(model(), options.pop("lens"), options.pop("size"), path, **options)
    assert not list(tmp_path.iterdir())


def test_a_model_that_ignores_its_lens_needs_none(tmp_path):
    model = model_of("swin")
    network = network_of(model, tmp_path, None)
    frame = random_frame(32, 32, 3)
    assert_close([network(frame)], by_model(model, frame, None))


class Frame(ctypes.Structure):
    _fields_ = [("pixels", ctypes.c_void_p)] + [
        (name, ctypes.c_int64)
        for name in ["height", "width", "channels", "row_stride", "column_stride", "channel_stride"]
    ]


def test_the_c_interface(tmp_path):
    library = ctypes.CDLL(str(Path(frames.__file__).parent / "libdarswin_frames.so"))
    pointer, number, text = ctypes.c_void_p, ctypes.c_int64, ctypes.c_char_p
    for name, result, *arguments in (
        ("version", text), ("file_version", text), ("last_error", text), ("load", pointer, text),
        ("free", None, pointer), ("frame_size", ctypes.c_int, pointer, pointer),
        ("output_count", number, pointer), ("output_axes", number, pointer, number),
        ("output_shape", ctypes.POINTER(number), pointer, number),
        ("output_numbers", number, pointer, number), ("label_count", number, pointer),
        ("label", text, pointer, number),
        ("run", ctypes.c_int, pointer, ctypes.POINTER(Frame), ctypes.POINTER(pointer), number),
    ):  # fmt: skip
        function = getattr(library, f"darswin_{name}")
        function.restype, function.argtypes = result, arguments
    assert library.darswin_file_version() == b"2.0"
    toml = Path(__file__).parents[2].joinpath("pyproject.toml").read_text()
    assert f'\nversion = "{library.darswin_version().decode()}"\n' in toml

    for model in (model_of(), model_of(features_only=True), model_of("darswin_unet_a")):
        labels = ["ä"] * model.num_classes if isinstance(model, Encoder) else []
        network = network_of(model, tmp_path, labels=labels)
        frame = random_frame(*network.size, 3)
        expected = network(frame)
        expected = expected if isinstance(expected, list) else [expected]
        loaded = library.darswin_load(os.fsencode(tmp_path / "camera.safetensors"))
        assert loaded, library.darswin_last_error()
        size = (number * 3)()
        assert library.darswin_frame_size(loaded, size) == 0
        assert tuple(size) == (*network.size, 3)
        assert library.darswin_frame_size(loaded, None) == -1
        assert b"size must not be NULL" in library.darswin_last_error()
        assert library.darswin_output_count(loaded) == len(expected)
        outs = []
        for k, right in enumerate(expected):
            axes = library.darswin_output_axes(loaded, k)
            assert tuple(library.darswin_output_shape(loaded, k)[:axes]) == right.shape
            assert library.darswin_output_numbers(loaded, k) == right.size
            outs.append(np.full_like(right, np.nan))
        for k in (-1, len(expected)):
            assert library.darswin_output_axes(loaded, k) == -1
            assert library.darswin_output_numbers(loaded, k) == -1
            assert not library.darswin_output_shape(loaded, k)
        assert library.darswin_label_count(loaded) == len(labels)
        for k in range(-1, len(labels) + 1):
            known = 0 <= k < len(labels)
            assert library.darswin_label(loaded, k) == ("ä".encode() if known else None)
        outputs = (pointer * len(outs))(*(out.ctypes.data for out in outs))
        for given in (frame, in_layout(frame, "flipped"), in_layout(frame, "bgr")):
            c_frame = Frame(given.ctypes.data, *given.shape, *given.strides)
            assert library.darswin_run(loaded, c_frame, outputs, 2) == 0
            for out, right in zip(outs, expected, strict=True):
                np.testing.assert_array_equal(out, right)
                out.fill(np.nan)
        small, none = Frame(frame.ctypes.data, 5, 5, 3, 15, 3, 1), Frame()
        for arguments, words in (
            ((loaded, small, outputs, 1), b"(H, W) = (70, 80), got (5, 5)"),
            ((loaded, none, outputs, 1), b"must not be NULL"),
            ((loaded, None, outputs, 1), b"must not be NULL"),
            ((loaded, c_frame, None, 1), b"must not be NULL"),
            ((loaded, c_frame, (pointer * len(outs))(), 1), b"must not be NULL"),
            ((loaded, c_frame, outputs, 0), b"threads must be at least 1"),
            ((None, c_frame, outputs, 1), b"must not be NULL"),
        ):
            assert library.darswin_run(*arguments) == -1
            assert words in library.darswin_last_error()
        library.darswin_free(loaded)
    library.darswin_free(None)
    assert library.darswin_frame_size(None, size) == library.darswin_output_count(None) == -1
    assert library.darswin_label_count(None) == library.darswin_output_axes(None, 0) == -1
    assert library.darswin_label(None, 0) is None and not library.darswin_output_shape(None, 0)
    assert b"network must not be NULL" in library.darswin_last_error()
    for path, words in ((None, b"NULL"), (b"/missing", b"/missing: No such file"),
                        (os.fsencode(__file__), b"is no network")):  # fmt: skip
        assert library.darswin_load(path) is None and words in library.darswin_last_error()


@pytest.mark.slow
@pytest.mark.unsanitized
@pytest.mark.parametrize("tier", ["default", "avx2", "avx512"])
def test_frames_are_read_without_torch_in_little_memory_on_every_tier(tier, tmp_path):
    model = create_model("darswin_a_micro", num_classes=10, mean=MEAN, std=STD).eval()
    frame = random_frame(966, 1280, 3)
    camera.export_network(model, ROUND, frame.shape[:2], tmp_path / "camera.safetensors")
    small = quantized_of(model_of())
    camera.export_network(small, ROUND, (70, 80), tmp_path / "quantized.safetensors")
    sampling = PolarView(4, 8, (2, 3), mean=MEAN, std=STD).eval()
    camera.plan(sampling, ROUND, (70, 80)).save(tmp_path / "plan.safetensors")
    np.save(tmp_path / "frame.npy", frame)
    code = """if True:
        import re, sys
        import numpy as np
        import darswin.frames
        network = darswin.frames.Network("camera.safetensors")
        frame = np.load("frame.npy")
        np.save("found.npy", network(frame))
        np.save("quantized.npy", darswin.frames.Network("quantized.safetensors")(frame[:70, :80]))
        np.save("tokens.npy", darswin.frames.Sampler("plan.safetensors")(frame[:70, :80]))
        assert not {"torch", "cv2"} & set(sys.modules)
        peak = int(re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
        assert peak < 60_000, peak
    """
    environment = os.environ | {"ATEN_CPU_CAPABILITY": tier}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    assert_close([np.load(tmp_path / "found.npy")], by_model(model, frame))
    expected = by_model(optimize(small, torch.int8), frame[:70, :80])
    assert_close([np.load(tmp_path / "quantized.npy")], expected, 0.05)
    sampled = sampling(torch.from_numpy(frame[:70, :80])[None], ROUND)
    np.testing.assert_allclose(np.load(tmp_path / "tokens.npy"), sampled[0], atol=1e-5)
