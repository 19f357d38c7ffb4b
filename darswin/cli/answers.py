"""Predictions for a stream of images: classes, or files with labels or distances."""

import io
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from darswin.cli.pictures import ByLens
from darswin.data.framing import FullSize, cut_off, fitted
from darswin.data.scenes.targets import PER_METRE
from darswin.deploy.optimize import optimize
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.encoder import Encoder
from darswin.models.pixel import PixelModel
from darswin.models.prepared import Prepared
from darswin.models.saving import ModelCard
from darswin.ops import _module
from darswin.utils.files import replace_file
from darswin.utils.tasks import IGNORE, Fit
from darswin.views import Remap
from darswin.views.camera import picture_size
from darswin.viz.pixels import (
    UNKNOWN,
    distance_image,
    distance_range,
    is_known,
    label_image,
    overlay,
    palette,
)

Net = TypeVar("Net", bound=Model)

BATCH = 8  # takes a half to a third of the time of single images
TOP = 5  # classes of a picture that are listed
FARTHEST = 2**16 - 1  # the largest number of 16 bits


class Request(NamedTuple):
    entry: dict[str, Any]  # the file, and the frame of a video
    image: np.ndarray  # (H, W, C) uint8
    pixels: Tensor  # (1, C, h, w), the model's input


class Answers:
    """Collects the predictions for images, in their order.

    Args: channels: of the images, 1 or 3.
    """

    shown = ""  # to the network, in words that follow the number of pictures
    most_lenses = 16  # whose values are kept, for folders whose pictures come from several cameras

    def __init__(self, channels: int):
        self.channels = channels
        self.found: list[dict[str, Any]] = []
        self.seconds = 0.0  # spent in the network
        self._by_lens = ByLens(self.most_lenses)

    def add(self, entry: dict[str, Any], image: np.ndarray, lens: Lens) -> None:
        """Adds an image (H, W, C) uint8 with its lens. Equal lenses should be the same object."""
        raise NotImplementedError

    def flush(self) -> None:
        """Predicts the images that wait."""

    def finish(self) -> str | None:
        """What is wrong with all answers, once they are there."""
        return None


class Seen(NamedTuple):
    """What depends on a lens alone: how its pictures get the model's size, what the model prepares
    for them, and the way back to their pixels, if the predictions need it."""

    remap: Remap
    prepared: Prepared
    full: FullSize | None


class ModelAnswers(Answers):
    """Predicts by a model of darswin.

    Consecutive images with the same lens form a batch. Values that depend only on the lens are
    computed once.
    """

    def __init__(self, model: Encoder | PixelModel, card: ModelCard):
        super().__init__(model.in_chans)
        self.model, self.card = fast(model, card), card
        self._lens: Lens | None = None  # of the queue
        self._queue: list[Request] = []
        self._warned = False

    def add(self, entry: dict[str, Any], image: np.ndarray, lens: Lens) -> None:
        if lens is not self._lens:
            self.flush()
            self._seen: Seen = self._by_lens(lens, lambda: self._seen_by(lens))
            self._lens = lens
        pixels = torch.from_numpy(self._seen.remap(image)[None]).permute(0, 3, 1, 2).contiguous()
        self._queue.append(Request(entry, image, pixels))
        if len(self._queue) == BATCH:
            self.flush()

    def _seen_by(self, lens: Lens) -> "Seen":
        size, fit = picture_size(lens), framing_of(self.model, self.card)
        remap = fitted(size, self.card.size, fit).at(lens, size)
        with torch.inference_mode():
            prepared = self.model.prepare(remap.camera, remap.view_size)
        self._warn_of_cut_off(lens)
        return Seen(remap, prepared, self._full_size(remap, prepared))

    def _warn_of_cut_off(self, lens: Lens) -> None:
        """Warns once if the model does not see whole pictures."""
        if self._warned:
            return
        lost = cut_off(picture_size(lens), lens, framing_of(self.model, self.card))
        if lost is None:
            return
        self._warned = True
        reason = "takes only square pictures"
        if self.card.fit == "crop":
            reason = (
                "was trained on cropped pictures; `darswin fit --data.fit stretch` trains one that "
                "sees all of them"
            )
        warnings.warn(f"the model does not see {lost}, because it {reason}", stacklevel=2)

    def flush(self) -> None:
        """Predicts the images in the queue; FloatingPointError if the model computes NaN."""
        queue, self._queue = self._queue, []
        if not queue:
            return
        _, prepared, full = self._seen
        images = torch.cat([request.pixels for request in queue])
        start = time.perf_counter()
        with torch.inference_mode():
            outputs = self._run(images, prepared)
        self.seconds += time.perf_counter() - start
        for request, output in zip(queue, outputs, strict=True):
            # Only pixels that a ray reaches and the view shows have a prediction.
            used = output if full is None else output[:, torch.from_numpy(full.reached)]
            if not used.isfinite().all():
                raise FloatingPointError(
                    f"no prediction for {said(request.entry)}: the model computes NaN or infinity; "
                    "its weights may have diverged in training"
                )
            self.found.append(request.entry | self._answer(request, output, full))

    def _full_size(self, remap: Remap, prepared: Prepared) -> FullSize | None:
        """The way back to the pixels of the pictures, if the predictions need it."""
        return None

    def _run(self, images: Tensor, prepared: Prepared) -> Tensor:
        """The network's output (B, …) for images (B, C, h, w)."""
        return self.model.run(images, prepared)

    def _answer(self, request: Request, output: Tensor, full: Any) -> dict[str, Any]:
        raise NotImplementedError


class ClassAnswers(ModelAnswers):
    """Predicts the `top` most probable classes."""

    model: Encoder

    def __init__(self, model: Encoder, card: ModelCard, top: int):
        super().__init__(model, card)
        self.top = top

    def _run(self, images: Tensor, prepared: Prepared) -> Tensor:
        return self.model.run(images, prepared).softmax(-1)

    def _answer(self, request: Request, output: Tensor, full: Any) -> dict[str, Any]:
        best = output.topk(min(self.top, len(output)))
        names = self.card.classes or range(len(output))
        pairs = zip(best.indices.tolist(), best.values.tolist(), strict=True)
        return {"top": [{"class": names[k], "probability": value} for k, value in pairs]}


class PixelAnswers(ModelAnswers):
    """Writes two files for each image: the predictions for its pixels, and an overlay.

    `names` are those of `file_names`.
    """

    kind: str  # the name of the folder of the predictions
    model: PixelModel

    def __init__(self, model: PixelModel, card: ModelCard, out: Path, names: Mapping[str, str]):
        super().__init__(model, card)
        self.out, self.names = out, names

    def _full_size(self, remap: Remap, prepared: Prepared) -> FullSize:
        return FullSize(remap, prepared.view.shown)

    def _answer(self, request: Request, output: Tensor, full: FullSize) -> dict[str, Any]:
        content, picture, where, summary = self._picture(request, output.float().numpy(), full)
        name = file_of(request.entry, self.names)
        file = f"{self.kind}/{name}.png"
        replace_file(self.out / file, content)
        laid = overlay(request.image, picture, where=where)
        return {self.kind: file, "overlay": write_overlay(self.out, name, laid)} | summary

    def _picture(
        self, request: Request, output: np.ndarray, full: FullSize
    ) -> tuple[bytes | memoryview, np.ndarray, np.ndarray, dict[str, Any]]:
        """An output (K, h, w) → the content of a PNG file, the picture and the mask of the overlay,
        and a summary."""
        raise NotImplementedError


class LabelAnswers(PixelAnswers):
    """Predicts classes of pixels; writes PNGs of class ids with a palette."""

    kind = "labels"

    def __init__(self, model: PixelModel, card: ModelCard, out: Path, names: Mapping[str, str]):
        super().__init__(model, card, out, names)
        if model.num_classes > IGNORE:
            raise ValueError(
                f"PNGs of labels can hold at most {IGNORE} classes, got {model.num_classes}"
            )
        self.classes = list(card.classes) or [str(k) for k in range(model.num_classes)]
        self.colors = list(card.colors) or palette(len(self.classes))

    def _picture(self, request, output, full):
        labels = full.labels(output)
        counts = np.bincount(labels.ravel(), minlength=IGNORE + 1)
        answered = max(1, labels.size - counts[IGNORE])
        shares = {
            name: round(float(count / answered), 6)
            for name, count in zip(self.classes, counts, strict=False)
        }
        summary = {"shares": shares, "unanswered": round(float(counts[IGNORE] / labels.size), 6)}
        picture = label_image(labels, self.colors)
        return label_png(labels, self.colors), picture, labels != IGNORE, summary


class DistanceAnswers(PixelAnswers):
    """Predicts distances along the rays of pixels; writes PNGs of 16 bits: metres × 256, 0 for
    unknown."""

    kind = "distance"
    _range: tuple[Any, tuple[float, float]] = (None, (1.0, 2.0))  # from the first frame of a video

    def _picture(self, request, output, full):
        distance = full.distance(output[0])
        known = is_known(distance)
        values = distance[known] if known.any() else np.zeros(1)
        unanswered = round(float(1 - known.mean()), 6)
        ends = np.quantile(values, (0, 0.5, 1)).tolist()
        metres = dict(zip(("min_m", "median_m", "max_m"), (round(v, 4) for v in ends), strict=True))
        # All frames of a video share the colours of its first frame.
        video = request.entry.get("video")
        if video is None or video != self._range[0]:
            self._range = video, distance_range(distance)
        near, far = self._range[1]
        summary = metres | {"unanswered": unanswered, "colors_m": [round(near, 4), round(far, 4)]}
        return distance_png(distance), distance_image(distance, near, far), known, summary


ANSWERS_OF = {"segmentation": LabelAnswers, "distance": DistanceAnswers}


def said(entry: Mapping[str, Any]) -> str:
    """A picture or a frame in words."""
    video = entry.get("video")
    return f"frame {entry['frame']} of {video}" if video else entry["image"]


def file_of(entry: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """The name of the output files of a picture or a frame; names: those of `file_names`."""
    video = entry.get("video")
    return f"{names[video]}/{entry['frame']:06d}" if video else names[entry["image"]]


def write_overlay(out: Path, name: str, picture: np.ndarray) -> str:
    """Writes a picture (H, W, 3), RGB, into the folder of overlays; returns its path there."""
    _, jpeg = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
    replace_file(out / f"overlays/{name}.jpg", jpeg.data)
    return f"overlays/{name}.jpg"


def fast(model: Net, card: ModelCard) -> Net:
    """The optimized model, with 8 bits if it is quantized. Without the compiled module, the model
    itself."""
    if _module.LACK is not None:
        return model.eval()
    return optimize(model, torch.int8 if card.quantized else torch.float32)


def framing_of(net: Model, card: ModelCard) -> Fit:
    """The framing of the model's training; models that take only squares crop."""
    return "crop" if net.square_images and card.fit == "whole" else card.fit


def label_png(labels: np.ndarray, colors: Sequence[Sequence[int]]) -> bytes:
    """Ids (H, W) uint8 as a PNG with a palette of the colours."""
    image = Image.fromarray(labels)  # becomes mode "P" with a palette
    table = [*map(tuple, colors), *[UNKNOWN] * (256 - len(colors))]
    image.putpalette([int(value) for color in table for value in color])
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def distance_png(distance: np.ndarray) -> memoryview:
    """Distances (H, W) in metres as a PNG of 16 bits: metres × 256, clipped to 1 … 65535, or 0 for
    unknown distances."""
    known = is_known(distance)
    steps = np.rint(np.where(known, distance, 0) * PER_METRE).clip(known, FARTHEST)
    _, png = cv2.imencode(".png", steps.astype(np.uint16))
    return png.data
