"""A label or a distance for every pixel of a stream of images, as files in a folder."""

import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from darswin.cli.answers import Answers, Asked, fast, fit_of
from darswin.data.scenes.scene import IGNORE, PER_METRE
from darswin.data.warp import FullSize
from darswin.lens import Lens
from darswin.models.saving import ModelCard
from darswin.models.unet import Unet, UnetPrepared
from darswin.utils.files import replace_file
from darswin.viz.dense import (
    UNKNOWN,
    distance_image,
    distance_range,
    is_known,
    label_image,
    overlay,
    palette,
)

ANSWERS = "predictions.json"
FARTHEST = 2**16 - 1  # of what 16 bits hold


class DenseAnswers(Answers):
    """Writes what a model says of each pixel of images as files, and an overlay of each image.

    Files of pixels and overlays are in folders of their own, below which each image has the name
    that `file_names` gives it, or a frame of a video that name and its number.

    Args:
        model, card: as `load_model` gives them. out: the folder of the files.
        names: of each picture or video, as `file_names`.
    """

    kind: str  # of the answers, and the name of their folder
    model: Unet

    def __init__(self, model: Unet, card: ModelCard, out: Path, names: Mapping[str, str]):
        super().__init__(fast(model, card), card)
        self.out, self.names = out, names

    def look_through(self, lens: Lens) -> FullSize:
        """The way back to the pixels of its pictures."""
        return FullSize(lens, self.card.size, fit_of(self.model, self.card))

    def is_finite(self, said: Tensor, look: FullSize) -> bool:
        """Whether it is finite in the pixels that a ray reaches."""
        return bool(said[:, torch.from_numpy(look.reached)].isfinite().all())

    def ask(self, images: Tensor, prepared: UnetPrepared) -> Tensor:
        """What the network says of each pixel, (B, K, h, w)."""
        return self.model.run(images, prepared)

    def answer(self, asked: Asked, said: Tensor, look: FullSize) -> dict[str, Any]:
        """Writes the files of an image, and names and summarizes them."""
        content, picture, where, summary = self.picture(asked, said.float().numpy(), look)
        name = self._name(asked.entry)
        files = {self.kind: f"{self.kind}/{name}.png", "overlay": f"overlays/{name}.jpg"}
        replace_file(self.out / files[self.kind], content)
        laid = overlay(asked.image, picture, where=where)
        _, jpeg = cv2.imencode(".jpg", laid[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
        replace_file(self.out / files["overlay"], jpeg.data)
        return files | summary

    def picture(
        self, asked: Asked, said: np.ndarray, look: FullSize
    ) -> tuple[bytes | memoryview, np.ndarray, np.ndarray, dict[str, Any]]:
        """What (K, h, w) are in the image: a PNG file's content, a picture for the overlay and
        where it is laid, and a summary."""
        raise NotImplementedError

    def _name(self, entry: Mapping[str, Any]) -> str:
        if "video" in entry:
            return f"{self.names[entry['video']]}/{entry['frame']:06d}"
        return self.names[entry["image"]]


class LabelAnswers(DenseAnswers):
    """A class for each pixel: PNGs whose pixels are the classes' ids, with a palette."""

    kind = "labels"

    def __init__(self, model: Unet, card: ModelCard, out: Path, names: Mapping[str, str]):
        super().__init__(model, card, out, names)
        if model.num_classes > IGNORE:
            raise ValueError(f"labels of 8 bits are for {IGNORE} classes, got {model.num_classes}")
        self.classes = list(card.classes) or [str(k) for k in range(model.num_classes)]
        self.colors = list(card.colors) or palette(len(self.classes))

    def picture(self, asked, said, look):
        """Labels, and each class's share of the pixels that have one."""
        labels = look.labels(said)
        counts = np.bincount(labels.ravel(), minlength=IGNORE + 1)
        answered = max(1, labels.size - counts[IGNORE])
        shares = {
            name: round(float(count / answered), 6)
            for name, count in zip(self.classes, counts, strict=False)
        }
        summary = {"shares": shares, "unanswered": round(float(counts[IGNORE] / labels.size), 6)}
        picture = label_image(labels, self.colors)
        return label_png(labels, self.colors), picture, labels != IGNORE, summary


class DistanceAnswers(DenseAnswers):
    """A distance along the ray for each pixel: 16-bit PNGs, metres × 256, 0 for none."""

    kind = "distance"

    def __init__(self, model: Unet, card: ModelCard, out: Path, names: Mapping[str, str]):
        super().__init__(model, card, out, names)
        self._range: tuple[Any, tuple[float, float]] = (None, (1.0, 2.0))

    def picture(self, asked, said, look):
        """Distances, and the nearest, the median and the farthest of them."""
        distance = look.distance(said[0])
        known = is_known(distance)
        values = distance[known] if known.any() else np.zeros(1)
        unanswered = round(float(1 - known.mean()), 6)
        ends = np.quantile(values, (0, 0.5, 1)).tolist()
        metres = dict(zip(("min_m", "median_m", "max_m"), (round(v, 4) for v in ends), strict=True))
        # Frames of a video have the colours of its first.
        video = asked.entry.get("video")
        if video is None or video != self._range[0]:
            self._range = video, distance_range(distance)
        near, far = self._range[1]
        summary = metres | {"unanswered": unanswered, "colors_m": [round(near, 4), round(far, 4)]}
        return distance_png(distance), distance_image(distance, near, far), known, summary


ANSWERS_OF = {"segmentation": LabelAnswers, "distance": DistanceAnswers}


def label_png(labels: np.ndarray, colors: Sequence[Sequence[int]]) -> bytes:
    """Ids (H, W) uint8 as a PNG with a palette: its pixels are the ids, in their colours."""
    image = Image.fromarray(labels)  # which a palette makes one of mode "P"
    table = [*map(tuple, colors), *[UNKNOWN] * (256 - len(colors))]
    image.putpalette([int(value) for color in table for value in color])
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def distance_png(distance: np.ndarray) -> memoryview:
    """Distances (H, W) in metres as a PNG of 16 bits: metres × 256, 0 where they are not known.

    From 255.996 m on, the end of its range, pixels are 65535; from 0 to 1/256 m they are 1.
    """
    known = is_known(distance)
    steps = np.rint(np.where(known, distance, 0) * PER_METRE).clip(known, FARTHEST)
    _, png = cv2.imencode(".png", steps.astype(np.uint16))
    return png.data


def file_names(paths: Sequence[str], files: Sequence[tuple[str, bool]]) -> dict[str, str]:
    """Names for what is written of pictures and videos, without an ending: different for different
    files.

    They are paths relative to the folder that all arguments are in: the one folder that was given,
    or what several paths have in common. Pictures lose their endings if they still differ then.

    Args:
        paths: the arguments. files: of (path, whether it is a video).
    """
    places = [os.path.abspath(p if os.path.isdir(p) else os.path.dirname(p) or ".") for p in paths]
    root = os.path.commonpath(places)
    whole = {name: os.path.relpath(os.path.abspath(name), root) for name, _ in files}
    videos = {name for name, is_video in files if is_video}
    short = {n: w if n in videos else os.path.splitext(w)[0] for n, w in whole.items()}
    return short if len(set(short.values())) == len(set(whole.values())) else whole


def claim_folder(out: str | None) -> Path:
    """The folder for the files of `DenseAnswers`: new, empty, or of an earlier `predict`.

    Raises:
        ValueError: none; a file; a folder that holds other things.
    """
    if out is None:
        raise ValueError("predict writes pictures for such a model: --out must be their folder")
    folder = Path(out)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out must be a folder for the pictures, and {out} is a file")
    if folder.is_dir() and not _is_ours(folder / ANSWERS) and any(folder.iterdir()):
        raise ValueError(
            f"--out {out} holds files that are none of predict's: give a new or an empty folder, "
            "or one of an earlier predict, whose files are replaced"
        )
    replace_file(folder / ANSWERS, "[]")
    return folder


def _is_ours(file: Path) -> bool:
    try:
        return isinstance(json.loads(file.read_bytes()), list)
    except (OSError, ValueError):
        return False
