"""The ground around a car from four cameras, compared with OpenCV.

`python benchmarks/rig.py [--quick] [--out FOLDER]`. Prints a table and the ratios with their
targets. With a folder, it writes a record and a plot there.

A pixel is one bilinear read of the camera whose axis is nearest, or near a seam that of two. OpenCV
gets its maps and weights in advance, as we get our plan. It remaps each camera's frame in the
rectangle where that camera has weight, multiplies by 8-bit weights, or by masks of 0 and 1 if a
pixel has one read, and adds; or copies through the masks; or, as usual, it remaps four whole
pictures, and NumPy adds them in float32.
"""

import argparse
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from kit.targets import RIG_TARGETS
from kit.timing import OURS, Case, Timing, measure
from peers import run_suite

from darswin.frames import Sampler
from darswin.frames.rig_plans import RigPlan

CAREFUL, COPIED = "OpenCV in rectangles", "OpenCV, copied through masks"
USUAL, ONE_THREAD = "four cv2.remap + NumPy", f"{OURS}, 1 thread"
SIDE, SPAN = 800, 12.0  # px and m of the ground
FRAME = (966, 1280)
FOCAL, BENDS = 400.0, (-0.02, 0.003, -0.0005, 0.0)  # r = f (θ + k₁ θ³ + …), OpenCV's fisheye model
WIDEST = math.radians(95)
DOWN = math.radians(20)
# x forward and y left in m, height, and where each camera looks, in degrees from forward.
CAMERAS = {
    "front": (2.25, 0.0, 0.6, 0), "left": (0.3, 0.9, 1.0, 90),
    "rear": (-2.25, 0.0, 0.9, 180), "right": (0.3, -0.9, 1.0, -90),
}  # fmt: skip
CAR = (4.5, 1.8)
SEAMS = {"hard": 0.0, "narrow": math.radians(4)}  # the width of the ramp between two cameras


class Ground(NamedTuple):
    """Where and with what weights the cameras are read, (4, SIDE, SIDE, 2) and (4, SIDE, SIDE)."""

    places: np.ndarray
    weights: np.ndarray


def ground(ramp: float) -> Ground:
    """The places and weights of the pixels of the ground; the car itself is not seen."""
    meters = (SIDE / 2 - 0.5 - np.mgrid[:SIDE, :SIDE]) * (SPAN / SIDE)
    places, angles = [], []
    for x, y, height, turn in CAMERAS.values():
        side, ahead = np.array((math.sin(turn := math.radians(turn)), -math.cos(turn), 0)), None
        ahead = np.array((math.cos(turn), math.sin(turn), 0)) * math.cos(DOWN)
        ahead[2] = -math.sin(DOWN)
        rays = np.stack((meters[0] - x, meters[1] - y, np.full((SIDE, SIDE), -height)), -1)
        rays = rays @ np.stack((side, np.cross(ahead, side), ahead), 1)
        radius = np.hypot(rays[..., 0], rays[..., 1])
        theta = np.arctan2(radius, rays[..., 2])
        bent = theta * (1 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(BENDS)))
        place = FOCAL * bent[..., None] * rays[..., :2] / radius[..., None].clip(1e-9)
        place += (FRAME[1] / 2 - 0.5, FRAME[0] / 2 - 0.5)
        seen = ((place >= 0) & (place < (FRAME[1] - 1, FRAME[0] - 1))).all(-1) & (theta <= WIDEST)
        places.append(place)
        angles.append(np.where(seen, theta, np.inf))
    angle = np.stack(angles)
    first, second = np.sort(angle, 0)[:2]
    best, far = angle == first, np.full_like(first, np.inf)
    np.subtract(second, first, far, where=np.isfinite(second))
    share = 0.5 - 0.5 * np.minimum(far / ramp, 1) if ramp else np.zeros_like(far)  # of the second
    weights = np.where(best, 1 - share, np.where(angle == second, share, 0))
    weights[:, (np.abs(meters) < np.array(CAR)[:, None, None] / 2).all(0)] = 0
    return Ground(np.stack(places), np.where(np.isfinite(angle), weights, 0))


def plan_of(view: Ground) -> RigPlan:
    """The plan of these places and weights."""
    weights = np.moveaxis(view.weights, 0, -1)
    reads = weights > 0
    x, y = np.moveaxis(np.moveaxis(view.places, 0, -2)[reads], -1, 0)
    return RigPlan(
        counts=reads.sum(-1).astype(np.uint16),
        sources=np.nonzero(reads)[-1].astype(np.uint8),
        columns=np.floor(x).astype(np.int16),
        rows=np.floor(y).astype(np.int16),
        right=(x % 1).astype(np.float32),
        lower=(y % 1).astype(np.float32),
        weights=weights[reads].astype(np.float32),
        sizes=(FRAME,) * len(CAMERAS),
        names=tuple(CAMERAS),
    )


class Part(NamedTuple):
    """What OpenCV needs of a camera: its frame, the rectangle, maps, and weights there."""

    frame: np.ndarray
    rectangle: tuple[slice, slice]
    maps: tuple[np.ndarray, np.ndarray]
    weights: np.ndarray  # (h, w, 3), 0 to 255
    picture: np.ndarray


def careful(view: Ground, frames: list[np.ndarray], copy: bool) -> Callable[[], np.ndarray]:
    """OpenCV in each camera's rectangle, with fixed-point maps; `copy` if each pixel has one."""
    parts, out = [], np.empty((SIDE, SIDE, 3), np.uint8)
    hard = bool((view.weights % 1 == 0).all())
    for frame, places, weights in zip(frames, view.places, view.weights, strict=True):
        rows, columns = (np.flatnonzero((weights > 0).any(axis)) for axis in (1, 0))
        here = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        maps = cv2.convertMaps(places[here].astype(np.float32), None, cv2.CV_16SC2)
        weights = np.rint((1 if hard else 255) * weights[here]).astype(np.uint8)
        channels = weights if copy else np.repeat(weights[..., None], 3, 2)
        parts.append(Part(frame, here, maps, channels, np.empty((*weights.shape, 3), np.uint8)))

    def sample() -> np.ndarray:
        out[:] = 0
        for frame, here, maps, weights, picture in parts:
            cv2.remap(frame, *maps, cv2.INTER_LINEAR, dst=picture)
            if copy:
                cv2.copyTo(picture, weights, out[here])
            else:
                cv2.multiply(picture, weights, picture, 1 if hard else 1 / 255)
                cv2.add(out[here], picture, out[here])
        return out

    return sample


def usual(view: Ground, frames: list[np.ndarray]) -> Callable[[], np.ndarray]:
    """Four remaps of the whole picture with maps of floats, and a blend in float32."""
    maps = [places.astype(np.float32) for places in view.places]
    weights = [one.astype(np.float32)[..., None] for one in view.weights]

    def sample() -> np.ndarray:
        pictures = (
            cv2.remap(frame, one, None, cv2.INTER_LINEAR)
            for frame, one in zip(frames, maps, strict=True)
        )
        blend = sum(one * weight for one, weight in zip(pictures, weights, strict=True))
        return (blend + np.float32(0.5)).astype(np.uint8)

    return sample


def rig(seam: str, seconds: float) -> list[Timing]:
    """Times one seam on as many threads as torch has."""
    threads = torch.get_num_threads()
    cv2.setNumThreads(threads)
    rng = np.random.default_rng(0)
    frames = [
        cv2.GaussianBlur(rng.integers(0, 256, (*FRAME, 3), dtype=np.uint8), (0, 0), 3)
        for _ in CAMERAS
    ]
    view = ground(SEAMS[seam])
    sampler = Sampler(plan_of(view))
    out = sampler(frames)
    runs: dict[str, Callable[[], np.ndarray]] = {
        OURS: lambda: sampler(frames, out, threads),
        CAREFUL: careful(view, frames, copy=False),
        USUAL: usual(view, frames),
    }
    if not SEAMS[seam]:
        runs[COPIED] = careful(view, frames, copy=True)
    for name, run in runs.items():
        off = cv2.absdiff(run(), out)  # OpenCV rounds both parts of a blend, and their weights
        assert off.max() <= 2 and (off > 1).mean() < 1e-4, f"{name} disagrees with ours"
    if threads > 1:
        runs[ONE_THREAD] = lambda: sampler(frames, out, 1)
    reads = len(sampler.plan.weights) / np.count_nonzero(sampler.plan.counts)
    setting = f"four of {FRAME[0]}×{FRAME[1]} → {SIDE}×{SIDE}"
    case = Case("rig", setting, 1, threads, f"{seam} seams, {reads:.2f} reads a pixel")
    targets = RIG_TARGETS[seam] if threads == 1 else {ONE_THREAD: RIG_TARGETS[seam][ONE_THREAD]}
    return measure(case, runs, seconds, targets=targets)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="short runs")
    parser.add_argument("--out", type=Path, help="folder of the record and the plot")
    args = parser.parse_args()
    seconds = 0.2 if args.quick else 2.0
    run_suite("rig", [partial(rig, seam, seconds) for seam in SEAMS], 0.6, out=args.out)


if __name__ == "__main__":
    main()
