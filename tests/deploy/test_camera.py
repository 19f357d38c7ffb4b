"""examples/camera.py: a video's frames, sampled and classified without torch."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import onnx
import pytest
import torch
from videos import write_video

from darswin import create_model, frames
from darswin.deploy import camera
from darswin.deploy.export import export_onnx
from darswin.lens import Equidistant

pytestmark = pytest.mark.slow
EXAMPLE = Path(__file__).parents[2] / "examples" / "camera.py"
SIZE = (96, 128)
LABELS = ["ant", "bee", "cat", "dog"]
GRAPH = ["--graph", "camera.onnx"]


@pytest.fixture(scope="module", params=[1, 3], ids=["gray", "rgb"])
def folder(request, tmp_path_factory):
    """The network, a plan and a graph, a video, and the class of each frame by the whole model."""
    folder = tmp_path_factory.mktemp("camera")
    lens = Equidistant.from_fov(2.9, 60.0)
    options = dict(num_classes=4, depths=(1, 1), num_heads=(1, 2), in_chans=request.param)
    model = create_model("darswin_a_nano", **options, mean=0.4, std=0.2).eval()
    torch.nn.init.normal_(model.head.weight)
    camera.export_network(model, lens, SIZE, folder / "camera.safetensors")
    camera.export_network(model, lens, SIZE, folder / "named.safetensors", labels=LABELS)
    camera.plan(model, lens, SIZE).save(folder / "plan.safetensors")
    images = torch.zeros(1, request.param, *SIZE, dtype=torch.uint8)
    export_onnx(model, folder / "camera.onnx", images, lens, fixed_lens=True, input="tokens")
    dense = create_model("darswin_unet_a_nano", num_classes=2, in_chans=request.param).eval()
    camera.export_network(dense, lens, SIZE, folder / "dense.safetensors")
    classes = []
    write_video(folder / "camera.mp4", count=7, size=SIZE)
    video = cv2.VideoCapture(str(folder / "camera.mp4"))
    while (frame := video.read()[1]) is not None:
        frame = cv2.cvtColor(
            frame, cv2.COLOR_BGR2GRAY if request.param == 1 else cv2.COLOR_BGR2RGB
        ).reshape(1, *SIZE, request.param)
        with torch.inference_mode():
            classes.append(model(torch.from_numpy(frame), lens).argmax().item())
    return folder, classes


def run(folder, *arguments, video="camera.mp4"):
    return subprocess.run(
        [sys.executable, EXAMPLE, video, "--every", "2", *arguments],
        cwd=folder, capture_output=True, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("arguments", [[], ["--network", "named.safetensors"], GRAPH])
def test_classes_are_those_of_the_whole_model(folder, arguments):
    folder, classes = folder
    done = run(folder, "--threads", "2", *arguments)
    assert done.returncode == 0, done.stderr
    names = LABELS if "named.safetensors" in arguments else [*map(str, range(4))]
    found = re.findall(r"frame (\d+): class (\w+)", done.stdout)
    expected = [(str(n), names[best]) for n, best in enumerate(classes)][::2]
    assert found == expected and len(classes) == 7
    assert re.search(r"\d+ frames per second: [\d.]+ ms per frame, [\d.]+ ms at most", done.stdout)


def test_wrong_files_are_explained_in_one_sentence(folder, tmp_path):
    folder, _ = folder
    (tmp_path / "cut.safetensors").write_bytes((folder / "camera.safetensors").read_bytes()[:999])
    (tmp_path / "noise.onnx").write_bytes(b"no graph")
    number = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    same = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
    node = onnx.helper.make_node("Identity", ["x"], ["y"])
    graph = onnx.helper.make_graph([node], "other", [number], [same])
    opset = [onnx.helper.make_opsetid("", 18)]
    onnx.save(
        onnx.helper.make_model(graph, opset_imports=opset, ir_version=9), tmp_path / "other.onnx"
    )
    write_video(tmp_path / "small.mp4", count=2, size=(64, 64))
    for arguments, video, words in [
        (["--network", tmp_path / "cut.safetensors"], "camera.mp4", "cut.safetensors"),
        (["--network", tmp_path / "none.safetensors"], "camera.mp4", "No such file"),
        (["--network", "plan.safetensors"], "camera.mp4", "plan.safetensors"),
        (["--network", "dense.safetensors"], "camera.mp4", "dense.safetensors is no classifier"),
        (
            [*GRAPH, "--plan", tmp_path / "cut.safetensors"],
            "camera.mp4",
            "cut.safetensors is no",
        ),
        ([*GRAPH, "--plan", tmp_path / "none.safetensors"], "camera.mp4", "No such file"),
        (["--graph", tmp_path / "noise.onnx"], "camera.mp4", "no ONNX file"),
        (["--graph", tmp_path / "other.onnx"], "camera.mp4", "no graph of a darswin model"),
        ([], tmp_path / "none.mp4", "cannot read the video"),
        ([], tmp_path / "small.mp4", "(96, 128)"),
        (GRAPH, tmp_path / "small.mp4", r"the plan's size, (H, W) = (96, 128), got (64, 64)"),
    ]:
        done = run(folder, *map(str, arguments), video=str(video))
        assert done.returncode != 0 and "Traceback" not in done.stderr
        assert words in done.stderr, done.stderr


def test_the_example_needs_neither_torch_nor_onnxruntime(folder):
    folder, _ = folder
    code = (
        "import runpy, sys; sys.argv = ['camera.py', 'camera.mp4']; "
        f"runpy.run_path({str(EXAMPLE)!r}, run_name='__main__'); "
        "assert not {'torch', 'onnxruntime'} & sys.modules.keys(); "
        "sys.argv += ['--graph', 'camera.onnx']; "
        f"runpy.run_path({str(EXAMPLE)!r}, run_name='__main__'); "
        "assert 'torch' not in sys.modules and 'onnxruntime' in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, capture_output=True)
    assert frames.Plan.load(folder / "plan.safetensors").output == "tokens"
