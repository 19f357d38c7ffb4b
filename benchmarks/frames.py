"""darswin.frames, compared with cv2.remap and a conversion to normalized float32.

`make bench`, or `python benchmarks/frames.py [--quick] [--out FOLDER]`. Prints a table and the
ratios with their targets. With a folder, it writes a record and a plot there.

OpenCV gets its maps in advance, as we get our plan. They are maps of floats, or its faster
fixed-point maps, which round the weights to 5 bits. The operator `polar_sample` takes the same
frames and gives the same bits as ours. All are called in a loop, and at the pace of a camera: a
frame every 33 ms, and nothing else between.
"""

import argparse
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from kit.timing import DEFAULT, OURS, Case, Timing, measure, measure_paced
from peers import on_torch_threads, run_suite

from darswin.deploy.camera import plan
from darswin.frames import Sampler
from darswin.lens import Equidistant
from darswin.ops import polar_sample
from darswin.views import PolarView

Run = Callable[[], np.ndarray]
FLOAT_MAPS, FIXED_MAPS = "cv2.remap, float maps", "cv2.remap, fixed-point maps"
OPERATOR = "polar_sample"
OPENCV_THREADS = cv2.getNumThreads()  # its own choice
MEAN, STD = (0.45, 0.46, 0.41), (0.22, 0.23, 0.22)
# The size of the frames, and the rings and sectors of tokens of 4×4 samples. The last case is the
# cost of a call.
CASES = [
    ((256, 256), 16, 64),
    ((1080, 1920), 64, 256),
    ((1080, 1920), 8, 32),
    ((64, 64), 1, 1),
]


def opencv(frame: np.ndarray, places: np.ndarray, fixed: bool) -> Run:
    """A function that samples with OpenCV, and converts to normalized float32."""
    maps = cv2.convertMaps(places, None, cv2.CV_16SC2) if fixed else (places, None)
    picture = np.empty((*places.shape[:2], 3), np.uint8)
    result = np.empty(picture.shape, np.float32)
    mean = (*(255 * value for value in MEAN), 0)
    scale = (*(1 / (255 * value) for value in STD), 0)

    def sample() -> np.ndarray:
        cv2.remap(frame, *maps, cv2.INTER_LINEAR, dst=picture)
        cv2.subtract(picture, mean, result, None, cv2.CV_32F)
        return cv2.multiply(result, scale, result)

    return sample


def on_opencv_threads(run: Run) -> Callable[[int], Run]:
    """A function for each number of threads, `DEFAULT` included, that calls `run` on so many of
    OpenCV's."""

    def on(threads: int) -> Run:
        def sample() -> np.ndarray:
            if cv2.getNumThreads() != (count := threads or OPENCV_THREADS):
                cv2.setNumThreads(count)  # only before the first frame of a turn
            return run()

        return sample

    return on


def frames(
    size: tuple[int, int], rings: int, sectors: int, seconds: float, *, paced: bool
) -> list[Timing]:
    """Times one case: a polar picture, with channels last as in OpenCV."""
    threads = torch.get_num_threads()
    cv2.setNumThreads(threads)
    rng = np.random.default_rng(0)
    frame = cv2.GaussianBlur(rng.integers(0, 256, (*size, 3), dtype=np.uint8), (0, 0), 2)
    lens = Equidistant.from_fov(math.radians(180), min(size) / 2 - 1)
    layer = PolarView(rings, sectors, (4, 4), layout="image", mean=MEAN, std=STD).eval()
    image = plan(layer, lens, size)
    sampler = Sampler(plan(layer, lens, size, output="tokens"))
    places = np.stack((image.columns + image.right, image.rows + image.lower), -1)
    places = places.astype(np.float32)
    images = torch.from_numpy(frame)[None]
    arguments = layer.arguments(images, layer.grid(lens, size)) | dict(channels_last=True)
    out = sampler(frame)

    def operator() -> torch.Tensor:
        with torch.inference_mode():
            return polar_sample(**arguments, layout="tokens")

    candidates: dict[str, Run] = {
        OURS: lambda: sampler(frame, out, threads),
        FLOAT_MAPS: opencv(frame, places, fixed=False),
        FIXED_MAPS: opencv(frame, places, fixed=True),
        OPERATOR: operator,
    }
    expected = operator()[0].numpy()
    assert np.array_equal(out, expected), "the sampler disagrees with the operator"
    picture = Sampler(image)(frame).transpose(1, 2, 0)
    for name in (FLOAT_MAPS, FIXED_MAPS):
        assert np.abs(candidates[name]() - picture).max() < 0.2, f"{name} disagrees with ours"
    setting = f"{size[0]}×{size[1]} → {4 * rings}×{4 * sectors}"
    what = "uint8 RGB → normalized float32"
    if paced:
        on = {name: on_opencv_threads(candidates[name]) for name in (FLOAT_MAPS, FIXED_MAPS)}
        ours = {OURS: lambda count: lambda: sampler(frame, out, count or 1)}
        theirs = {OPERATOR: on_torch_threads(operator)}
        return measure_paced(Case("frames", setting, 1, DEFAULT, what), ours | on | theirs, seconds)
    targets = {FLOAT_MAPS: 1.1, FIXED_MAPS: 0.95} if rings > 1 else None
    case = Case("frames", setting, 1, threads, f"forward, {what}")
    return measure(case, candidates, seconds, targets=targets)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one small case, short runs")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    loop_seconds, paced_seconds = (0.05, 0.2) if args.quick else (1.0, 3.5)
    cases = CASES[:1] if args.quick else CASES
    loops = [partial(frames, *case, loop_seconds, paced=False) for case in cases]
    at_pace = [partial(frames, *case, paced_seconds, paced=True) for case in cases]
    run_suite("frames", loops, 0.6, out=args.out, paced=at_pace)


if __name__ == "__main__":
    main()
