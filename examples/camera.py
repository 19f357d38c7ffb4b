"""Classifies the frames of a video without torch, and prints the classes and the speed.

    python examples/camera.py VIDEO [--network camera.safetensors] [--threads N] [--every N]

Only NumPy, OpenCV and darswin.frames run here. The file is made once, where torch is installed. The
frames of the video must have its size:

    from darswin.deploy.camera import export_network, plan

    model, card = darswin.models.load_model("runs/camera/checkpoints/best.safetensors")
    lens = darswin.lens.load("calibration.json")
    export_network(model, lens, (1080, 1920), "camera.safetensors")

ONNX Runtime can run the network instead: `--graph camera.onnx --plan plan.safetensors`. The files:

    plan(model, lens, (1080, 1920)).save("plan.safetensors")
    images = torch.zeros(1, 3, 1080, 1920, dtype=torch.uint8)
    export_onnx(model, "camera.onnx", images, lens, fixed_lens=True, input="tokens")
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from darswin.frames import Network, Sampler


class Classifier(NamedTuple):
    run: Callable[[np.ndarray], np.ndarray]  # from a frame to a score for each class
    gray: bool  # whether the frames are gray
    labels: Sequence[str] = ()


def by_darswin(path: str, threads: int) -> Classifier:
    """The network in a file of `darswin.deploy.camera.export_network`."""
    network = Network(path)
    if [len(shape) for shape in network.shapes] != [1]:
        sys.exit(f"{path} is no classifier: it returns arrays of the shapes {network.shapes}")
    return Classifier(
        lambda frame: network(frame, threads=threads), network.channels == 1, network.labels
    )


def by_onnx_runtime(graph: str, plan: str, threads: int) -> Classifier:
    """The graph in a file of `export_onnx(..., input="tokens")`, on the samples of a plan."""
    import onnxruntime

    sampler, options = Sampler(plan), onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    try:
        session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class of its own for each kind of failure
        sys.exit(f"{graph} is no ONNX file that onnxruntime can run: {error}")
    if [put.name for put in session.get_inputs()] != ["tokens"]:
        sys.exit(f'{graph} is no graph of a darswin model: write it with input="tokens"')

    def run(frame: np.ndarray) -> np.ndarray:
        (logits,) = session.run(["logits"], {"tokens": sampler(frame, threads=threads)[None]})
        return logits[0]

    # A token has the samples of one channel or of three.
    return Classifier(run, session.get_inputs()[0].shape[-1] == sampler.plan.right[0, 0].size)


def frames_of(path: str, gray: bool) -> Iterator[np.ndarray]:
    """The frames of a video: (H, W, 3), RGB, or (H, W)."""
    video = cv2.VideoCapture(path)
    if not video.isOpened():
        sys.exit(f"cannot read the video {path}")
    while True:
        found, frame = video.read()
        if not found:
            return
        # Network and sampler read BGR as RGB: the order of the channels is only a stride.
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if gray else frame[..., ::-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("video", help="a video file")
    parser.add_argument("--network", default="camera.safetensors", help="a file of export_network")
    parser.add_argument("--graph", help="a file of `export_onnx`, for ONNX Runtime")
    parser.add_argument("--plan", default="plan.safetensors", help="with a graph: its plan")
    parser.add_argument("--threads", type=int, default=1, help="the most threads to use")
    parser.add_argument("--every", type=int, default=30, help="print every N-th frame's class")
    args = parser.parse_args()
    try:
        if args.graph is None:
            classifier = by_darswin(args.network, args.threads)
        else:
            classifier = by_onnx_runtime(args.graph, args.plan, args.threads)
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    seconds = []
    for frame in frames_of(args.video, classifier.gray):
        start = time.perf_counter()
        try:
            best = int(classifier.run(frame).argmax())
        except ValueError as error:
            sys.exit(f"{args.video}: {error}")
        seconds.append(time.perf_counter() - start)
        if (number := len(seconds) - 1) % args.every == 0:
            name = classifier.labels[best] if classifier.labels else best
            print(f"frame {number}: class {name}")
    if not seconds:
        sys.exit(f"{args.video} has no frames")
    mean, longest = 1e3 * np.mean(seconds), 1e3 * np.max(seconds)
    print(f"{1e3 / mean:.0f} frames per second: {mean:.2f} ms per frame, {longest:.2f} ms at most")


if __name__ == "__main__":
    main()
