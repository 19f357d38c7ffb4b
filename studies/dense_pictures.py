"""Figures of the dense study: predictions for a few test pictures, beside the truth."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from darswin.data import open_scenes
from darswin.data.scenes.dataset import SceneSamples
from darswin.models.saving import load_model, model_of_run
from darswin.viz.pixels import distance_image, label_image
from darswin.viz.plot import TEXT, page_figure, save_figure

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
        test = SceneSamples(scenes, size=card.size, fit=card.fit, mean=mean, std=std)
        image, lens, _ = test[min(place, len(test) - 1)]
        with torch.inference_mode():
            found = model(image[None], lens)[0]
        said[name] = (found.argmax(0).byte() if task == "segmentation" else found[0]).numpy()
    np.savez_compressed(run / "shown.npz", **said)


def draw(runs: dict[str, Path], data: Path, task: str, path: Path) -> None:
    """A figure with a column for each of `SHOWN`: image, truth and each run's prediction."""
    said = {label: np.load(run / "shown.npz") for label, run in runs.items()}
    columns = {}
    for name, place in SHOWN.items():
        scenes = open_scenes(str(data / "test" / name), "test", TARGETS[task])
        scene = scenes[min(place, len(scenes) - 1)]
        seen = scene.target != 255 if task == "segmentation" else scene.target > 0
        columns[name] = [scene.image, _coloured(scene.target, scenes.colors, task)]
        columns[name] += [
            np.where(seen[..., None], _coloured(found[name], scenes.colors, task), 255)
            for found in said.values()
        ]
    draw_columns(columns, ["picture", "truth", *said], path)


def draw_columns(columns: dict[str, list[np.ndarray]], rows: Sequence[str], path: Path) -> None:
    """Writes a figure of pictures by the names of their columns and rows."""
    figure = page_figure(1.2 * len(rows))
    panels = figure.subplots(len(rows), len(columns), squeeze=False)
    for column, (name, pictures) in zip(panels.T, columns.items(), strict=True):
        for axes, picture in zip(column, pictures, strict=True):
            axes.imshow(picture)
            axes.set(xticks=[], yticks=[])
        column[0].set_title(name, fontsize=TEXT)
    for axes, name in zip(panels[:, 0], rows, strict=True):
        axes.set_ylabel(name.replace(", ", ",\n").replace("(", "\n(").replace("-U", "-\nU"))
    save_figure(figure, path, colors=256)


def _coloured(target: np.ndarray, colors: list, task: str) -> np.ndarray:
    if task == "segmentation":
        return label_image(target, colors)
    return distance_image(target, NEAR, FAR)
