"""Whole models on one camera's frames, against ONNX Runtime, OpenVINO and AOTInductor.

`make bench`, or `python benchmarks/one_frame.py [--quick] [--models FOLDER] [--out FOLDER]`. Each
runtime gets the same model with the same fixed lens. OpenVINO takes part where it is installed.
Prints tables and each ratio against its target; with a folder, writes a record and a plot there.

In a loop, all have the same number of threads. At the pace of a camera, a frame every 33 ms and
nothing else between, they also run with the threads that they choose themselves. Two models also
start from the camera's frame, and in a process of their own.
"""

import argparse
import importlib.util
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import onnxruntime
import torch
from kit.candidates import lens_of, network
from kit.machine import on_other_tiers
from kit.start import Start
from kit.start import measure as measure_start
from kit.timing import DEFAULT, OURS, Case, Timing, measure, measure_paced
from peers import Step, check, compare, forward, on_torch_threads, run_suite
from torch import Tensor

from darswin import frames, lens, optimize
from darswin.deploy.camera import export_network
from darswin.deploy.camera import plan as plan_of
from darswin.deploy.export import export_onnx, export_package
from darswin.deploy.quantize import quantize_model
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.ops import _module

Run = Callable[[Tensor], Tensor]
EAGER, ANY_LENS = "eager model", "optimize, any lens"
ONNX_RUNTIME, OPENVINO, AOTI = "ONNX Runtime", "OpenVINO", "AOTInductor package"
OPTIMIZE, SAMPLER = "optimize", "Sampler + ONNX Runtime"
FIXED = "float32, fixed lens"
AVX2 = "avx2"  # the tier of CPUs without AVX-512
EXAMPLES = Path(__file__).parent.parent / "examples"
# The side of the images, and the least ratios to ONNX Runtime and to AOTInductor for one frame.
MODELS = {
    "darswin_a_nano": (64, {ONNX_RUNTIME: 1.3, AOTI: 1.0}),
    "darswin_a_micro": (64, {ONNX_RUNTIME: 1.1}),
    "darswin_a_small": (64, {ONNX_RUNTIME: 1.1}),
    "darswin_unet_ra_nano": (128, {ONNX_RUNTIME: 1.9}),
    "conv_unet_nano": (128, {ONNX_RUNTIME: 1.0}),
}
# The least ratios of a sampler and ONNX Runtime to `darswin.frames.Network`, on one thread.
FROM_FRAME = {"darswin_a_nano": 1 / 0.6, "darswin_a_micro": 1 / 0.75}
# What a program without torch does until its first answer.
FRAME = """
import numpy as np
frame = np.full({}, 128, np.uint8)
"""
OUR_START = """
from darswin.frames import Network
Network({!r})(frame)
"""
THEIR_START = """
import onnxruntime
from darswin.frames import Sampler
session = onnxruntime.InferenceSession({!r}, providers=["CPUExecutionProvider"])
session.run(None, {{"tokens": Sampler({!r})(frame)[None]}})
"""


@cache
def model_of(name: str, size: int) -> Model:
    """The model of all candidates."""
    return network(name, size).eval()


def exported(folder: Path, kind: str, name: str, size: int, model: Model) -> str:
    """The path of a model's file of a kind, "onnx" or "pt2"; it is written if missing."""
    path = folder / f"{name}.{kind}"
    if not path.exists():
        images, lens = torch.randn(1, 3, size, size), lens_of(size)
        start = time.perf_counter()
        if kind == "onnx":
            has_vnni = _module.byte_products() != "pairs"  # a file for VNNI is wrong elsewhere
            export_onnx(model, path, images, lens, fixed_lens=True, vnni_only=has_vnni)
        else:
            export_package(model, path, images, lens, fixed_lens=True)
        print(f"{path.name}: exported in {time.perf_counter() - start:.1f} s")
    return str(path)


def session_of(path: str, threads: int) -> onnxruntime.InferenceSession:
    """A file in ONNX Runtime, where 0 threads are its default too."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def onnx_runtime(path: str, threads: int) -> Run:
    session = session_of(path, threads)
    name = session.get_inputs()[0].name
    return lambda images: torch.from_numpy(session.run(None, {name: images.numpy()})[0])


def openvino(path: str, threads: int) -> Run:
    """The model of a file in OpenVINO, in float32."""
    import openvino

    settings: dict[str, object] = {"INFERENCE_PRECISION_HINT": "f32"}
    if threads != DEFAULT:
        settings |= {"INFERENCE_NUM_THREADS": threads, "PERFORMANCE_HINT": "LATENCY"}
    compiled = openvino.Core().compile_model(path, "CPU", settings)
    return lambda images: torch.from_numpy(compiled([images.numpy()])[0])


def has_openvino() -> bool:
    return importlib.util.find_spec("openvino") is not None


def one_frame(name: str, batch: int, folder: Path, seconds: float) -> list[Timing]:
    """Times a model on batches of one size, in a loop."""
    size, least = MODELS[name]
    model, camera, threads = model_of(name, size), lens_of(size), torch.get_num_threads()
    images = torch.randn(batch, 3, size, size)
    any_lens = optimize(model)
    onnx = exported(folder, "onnx", name, size, model)
    candidates: dict[str, Run] = {
        OURS: optimize(model, lens=camera),
        ANY_LENS: lambda images: any_lens(images, camera),
        EAGER: lambda images: model(images, camera),
        ONNX_RUNTIME: onnx_runtime(onnx, threads),
        AOTI: torch._inductor.aoti_load_package(exported(folder, "pt2", name, size, model)),
    }
    if has_openvino():
        candidates[OPENVINO] = openvino(onnx, threads)
    case = Case(name, f"{size}×{size}", batch, threads, f"forward, {FIXED}")
    targets = {EAGER: 1.05} | (least if batch == 1 else {})
    timings = compare(case, candidates, [images], seconds, targets=targets, tolerance=1e-3)
    if has_int8(name):
        quantized = quantize_model(model, [(images, camera)])
        onnx = exported(folder, "onnx", f"{name}_int8", size, quantized)
        runs = {
            OURS: optimize(quantized, torch.int8, lens=camera),
            "float32": candidates[OURS],
            ONNX_RUNTIME: onnx_runtime(onnx, threads),
        }
        # OpenVINO 2026.4 cannot compile the 8-bit file of darswin_a_micro.
        case.mode = "forward, int8, fixed lens"
        steps = {name: forward(run, [images]) for name, run in runs.items()}
        timings += measure(case, steps, seconds, targets={"float32": 1.5})
        del steps[ONNX_RUNTIME]
        if AVX2 in on_other_tiers(steps[OURS]):
            case.mode += f", {AVX2}"
            steps = {name: on_other_tiers(step)[AVX2] for name, step in steps.items()}
            timings += measure(case, steps, seconds, targets={"float32": 1.4})
    return timings


def has_int8(name: str) -> bool:
    """True for the models that are timed with 8 bits too."""
    return name in ("darswin_a_small", "darswin_a_micro")


def paced(name: str, folder: Path, seconds: float) -> list[Timing]:
    """Times a model on one image at the pace of a camera."""
    size, _ = MODELS[name]
    model, camera, images = model_of(name, size), lens_of(size), torch.randn(1, 3, size, size)

    def of_torch(run: Run) -> Callable[[int], Step]:
        return on_torch_threads(forward(run, [images]))

    def of_runtime(runtime: Callable[[str, int], Run], path: str) -> Callable[[int], Step]:
        return lambda threads: forward(runtime(path, threads), [images])

    onnx, package = (exported(folder, kind, name, size, model) for kind in ("onnx", "pt2"))
    candidates = {
        OURS: of_torch(optimize(model, lens=camera)),
        ONNX_RUNTIME: of_runtime(onnx_runtime, onnx),
        AOTI: of_torch(torch._inductor.aoti_load_package(package)),
    }
    if has_openvino():
        candidates[OPENVINO] = of_runtime(openvino, onnx)
    case = Case(name, f"{size}×{size}", 1, DEFAULT, FIXED)
    check(case, {of: run(DEFAULT) for of, run in candidates.items()}, 1e-3)
    timings = measure_paced(case, candidates, seconds)
    if has_int8(name):
        quantized = quantize_model(model, [(images, camera)])
        onnx = exported(folder, "onnx", f"{name}_int8", size, quantized)
        candidates = {
            OURS: of_torch(optimize(quantized, torch.int8, lens=camera)),
            ONNX_RUNTIME: of_runtime(onnx_runtime, onnx),
        }
        case.mode = "int8, fixed lens"
        timings += measure_paced(case, candidates, seconds)
    return timings


class Camera(NamedTuple):
    """A model, a camera with one of its frames, and the files of the camera's programs."""

    model: Model
    lens: Lens
    frame: np.ndarray  # RGB
    network: str
    plan: str  # with the graph, for `SAMPLER`
    graph: str


@cache
def camera_of(name: str, folder: Path) -> Camera:
    model, camera = model_of(name, MODELS[name][0]), lens.load(EXAMPLES / "room.json")
    frame = cv2.imread(str(EXAMPLES / "room.jpg"))[..., ::-1].copy()
    network, plan, graph = (
        str(folder / f"{name}.{kind}")
        for kind in ("network.safetensors", "plan.safetensors", "tokens.onnx")
    )
    size = frame.shape[:2]
    export_network(model, camera, size, network)
    plan_of(model, camera, size).save(plan)
    images = torch.from_numpy(frame)[None]
    export_onnx(model, graph, images, camera, fixed_lens=True, input="tokens")
    return Camera(model, camera, frame, network, plan, graph)


def from_frame(name: str, folder: Path, seconds: float) -> list[Timing]:
    """Times a model from the frame of a camera to its answer, at the camera's pace."""
    camera = camera_of(name, folder)
    frame, images = camera.frame, torch.from_numpy(camera.frame)[None]
    network, sampler = frames.Network(camera.network), frames.Sampler(camera.plan)

    def ours(threads: int) -> Callable[[], np.ndarray]:
        return lambda: network(frame, threads=threads or 1)

    def sampler_and_graph(threads: int) -> Callable[[], np.ndarray]:
        session = session_of(camera.graph, threads)
        # The default number of threads of samplers and networks is 1.
        return lambda: session.run(None, {"tokens": sampler(frame, None, threads or 1)[None]})[0]

    optimized = forward(optimize(camera.model, lens=camera.lens), [images])
    (logits,) = optimized()
    probabilities = logits[0].softmax(-1).numpy()
    assert np.abs(network(frame) - probabilities).max() < 1e-4, "the network disagrees"
    assert np.abs(sampler_and_graph(1)() - logits.numpy()).max() < 1e-3, "the graph disagrees"
    candidates = {
        OURS: ours, OPTIMIZE: on_torch_threads(optimized), SAMPLER: sampler_and_graph,
    }  # fmt: skip
    height, width, _ = frame.shape
    case = Case(name, f"{height}×{width}", 1, DEFAULT, "float32, from an uint8 frame")
    return measure_paced(case, candidates, seconds, targets={SAMPLER: FROM_FRAME[name]})


def starts(name: str, folder: Path) -> list[Start]:
    """Measures a program's first answer, which needs no torch."""
    camera = camera_of(name, folder)
    frame = FRAME.format(camera.frame.shape)
    programs = {
        OURS: OUR_START.format(camera.network),
        SAMPLER: THEIR_START.format(camera.graph, camera.plan),
    }
    return [measure_start(name, runtime, frame + code) for runtime, code in programs.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the smallest model, short runs")
    parser.add_argument("--models", type=Path, help="folder that keeps the exported models")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    torch.manual_seed(0)
    loop_seconds, paced_seconds = (0.05, 0.2) if args.quick else (0.7, 3.5)
    folder = args.models or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    names, cameras = list(MODELS), list(FROM_FRAME)
    if args.quick:
        names, cameras = names[:1], cameras[:1]
    loops = [
        partial(one_frame, name, batch, folder, loop_seconds)
        for name in names
        for batch in ((1,) if args.quick else (1, 8))
    ]
    at_pace = [partial(paced, name, folder, paced_seconds) for name in names]
    at_pace += [partial(from_frame, name, folder, paced_seconds) for name in cameras]
    run_suite(
        "one_frame", loops, avx2_share=0.6, out=args.out,
        paced=at_pace, starts=[partial(starts, name, folder) for name in cameras],
    )  # fmt: skip


if __name__ == "__main__":
    main()
