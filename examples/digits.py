"""Trains DarSwin on handwritten digits seen through mild lenses, and tests it on all of them.

The digits are scikit-learn's bundled scans. Each is taken for a perspective image with a field of
view of 165° and warped through a Spherical lens. Two models are trained on ξ in [0.2, 0.35], the
paper's "low" distortion: DarSwin-A, and the same network without lens knowledge, whose rings are
equal in pixels. Both are then tested on ξ = 0, 0.1, …, 1. Run it with `make demo`.
"""

import argparse
import json
import math
import time
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
import torch.nn.functional as F
from sklearn.datasets import load_digits
from sklearn.model_selection import train_test_split
from torch import Tensor
from tqdm import tqdm

from darswin import create_model, lens
from darswin.data import LEVELS, warp_map
from darswin.models import DarSwin
from darswin.viz.plot import draw_accuracy, draw_grid

FOV = math.radians(165)
SIZE = 32  # px, of the wide-angle images
XI = [k / 10 for k in range(11)]
MODELS = {
    "DarSwin-A": {},
    "without lens knowledge": dict(spacing="radius", sample_spacing="radius"),
}


def through_lenses(scans: np.ndarray, xi: np.ndarray) -> tuple[Tensor, lens.Lens]:
    """Scans (N, 8, 8) and their ξ (N,) → images (N, 1, SIZE, SIZE) and lenses."""
    camera = lens.Perspective.from_fov(FOV, scans.shape[2] / 2)
    # The field of view fills the circle inside the image, whatever ξ is.
    lenses = lens.Spherical.from_fov(torch.from_numpy(xi).float(), FOV, SIZE / 2)
    maps = warp_map(camera, scans.shape[1:], lenses, (SIZE, SIZE))
    images = [
        cv2.remap(scan, places, None, cv2.INTER_CUBIC)
        for scan, places in zip(scans, maps, strict=True)
    ]
    return torch.from_numpy(np.stack(images))[:, None], lenses


def train(
    model: DarSwin, scans: np.ndarray, labels: Tensor, epochs: int, batch: int, seed: int, name: str
) -> None:
    """Trains in place, every image through a new lens of the "low" range in every epoch."""
    rng = np.random.default_rng(seed)
    steps = epochs * (len(scans) // batch)
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3, weight_decay=0.05)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    model.train()
    with tqdm(total=steps, desc=f"train {name}", unit="step") as progress:
        for _ in range(epochs):
            images, lenses = through_lenses(scans, rng.uniform(*LEVELS["low"], len(scans)))
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
def accuracy(model: DarSwin, images: Tensor, lenses: lens.Lens, labels: Tensor) -> float:
    """Percent of the images whose largest logit is the label's."""
    model.eval()
    right = sum(
        (model(images[k], lenses[k]).argmax(1) == labels[k]).sum().item()
        for k in torch.arange(len(images)).split(100)
    )
    return 100 * right / len(images)


def draw(model: DarSwin, scan: np.ndarray, path: Path) -> None:
    """One digit at several ξ, with the patches and sample points of the model."""
    chosen = (0.0, 0.3, 0.6, 1.0)
    figure, rows = plt.subplots(2, len(chosen), figsize=(3 * len(chosen), 6.4))
    for column, xi in enumerate(chosen):
        images, lenses = through_lenses(scan[None], np.array([xi]))
        sampler = model.patch_embed.sample
        rows[0, column].imshow(images[0, 0], cmap="gray")
        rows[0, column].set_title(f"ξ = {xi:g}")
        rows[0, column].axis("off")
        draw_grid(images[0, 0].numpy(), lenses, sampler, axes=rows[1, column])
    figure.suptitle("A digit through four lenses; below, the patches and samples of DarSwin")
    figure.tight_layout()
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--epochs", type=int, default=16)
    parser.add_argument("--batch", type=int, default=48)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()

    digits = load_digits()
    scans = (digits.images / 16).astype(np.float32)
    labels = torch.from_numpy(digits.target)
    seen, unseen = train_test_split(
        np.arange(len(scans)), test_size=500, random_state=0, stratify=digits.target
    )
    tests = {
        xi: through_lenses(scans[unseen], np.full(len(unseen), xi))
        for xi in tqdm(XI, desc="warp test images", unit="lens")
    }
    table: dict[str, list[float]] = {}
    for name, options in MODELS.items():
        torch.manual_seed(args.seed)
        model = create_model("darswin_a_nano", num_classes=10, in_chans=1, **options)
        train(model, scans[seen], labels[seen], args.epochs, args.batch, args.seed, name)
        table[name] = [
            accuracy(model, *tests[xi], labels[unseen])
            for xi in tqdm(XI, desc=f"test {name}", unit="lens")
        ]
        if name == "DarSwin-A":
            draw(model, scans[unseen[0]], args.out / "partition.png")

    print(
        f"\nAccuracy (%), trained on ξ in {list(LEVELS['low'])}, {len(unseen)} test images a lens"
    )
    print("ξ".ljust(24) + "".join(f"{xi:7.1f}" for xi in XI))
    for name, row in table.items():
        print(name.ljust(24) + "".join(f"{value:7.1f}" for value in row))

    figure, axes = plt.subplots(figsize=(7, 4.2))
    draw_accuracy(XI, table, LEVELS["low"], axes=axes)
    axes.set_title("Digits through lenses never seen in training")
    figure.tight_layout()
    figure.savefig(args.out / "accuracy.png", dpi=130)
    (args.out / "accuracy.json").write_text(json.dumps(dict(xi=XI, accuracy=table), indent=1))
    print(f"\n{args.out}/accuracy.png and {args.out}/partition.png, after "
          f"{time.perf_counter() - start:.0f} s")  # fmt: skip


if __name__ == "__main__":
    main()
