"""Whole models on one camera's frames, against ONNX Runtime, OpenVINO and AOTInductor.

`make bench`, or `python benchmarks/one_frame.py [--quick] [--models FOLDER] [--out FOLDER]`. Each
runtime gets the same model with the same fixed lens and the same number of threads. OpenVINO takes
part where it is installed. Prints a table and each ratio against its target; with a folder, writes
a record and a plot there.
"""

import argparse
import importlib.util
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import torch
from peers import compare, forward, run_suite
from torch import Tensor

from darswin import optimize
from darswin.bench.candidates import lens_of, network
from darswin.bench.timing import OURS, Case, Timing, measure
from darswin.deploy.export import export_onnx, export_package
from darswin.deploy.quantize import quantize_model
from darswin.layers.linear import onednn_lack
from darswin.models.base import Model

Run = Callable[[Tensor], Tensor]
EAGER, ANY_LENS = "eager model", "optimize, any lens"
ONNX_RUNTIME, OPENVINO, AOTI = "ONNX Runtime", "OpenVINO", "AOTInductor package"
# The side of the images, and the least ratios to ONNX Runtime and to AOTInductor for one frame.
MODELS = {
    "darswin_a_nano": (64, {ONNX_RUNTIME: 1.3, AOTI: 1.0}),
    "darswin_a_micro": (64, {ONNX_RUNTIME: 1.1}),
    "darswin_a_small": (64, {ONNX_RUNTIME: 1.1}),
    "darswin_unet_a_nano": (128, {ONNX_RUNTIME: 1.5}),
}


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
            export_onnx(model, path, images, lens, fixed_lens=True, vnni_only=True)
        else:
            export_package(model, path, images, lens, fixed_lens=True)
        print(f"{path.name}: exported in {time.perf_counter() - start:.1f} s")
    return str(path)


def onnx_runtime(path: str) -> Run:
    """The model of a file in ONNX Runtime, on as many threads as torch."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    return lambda images: torch.from_numpy(session.run(None, {name: images.numpy()})[0])


def openvino(path: str) -> Run:
    """The model of a file in OpenVINO, on as many threads as torch, in float32."""
    import openvino

    settings = {
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_PRECISION_HINT": "f32",
    }
    compiled = openvino.Core().compile_model(path, "CPU", settings)
    return lambda images: torch.from_numpy(compiled([images.numpy()])[0])


def one_frame(name: str, batch: int, folder: Path, seconds: float) -> list[Timing]:
    """Times a model on batches of one size."""
    size, least = MODELS[name]
    model, lens = model_of(name, size), lens_of(size)
    images = torch.randn(batch, 3, size, size)
    any_lens = optimize(model)
    onnx = exported(folder, "onnx", name, size, model)
    candidates: dict[str, Run] = {
        OURS: optimize(model, lens=lens),
        ANY_LENS: lambda images: any_lens(images, lens),
        EAGER: lambda images: model(images, lens),
        ONNX_RUNTIME: onnx_runtime(onnx),
        AOTI: torch._inductor.aoti_load_package(exported(folder, "pt2", name, size, model)),
    }
    if importlib.util.find_spec("openvino"):
        candidates[OPENVINO] = openvino(onnx)
    case = Case(
        name, f"{size}×{size}", batch, torch.get_num_threads(), "forward, float32, fixed lens"
    )
    targets = {EAGER: 1.05} | (least if batch == 1 else {})
    timings = compare(case, candidates, [images], seconds, targets=targets, tolerance=1e-3)
    if onednn_lack(torch.int8) is None and name in ("darswin_a_small", "darswin_a_micro"):
        quantized = quantize_model(model, [(images, lens)])
        onnx = exported(folder, "onnx", f"{name}_int8", size, quantized)
        runs = {
            OURS: optimize(quantized, torch.int8, lens=lens),
            "float32": candidates[OURS],
            ONNX_RUNTIME: onnx_runtime(onnx),
        }
        # OpenVINO 2026.4 cannot compile the 8-bit file of darswin_a_micro.
        case.mode = "forward, int8, fixed lens"
        # Not on the other tiers: they would need another optimized model.
        steps = {name: forward(run, [images]) for name, run in runs.items()}
        timings += measure(case, steps, seconds, targets={"float32": 1.5})
    return timings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the smallest model, short runs")
    parser.add_argument("--models", type=Path, help="folder that keeps the exported models")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    torch.manual_seed(0)
    seconds = 0.05 if args.quick else 1.0
    folder = args.models or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [
        partial(one_frame, name, batch, folder, seconds)
        for name in list(MODELS)[: 1 if args.quick else None]
        for batch in ((1,) if args.quick else (1, 8))
    ]
    run_suite("one_frame", jobs, avx2_share=0.6, out=args.out)


if __name__ == "__main__":
    main()
