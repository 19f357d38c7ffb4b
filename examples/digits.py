"""Trains three networks on nearly undistorted digits, and tests them through any fisheye.

The digits are the scans bundled with scikit-learn. Each scan is treated as a perspective picture
with a field of view of 165° and warped through a Spherical lens. The three networks are DarSwin-A;
the same network without lens knowledge, with rings of equal width in pixels; and Swin. All are
trained on ξ in [0, 0.05], the paper's "very low" distortion, where pictures look like ordinary
pictures. All are then tested on ξ = 0, 0.1, …, 1. Run it with `make demo`.

The model "digits" that comes with darswin was saved by
`--save darswin/models/weights/digits.safetensors`.
"""

import argparse
import json
import math
import time
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from sklearn.datasets import load_digits
from sklearn.model_selection import train_test_split
from torch import Tensor
from tqdm import tqdm

from darswin import create_model, lens
from darswin.data import LEVELS
from darswin.models import ModelCard, save_model
from darswin.models.encoder import Encoder
from darswin.utils.files import replace_file
from darswin.views import CameraView, PolarView
from darswin.viz.plot import TEXT, draw_accuracy, draw_grid, page_figure, save_figure

FOV = math.radians(165)
SIZE = 32  # px, side of the wide-angle images
XI = [k / 10 for k in range(11)]
LEVEL = "very low"
# Rings at equal steps in tan θ, because the pixels of perspective pictures have equal steps in it.
MODELS = {
    "DarSwin-A": ("darswin_a_nano", dict(spacing="tan")),
    "without lens knowledge": ("darswin_a_nano", dict(spacing="radius")),
    "Swin": ("swin_nano", {}),
}


def through_lenses(scans: np.ndarray, xi: np.ndarray, size: int = SIZE) -> tuple[Tensor, lens.Lens]:
    """Warps scans (N, 8, 8) with ξ (N,). Returns images (N, 1, size, size) and their lenses."""
    camera = lens.Perspective.from_fov(FOV, scans.shape[2] / 2)
    # The field of view fills the inscribed circle of the image for every ξ.
    lenses = lens.Spherical.from_fov(torch.from_numpy(xi).float(), FOV, size / 2)
    view = CameraView(lenses, (size, size), supersampling=1)
    points = view.image_points(camera.to(torch.float64), scans.shape[1:])  # of all lenses at once
    images = [
        cv2.remap(scan, of_scan, None, cv2.INTER_CUBIC)
        for scan, of_scan in zip(scans, points.float().numpy(), strict=True)
    ]
    return torch.from_numpy(np.stack(images))[:, None], lenses


def split() -> tuple[np.ndarray, Tensor, np.ndarray, np.ndarray]:
    """The scans (N, 8, 8) in [0, 1], their labels, and the indices of those to train and test."""
    digits = load_digits()
    seen, unseen = train_test_split(
        np.arange(len(digits.target)), test_size=500, random_state=0, stratify=digits.target
    )
    return (digits.images / 16).astype(np.float32), torch.from_numpy(digits.target), seen, unseen


def train(
    model: Encoder, scans: np.ndarray, labels: Tensor, epochs: int, batch: int, seed: int, name: str
) -> None:
    """Trains the model in place, on its device. Each epoch warps every image with a new lens of
    `LEVEL`."""
    rng, device = np.random.default_rng(seed), next(model.parameters()).device
    labels = labels.to(device)
    steps = epochs * (len(scans) // batch)
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    model.train()
    with tqdm(total=steps, desc=f"train {name}", unit="step") as progress:
        for _ in range(epochs):
            xi = rng.uniform(*LEVELS[LEVEL], len(scans))
            images, lenses = (x.to(device) for x in through_lenses(scans, xi))
            order = torch.from_numpy(rng.permutation(len(scans)))
            for index in order.split(batch)[: len(scans) // batch]:
                loss = F.cross_entropy(
                    model(images[index], lenses[index]), labels[index], label_smoothing=0.1
                )
                optimizer.zero_grad()
                loss.backward()
                torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
                optimizer.step()
                schedule.step()
                progress.update()
                progress.set_postfix(loss=f"{loss.item():.3f}")


@torch.inference_mode()
def accuracy(model: Encoder, images: Tensor, lenses: lens.Lens, labels: Tensor) -> float:
    """The top-1 accuracy in percent."""
    device = next(model.eval().parameters()).device
    images, lenses, labels = (x.to(device) for x in (images, lenses, labels))
    right = sum(
        (model(images[k], lenses[k]).argmax(1) == labels[k]).sum().item()
        for k in torch.arange(len(images)).split(100)
    )
    return 100 * right / len(images)


def save(path: Path, model: Encoder, scan: np.ndarray) -> None:
    """Writes a DarSwin-A with its model card, and a sample picture with its lens beside it."""
    model_name, options = MODELS["DarSwin-A"]
    card = ModelCard(
        model_name, dict(num_classes=10, in_chans=1, **options), [*"0123456789"], SIZE, FOV
    )
    save_model(path, model.state_dict(), card)
    size = 256
    image, taken_with = through_lenses(scan[None], np.array([0.5]), size)
    pixels = (image[0, 0].clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    cv2.imwrite(str(path.with_suffix(".png")), pixels)
    sized = taken_with.replace(image_size=torch.tensor([[size, size]]))
    lens.save(sized, path.with_suffix(".json"))


def draw(table: dict[str, list[list[float]]], scan: np.ndarray, sampler: PolarView) -> Figure:
    """Plots accuracy against ξ, and beside it a digit through two lenses with their patches."""
    figure = page_figure(4.2)
    panels = figure.subplot_mosaic("ab;ac", width_ratios=(2.7, 1))
    draw_accuracy(XI, table, LEVELS[LEVEL], axes=panels["a"])
    panels["a"].set(ylim=(0, 100), title="scanned digits, trained with\nalmost no distortion")
    for name, xi in (("b", 0.0), ("c", 0.4)):
        image, lenses = through_lenses(scan[None], np.array([xi]), 512)
        draw_grid(image[0, 0].numpy(), lenses, sampler, axes=panels[name])
        panels[name].set_title(f"patches, ξ = {xi:g}", fontsize=TEXT)
        panels[name].axis("off")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--epochs", type=int, default=16)
    parser.add_argument("--batch", type=int, default=48)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    parser.add_argument(
        "--save", type=Path, metavar="FILE", help="keep the first DarSwin-A, with a sample picture"
    )
    args = parser.parse_args()
    start = time.perf_counter()

    scans, labels, seen, unseen = split()
    tests = {
        xi: through_lenses(scans[unseen], np.full(len(unseen), xi))
        for xi in tqdm(XI, desc="warp test images", unit="lens")
    }
    table: dict[str, list[list[float]]] = {name: [] for name in MODELS}
    for seed in range(args.seeds):
        for name, (model_name, options) in MODELS.items():
            torch.manual_seed(seed)
            model = create_model(model_name, num_classes=10, in_chans=1, **options)
            train(model, scans[seen], labels[seen], args.epochs, args.batch, seed, name)
            table[name].append([accuracy(model, *tests[xi], labels[unseen]) for xi in XI])
            if args.save and name == "DarSwin-A" and seed == 0:
                save(args.save, model, scans[unseen[0]])

    print(
        f"\nAccuracy (%), mean of {args.seeds} seeds, trained on ξ in {list(LEVELS[LEVEL])}, "
        f"{len(unseen)} test images a lens"
    )
    print("ξ".ljust(24) + "".join(f"{xi:7.1f}" for xi in XI))
    for name, rows in table.items():
        print(name.ljust(24) + "".join(f"{value:7.1f}" for value in np.mean(rows, 0)))
    model_name, options = MODELS["DarSwin-A"]
    sampler = create_model(model_name, **options).view
    three = unseen[labels[unseen] == 3][0]
    save_figure(draw(table, scans[three], sampler), args.out / "accuracy.png", colors=256)
    record = json.dumps(dict(xi=XI, accuracy=table), indent=1)
    replace_file(args.out / "accuracy.json", record)
    print(f"\n{args.out}/accuracy.png, after {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
