"""Figures of the dense study: predictions for a few test pictures, beside the truth."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from darswin.data import open_scenes
from darswin.data.scenes.dataset import SceneSamples
from darswin.models.saving import load_model, model_of_run
from darswin.viz.pixels import distance_image, label_image
from darswin.viz.plot import save_figure

# Test sets and the place of a picture in them; all sets have the same scenes in the same order.
SHOWN = {"xi-0.3": 0, "xi-0": 1, "xi-1": 2, "front": 3, "left": 4}
TARGETS = {"segmentation": "labels", "distance": "distance"}
NEAR, FAR = 0.5, 40.0  # m, the range of the colours


def predict(run: Path, data: Path, task: str) -> None:
    """Writes the predictions of a run's last model for `SHOWN` into its `shown.npz`."""
    model, card = load_model(model_of_run(run))
    model.eval()
    said = {}
    for name, place in SHOWN.items():
        scenes = open_scenes(str(data / "test" / name), "test", TARGETS[task])
        mean, std = card.options["mean"], card.options["std"]
        test = SceneSamples(scenes, size=card.size, framing=card.fit, mean=mean, std=std)
        image, lens, _ = test[min(place, len(test) - 1)]
        with torch.inference_mode():
            found = model(image[None], lens)[0]
        said[name] = (found.argmax(0).byte() if task == "segmentation" else found[0]).numpy()
    np.savez_compressed(run / "shown.npz", **said)


def draw(runs: dict[str, Path], data: Path, task: str, path: Path) -> None:
    """A figure with a row for each of `SHOWN`: the image, the truth and each run's prediction."""
    said = {label: np.load(run / "shown.npz") for label, run in runs.items()}
    figure = Figure(figsize=(1.6 * (2 + len(said)), 1.7 * len(SHOWN)), layout="constrained")
    panels = figure.subplots(len(SHOWN), 2 + len(said), squeeze=False)
    for row, (name, place) in zip(panels, SHOWN.items(), strict=True):
        scenes = open_scenes(str(data / "test" / name), "test", TARGETS[task])
        scene = scenes[min(place, len(scenes) - 1)]
        seen = scene.target != 255 if task == "segmentation" else scene.target > 0
        pictures = [scene.image, _coloured(scene.target, scenes.colors, task)]
        pictures += [
            np.where(seen[..., None], _coloured(found[name], scenes.colors, task), 255)
            for found in said.values()
        ]
        for axes, picture in zip(row, pictures, strict=True):
            axes.imshow(picture)
            axes.set(xticks=[], yticks=[])
        row[0].set_ylabel(name, fontsize=8)
    for axes, title in zip(panels[0], ("picture", "truth", *said), strict=True):
        axes.set_title(title.replace(", ", ",\n").replace("(", "\n("), fontsize=8)
    save_figure(figure, path)


def _coloured(target: np.ndarray, colors: list, task: str) -> np.ndarray:
    if task == "segmentation":
        return label_image(target, colors)
    return distance_image(target, NEAR, FAR)
