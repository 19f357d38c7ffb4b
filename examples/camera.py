"""Classifies the frames of a video without torch, and prints the classes and the speed.

    python examples/camera.py VIDEO --plan camera.npz --graph camera.onnx [--threads N] [--every N]

Only NumPy, OpenCV, onnxruntime and darswin.frames run here. The two files are made once, where
torch is installed. The frames of the video must have the size of the plan:

    model, card = darswin.models.load_model("runs/camera/checkpoints/best.safetensors")
    lens = darswin.lens.load("calibration.json")
    darswin.frames.plan(model, lens, (1080, 1920)).save("camera.npz")
    images = torch.zeros(1, 3, 1080, 1920, dtype=torch.uint8)
    export_onnx(model, "camera.onnx", images, lens, fixed_lens=True, input="tokens")
"""

import argparse
import sys
import time
from collections.abc import Iterator

import cv2
import numpy as np
import onnxruntime

from darswin.frames import Sampler


def session_of(path: str, threads: int) -> onnxruntime.InferenceSession:
    """The graph in a file of `export_onnx(..., input="tokens")`."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class of its own for each kind of failure
        sys.exit(f"{path} is no ONNX file that onnxruntime can run: {error}")
    if [put.name for put in session.get_inputs()] != ["tokens"]:
        sys.exit(f'{path} is no graph of a darswin model: write it with input="tokens"')
    return session


def frames_of(path: str, gray: bool) -> Iterator[np.ndarray]:
    """The frames of a video: (H, W, 3), RGB, or (H, W)."""
    video = cv2.VideoCapture(path)
    if not video.isOpened():
        sys.exit(f"cannot read the video {path}")
    while True:
        found, frame = video.read()
        if not found:
            return
        # The sampler reads BGR as RGB: the order of the channels is only a stride.
        yield cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY) if gray else frame[..., ::-1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("video", help="a video file")
    parser.add_argument("--plan", default="camera.npz", help="the file of `darswin.frames.plan`")
    parser.add_argument("--graph", default="camera.onnx", help="the file of `export_onnx`")
    parser.add_argument("--threads", type=int, default=1, help="threads of sampler and network")
    parser.add_argument("--every", type=int, default=30, help="print every N-th frame's class")
    args = parser.parse_args()
    try:
        sampler = Sampler(args.plan)
    except (ValueError, OSError) as error:
        sys.exit(str(error))
    session = session_of(args.graph, args.threads)
    # A token has the samples of one channel or of three.
    gray = session.get_inputs()[0].shape[-1] == sampler.plan.right[0, 0].size
    sampling, network, count = 0.0, 0.0, 0
    for frame in frames_of(args.video, gray):
        start = time.perf_counter()
        try:
            tokens = sampler(frame, threads=args.threads)
        except ValueError as error:
            sys.exit(f"{args.video}: {error}")
        sampled = time.perf_counter()
        (logits,) = session.run(["logits"], {"tokens": tokens[None]})
        sampling, network = sampling + sampled - start, network + time.perf_counter() - sampled
        if count % args.every == 0:
            print(f"frame {count}: class {logits.argmax()}")
        count += 1
    if not count:
        sys.exit(f"{args.video} has no frames")
    sampling, network = 1e3 * sampling / count, 1e3 * network / count  # ms per frame
    print(
        f"{1e3 / (sampling + network):.0f} frames per second: "
        f"sampling {sampling:.2f} ms, network {network:.2f} ms per frame"
    )


if __name__ == "__main__":
    main()
