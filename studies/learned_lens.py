"""Learns lenses: finds an unknown lens's parameters by gradient descent on images taken with it.

A classifier is trained on clothes seen through lenses of every ξ in [0, 1], and then frozen. A
camera takes pictures of other clothes, and some parameters of its lens are unknown:

- "xi": ξ is unknown. The circle of the field of view is known, as in cameras that show its border.
- "place": the focal length and the principal point are unknown; ξ is known.
- "all": ξ, the focal length and the principal point are unknown.

From random values, Adam descends a loss of the classifier on the camera's images. Every lens has
the same field of view, 165°. The focal length is learned as the radius of the circle that this view
fills. The images do not show the border of the circle, because the clothes are on black.

The results of every camera are kept under `--out`, so a study that was stopped can go on. Run it
with `make learned-lens`.
"""

import argparse
import json
import math
import os
import time
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jobs import printing_to, run_all, use_one_core
from learned_problems import GRID, IMAGES, LOSSES, PROBLEMS, STARTS
from learned_tables import collect
from torch import Tensor

from darswin.cli.main import main as darswin
from darswin.data import open_source
from darswin.lens import Lens, Perspective, Spherical
from darswin.models import DarSwin
from darswin.models.saving import load_model, model_of_run
from darswin.utils.files import replace_file
from darswin.views import CameraView

HERE = Path(__file__).parent
FOV, SIZE, RENDER = (
    math.radians(165),
    32,
    96,
)  # rad; px, the size of the images and before their reduction
STD = 0.5  # of the pixels; the mean is 0, so that black pixels are like those outside an image
CONFIG = [
    "--config", str(HERE / "fashion_mnist.yaml"), "--model.name", "darswin_a_nano",
    "--data.train_lenses", "0..1", "--data.fov_deg", "165", "--data.mean", "[0.0]",
    "--data.std", f"[{STD}]", "--trainer.max_epochs", "5", "--seed_everything", "0",
]  # fmt: skip

KNOWN = dict(xi=0.5, radius=SIZE / 2, x=(SIZE - 1) / 2, y=(SIZE - 1) / 2)
# Truths and starts are uniform in these; descent may go as far as the bounds.
RANGES = dict(xi=(0.0, 1.0), radius=(11.0, 16.0), x=(13.0, 18.0), y=(13.0, 18.0))
BOUNDS = dict(xi=(0.0, 1.5), radius=(8.0, 20.0), x=(10.0, 21.0), y=(10.0, 21.0))

BATCH = 32  # images a step
STEPS = dict(xi=40, place=80, all=80)
RATE = 0.06  # Adam's, in parts of a range; falls to 0 as a cosine
TESTED = 200  # other images of each camera, for the accuracy
SEARCHED = 128  # images that a search evaluates the losses on
USUAL = 1000  # training pictures that the usual statistics are taken on


# -- cameras and their images -----------------------------------------------------------------


def lens_of(values: dict[str, Tensor | float]) -> Spherical:
    """The lens of `xi`, `radius`, `x` and `y`."""
    xi, radius, x, y = (torch.as_tensor(values[name], dtype=torch.float32) for name in KNOWN)
    return Spherical.from_fov(xi, FOV, radius, center=torch.stack((x, y)))


def draw(rng: np.random.Generator, problem: str) -> dict[str, float]:
    """Random values of the unknown parameters."""
    return {name: float(rng.uniform(*RANGES[name])) for name in PROBLEMS[problem]}


def photograph(pictures: np.ndarray, lens: Lens) -> Tensor:
    """Images (N, 1, SIZE, SIZE) of pictures (N, H, W) uint8 through a lens, as in `WideAngle`."""
    camera = Perspective.from_fov(FOV, pictures.shape[1] / 2)
    large = lens.resized(RENDER / SIZE)
    remap = CameraView(large, (RENDER, RENDER), supersampling=1).at(camera, pictures.shape[1:])
    images = [cv2.resize(remap(p), (SIZE, SIZE), interpolation=cv2.INTER_AREA) for p in pictures]
    return torch.from_numpy(np.stack(images))[:, None].float() / (255 * STD)


@cache
def pictures(data: str, split: str, count: int) -> tuple[np.ndarray, Tensor]:
    """The shuffled pictures (N, H, W) of a split, and their labels."""
    source = open_source(data, split, channels=1)
    order = np.random.default_rng(0).permutation(len(source))[:count]
    images, labels = zip(*(source[int(k)] for k in order), strict=True)
    return np.stack(images)[..., 0], torch.tensor(labels)


def distance(found: Lens, true: Lens) -> float:
    """The distance between a ray's places in two lenses, px, RMS over equal steps of θ and φ."""
    theta = torch.linspace(0, FOV / 2, 33)[None, 1:, None]
    phi = torch.arange(16)[None, None] * (math.pi / 8)
    apart = found.project_rays(theta, phi) - true.project_rays(theta, phi)
    return apart.square().sum(-1).mean().sqrt().item()


# -- losses -----------------------------------------------------------------------------------

Usual = tuple[Tensor, Tensor]


@torch.no_grad()
def usual_map(model: DarSwin, data: str) -> Usual:
    """The mean and variance (R, A, D) of the first stage's map on training pictures."""
    rng, maps = np.random.default_rng(0), []
    for picture in pictures(data, "train", USUAL)[0]:
        lens = lens_of(KNOWN | draw(rng, "xi"))
        image = photograph(picture[None], lens)
        maps += model.forward_intermediates(image, lens, indices=[0], intermediates_only=True)
    together = torch.cat(maps)
    return together.mean(0), together.var(0)


def losses(
    model: DarSwin, images: Tensor, labels: Tensor, lens: Lens, usual: Usual
) -> dict[str, Tensor]:
    """The losses of the model with a lens on its images.

    - "labels": cross-entropy.
    - "entropy": the entropy of the prediction for each image; no labels, as in the next two.
    - "information": the entropy minus the entropy of the mean prediction, so that the predictions
      do not all become equal.
    - "statistics": the difference of the first stage's map from its mean and variance in training,
      at each place.

    Source: entropy, Wang et al., ICLR 2021; information, Liang, Hu and Feng, ICML 2020;
    statistics, after Mirza et al., CVPR 2023.
    """
    features, (first,) = model.forward_intermediates(images, lens, indices=[0])
    log = F.log_softmax(model.forward_head(features), -1)
    mean = log.exp().mean(0)
    entropy = -(log.exp() * log).sum(-1).mean()
    usual_mean, usual_var = usual
    var = first.var(0).clamp(min=1e-6)
    shift = (first.mean(0) - usual_mean).square() / usual_var
    return {
        "labels": F.nll_loss(log, labels),
        "entropy": entropy,
        "information": entropy + (mean * mean.clamp(min=1e-12).log()).sum(),
        "statistics": (shift + (var / usual_var).log().square() / 2).mean(),
    }


# -- one camera -------------------------------------------------------------------------------


def descend(
    model: DarSwin,
    images: Tensor,
    labels: Tensor,
    usual: Usual,
    loss: str,
    values: dict[str, float],
    start: dict[str, float],
    steps: int,
    seed: int,
) -> list[dict[str, float]]:
    """The values of the unknown parameters after each step from `start`."""
    torch.manual_seed(seed)
    unknown = {name: torch.tensor(value, requires_grad=True) for name, value in start.items()}
    optimizer = torch.optim.Adam(
        [
            dict(params=[value], lr=RATE * (RANGES[name][1] - RANGES[name][0]))
            for name, value in unknown.items()
        ],
        betas=(0.8, 0.95),
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    path = [start]
    model.view.train()  # jitter smooths the loss
    for _ in range(steps):
        batch = torch.randperm(len(images))[:BATCH]
        found = losses(model, images[batch], labels[batch], lens_of(values | unknown), usual)
        optimizer.zero_grad()
        found[loss].backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            for name, value in unknown.items():
                value.clamp_(*BOUNDS[name])
        path.append({name: value.item() for name, value in unknown.items()})
    model.view.eval()
    return path


def run_camera(problem: str, camera: int, out: Path, data: str) -> dict:
    """Finds one camera's lens with every method, or reads the results of an earlier run."""
    file = out / f"{problem}-{camera}.json"
    if file.exists():
        return json.loads(file.read_text())
    model = load_model(model_of_run(out / "model"))[0].requires_grad_(False)
    usual = tuple(torch.load(out / "usual.pt", weights_only=True))
    rng = np.random.default_rng((list(PROBLEMS).index(problem), camera))
    true = KNOWN | draw(rng, "xi") | draw(rng, problem)
    starts = [draw(rng, problem) for _ in range(STARTS)]
    lens = lens_of(true)
    clothes, labels = pictures(data, "test", 4000)
    order = rng.permutation(len(clothes))[: max(IMAGES[problem]) + TESTED]
    images, labels = photograph(clothes[order], lens), labels[order]
    tested, tested_labels = images[-TESTED:], labels[-TESTED:]

    @torch.inference_mode()
    def evaluate(values: dict[str, float]) -> dict[str, float]:
        part = slice(0, SEARCHED)
        found = losses(model, images[part], labels[part], lens_of(true | values), usual)
        return {name: round(value.item(), 5) for name, value in found.items()}

    @torch.inference_mode()
    def judge(values: dict[str, float]) -> dict[str, float]:
        guess = lens_of(true | values)
        right = model(tested, guess).argmax(1) == tested_labels
        return dict(
            values={name: round(value, 5) for name, value in values.items()},
            distance=round(distance(guess, lens), 4),
            focal=round((guess.focal / lens.focal - 1).item(), 5),
            accuracy=round(100 * right.float().mean().item(), 2),
        )

    # As many guesses as the steps of a descent; a grid if only ξ is unknown.
    guesses = [draw(rng, problem) for _ in range(STEPS[problem])]
    if problem == "xi":
        guesses = [dict(xi=xi) for xi in GRID]
    searched = [evaluate(values) for values in guesses]
    search = {}
    for loss in LOSSES:
        curve = [found[loss] for found in searched]
        search[loss] = dict(least=min(curve), **judge(guesses[int(np.argmin(curve))]))
        if problem == "xi":
            search[loss]["curve"] = curve
    begun, trials = [judge(start) for start in starts], []
    for count in IMAGES[problem]:
        for loss in LOSSES:
            for index, start in enumerate(starts):
                began = time.process_time()
                seen = images[:count], labels[:count]
                path = descend(
                    model, *seen, usual, loss, true, start, STEPS[problem], camera * STARTS + index
                )
                seconds = time.process_time() - began
                trial = dict(
                    images=count, loss=loss, start=begun[index], found=judge(path[-1]),
                    least=evaluate(path[-1])[loss], seconds=round(seconds, 2),
                )  # fmt: skip
                if problem == "xi":
                    trial["path"] = [round(values["xi"], 3) for values in path]
                trials.append(trial)
    result = dict(
        problem=problem, camera=camera, true=judge(true), losses=evaluate(true), search=search,
        trials=trials,
    )  # fmt: skip
    replace_file(file, json.dumps(result, allow_nan=False))
    return result


# -- all of them ------------------------------------------------------------------------------


def pretrain(out: Path, options: list[str]) -> None:
    """The classifier for all lenses, and the usual statistics of its first map."""
    with printing_to(out / "log.txt"):
        darswin(["fit", "--run", str(out / "model"), *CONFIG, *options, "--resume"])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--cameras", type=int, default=8, help="the number of cameras for each problem"
    )
    parser.add_argument("--data", default="/usr/share/datasets/fashion-mnist")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("out/learned-lens"))
    parser.add_argument("--results", type=Path, default=HERE / "results")
    args, options = parser.parse_known_args(arguments)  # other options are for `darswin fit`
    args.out.mkdir(parents=True, exist_ok=True)
    use_one_core()
    if not (args.out / "usual.pt").exists():
        pretrain(args.out, ["--data.path", args.data, *options])
        model, _ = load_model(model_of_run(args.out / "model"))
        torch.save(list(usual_map(model, args.data)), args.out / "usual.pt")
    cameras = [(problem, camera) for camera in range(args.cameras) for problem in PROBLEMS]
    jobs = [(problem, camera, args.out, args.data) for problem, camera in cameras]
    collect(run_all(run_camera, jobs, args.processes, "camera"), args.results)


if __name__ == "__main__":
    main()
