"""Predictions of a network in an ONNX file, which sees the pictures through a view."""

import io
import json
import math
import re
import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import torch

from darswin.boxes import Instances, encode_rle, spherical
from darswin.cli.answers import TOP, Answers, file_of, label_png, said, write_overlay
from darswin.cli.names import read_names
from darswin.cli.views import named_view
from darswin.data.labels.coco import coco_annotations, picture_ids
from darswin.data.labels.yolo import yolo_lines
from darswin.frames import Sampler
from darswin.frames.forms import Pixels
from darswin.frames.onnx import OnnxNetwork
from darswin.lens import Lens
from darswin.models.detections import in_picture
from darswin.ops.checks import per_channel
from darswin.utils.files import replace_file
from darswin.utils.image import BrokenImageError
from darswin.utils.parameters import check, check_statistics, naming
from darswin.utils.tasks import IGNORE
from darswin.utils.words import counted, in_px
from darswin.views import PlainView, Remap
from darswin.views.floor import check_floor
from darswin.viz.pixels import draw_instances, label_image, overlay, palette

VIEW, THRESHOLD, RESULTS = "mercator", 0.3, "coco.json"


class Boxes:
    """Counts the boxes of a network, and those that have no area."""

    def __init__(self) -> None:
        self.count = self.without_area = 0

    def add(self, detections: Sequence[Instances]) -> None:
        for boxes in (instances.upright for instances in detections):
            self.count += len(boxes)
            self.without_area += int((boxes[:, :2] >= boxes[:, 2:]).any(1).sum())

    def wrong(self, network: str) -> str | None:
        """What is wrong if most boxes are none; warns if some are."""
        if not self.without_area:
            return None
        boxes = f"{self.without_area} of {counted(self.count, 'box')}"
        text = f"{network}: left out, because they have no area, are {boxes}"
        if 2 * self.without_area <= self.count:
            warnings.warn(text, stacklevel=2)
            return None
        return (
            f"{text}. They may be centres and sizes, or y before x; the graph must give the "
            "corners x0, y0, x1, y1"
        )


class BoundView(NamedTuple):
    """The view of the pictures of one camera."""

    remap: Remap
    sampler: Sampler


class NetworkAnswers(Answers):
    """Carries what a network finds in a view to the pictures.

    Args: those of `darswin predict` with these names.

    Raises:
        ValueError: an option is wrong, or does not fit the view or the network.
    """

    most_lenses = 8  # a plan of tiles takes 100 MB

    def __init__(
        self, network: str, *, view: str | None = None, size: tuple[int, int] | None = None,
        fov_deg: float | None = None, up: Sequence[float] | None = None,
        mean: Sequence[float] | None = None, std: Sequence[float] | None = None,
        channels: str | None = None, threshold: float | None = None, labels: str | None = None,
        top: int | None = None, form: str | None = None,
        height: float | None = None, radius: float | None = None,
        format: Literal["json", "coco", "yolo"] | None = None,
    ):  # fmt: skip
        lowest = THRESHOLD if threshold is None else threshold
        check("threshold", f"{lowest:g}", 0 <= lowest <= 1, "from 0 to 1, as scores are")
        check_statistics(mean, std)
        check("size", size, size is None or min(size) >= 1, "at least 1,1")
        self.labels = None if labels is None else read_names(labels)
        make = partial(named_view, "view", view or VIEW, fov_deg=fov_deg, up=up)
        # The network says how large its pictures are, but the view how many there are.
        try:
            number = make((64, 64)).count
            self.network = OnnxNetwork(network, size, number, lowest, form, self.labels)
        except ModuleNotFoundError as error:  # of onnxruntime, and says how to install it
            raise ValueError(str(error)) from error
        super().__init__(self.network.channels)
        if self.network.output == "uint8" and (mean or std):
            text = f"{network} takes pixels of uint8: leave `mean` and `std` out"
            raise naming(ValueError(text), "mean", "std")
        if format is not None and self.network.kind != "detections":
            text = f"`format` is for detections, but {network} is a network for {self.network.kind}"
            raise naming(ValueError(text), "format")
        pixels = self.network.pixels
        if mean or std or len(pixels.mean) not in (1, self.channels):
            pixels = Pixels(tuple(mean or (0.0,)), tuple(std or (1.0,)), pixels.channels)
        pixels = pixels._replace(channels=channels or pixels.channels)
        self.view = make(self.network.size, mean=pixels.mean, std=pixels.std)
        sides = f" of {in_px(self.network.size)}" if self.network.size else ""
        self.shown = f" by the view {view or VIEW}{sides}"
        self._mean, self._std = (
            per_channel(name, getattr(self.view, name), self.channels) for name in ("mean", "std")
        )
        self._step = -1 if pixels.channels == "bgr" else 1
        self._format, self._results = format, list[dict[str, Any]]()
        if self.network.form is not None:
            print(f"darswin: {network}: {self._said(pixels)}", file=sys.stderr)
        self._top, asked = top or TOP, top is not None or labels is not None
        self._classes = self._class_outputs() if asked else []
        self._boxes = Boxes()
        self._floor = self._floor_of(height, up, radius)

    def _floor_of(
        self, height: float | None, up: Sequence[float] | None, radius: float | None
    ) -> dict[str, Any] | None:
        """The arguments of `Remap.floor`, if the `height` of the camera is given."""
        if height is None:
            check("radius", radius, radius is None, "given with --height")
            return None
        if up is None:
            text = "`height` needs `up`, the direction away from gravity, to find the floor"
            raise naming(ValueError(text), "height", "up")
        if self.network.kind != "detections":
            text = f"`height` is for boxes, but {self.network.path} gives {self.network.kind}"
            raise naming(ValueError(text), "height")
        floor: dict[str, Any] = dict(height=height, up=up, radius=radius or 0.0)
        check_floor((self.view.tiles or [self.view])[0], **floor)
        return floor

    def _said(self, pixels: Pixels) -> str:
        """What is read of the file, and what it is given."""
        count = len(self.network.names)
        names = f", {counted(count, 'name')} of classes" if count else ""
        values = "uint8"
        if self.network.output == "image":
            mean, std = (",".join(f"{v:.4g}" for v in part) for part in (pixels.mean, pixels.std))
            values = f"(pixel/255 - mean) / std, mean {mean}, std {std}"
        merged = ", boxes that overlap are merged" if self.network.overlaps else ""
        unused = ", ".join(self.network.unused)
        return (
            f"detections (form {self.network.form}{names}{merged}); "
            + f"outputs that are not used: {unused}; " * bool(unused)
            + f"pixels are {pixels.channels}, {values}"
        )

    def _class_outputs(self) -> list[str]:
        """The outputs that are numbers of classes, if these were asked for."""
        network = self.network
        if network.kind != "numbers":
            return []
        counts = {name: shape[0] for name, shape in network.shapes.items() if len(shape) == 1}
        wanted = None if self.labels is None else max(self.labels) + 1
        outputs = [name for name, count in counts.items() if count == wanted or wanted is None]
        if not outputs:
            found = ", ".join(f"{count} in {name}" for name, count in counts.items())
            text = f"`labels` names the classes 0 to {(wanted or 0) - 1}, but {network.path} gives"
            raise naming(ValueError(f"{text} other numbers of classes: {found}"), "labels")
        return outputs

    def finish(self) -> str | None:
        return self._boxes.wrong(self.network.path)

    def into(self, out: Path | None, names: Mapping[str, str]) -> Self:
        """Sets the folder of results, None for numbers alone, and the `file_names` of pictures."""
        self._out, self._names = out or Path(), names
        self._ids = picture_ids(names.values())
        self._free_ids = count(max(self._ids.values(), default=0) + 1)
        return self

    def add(self, entry: dict[str, Any], image: np.ndarray, lens: Lens) -> None:
        try:
            bound: BoundView = self._by_lens(lens, lambda: self._bound_to(image.shape[:2], lens))
        except ValueError as error:
            raise BrokenImageError(f"{said(entry)} has no such view: {error}") from error
        pictures = bound.sampler(image[..., :: self._step])
        start = time.perf_counter()
        try:
            outputs = self.network(pictures)
        except FloatingPointError as error:
            raise FloatingPointError(f"no prediction for {said(entry)}: {error}") from error
        self.seconds += time.perf_counter() - start
        if isinstance(outputs, list):
            answer = self._detections(entry, image, bound, outputs)
        else:
            answer = self._outputs(entry, image, bound, outputs)
        self.found.append(entry | answer)

    def _bound_to(self, size: tuple[int, int], lens: Lens) -> BoundView:
        if isinstance(self.view, PlainView) and size != self.network.size:
            text = f"the picture has {in_px(size)}, but the network {in_px(self.network.size)}"
            text += ": choose a view that resamples it"
            text += "" if self.network.has_size else ", or give it by `size`, {},{}".format(*size)
            raise naming(ValueError(text), "size")
        remap = self.view.at(lens, size)
        output = self.network.output
        made = remap.plan(output, mean=self._mean, std=self._std)
        if (made.columns < -1).all():
            raise ValueError("it shows nothing of the picture: choose another, or check the lens")
        return BoundView(remap, Sampler(made))

    def _detections(
        self, entry: dict[str, Any], image: np.ndarray, bound: BoundView, tiles: list[Instances]
    ) -> dict[str, Any]:
        """Writes and draws the detections of the view, or of all tiles, in the picture."""
        if self.network.overlaps:
            tiles = [detections.merged(inside=1.0) for detections in tiles]
        self._boxes.add(tiles)
        if self._floor is not None:
            tiles = [
                detections.with_columns(floor=tile.floor(detections.upright, **self._floor))
                for tile, detections in zip(bound.remap.tiles, tiles, strict=True)
            ]
        detections = in_picture(bound.remap, tiles)
        if tiles[0].masks is not None:
            # One by one: all masks at once could fill the memory.
            masks = [
                encode_rle(bound.remap.tiles[tile].back(tiles[tile].masks[row, None])[0] > 0.5)
                for tile, row in detections.more["source"].tolist()
            ]
            detections = replace(detections, masks=masks)
        names = [self._name(label) for label in detections.labels.tolist()]
        name, size = file_of(entry, self._names), (image.shape[0], image.shape[1])
        if self._format == "coco":
            if name not in self._ids:
                self._ids[name] = next(self._free_ids)
            of = {"image_id": self._ids[name], "file_name": name}
            self._results += [of | result for result in coco_annotations(detections)]
        if self._format == "yolo":
            replace_file(self._out / f"labels/{name}.txt", yolo_lines(detections, size))
        scores = zip(names, detections.scores, strict=True)
        texts = [f"{name} {score:.2f}" for name, score in scores]
        picture = write_overlay(self._out, name, draw_instances(image, detections, texts))
        return {"overlay": picture, "detections": _entries(detections, names, bound.remap)}

    def flush(self) -> None:
        if self._format == "coco":
            replace_file(self._out / RESULTS, json.dumps(self._results, allow_nan=False))

    def _name(self, label: int) -> str | int:
        """The name of a class by `labels` or the file of the network, or else its number."""
        if self.labels is None:
            return self.network.names.get(label, label)
        if label not in self.labels:
            names = f"{counted(len(self.labels), 'name')}, {min(self.labels)} to {max(self.labels)}"
            text = f"{self.network.path} found class {label}, but `labels` has {names}, without it"
            raise naming(ValueError(text), "labels")
        return self.labels[label]

    def _outputs(
        self,
        entry: dict[str, Any],
        image: np.ndarray,
        bound: BoundView,
        outputs: dict[str, np.ndarray],
    ) -> dict[str, Any]:
        """Writes maps at the size of the picture; numbers are part of the answer."""
        answer: dict[str, Any] = {}
        for output, values in outputs.items():
            if values.ndim < 4:
                each = [self._best(v) if output in self._classes else v.tolist() for v in values]
                answer[output] = each[0] if len(each) == 1 else each
                continue
            folder = re.sub(r"[^\w.-]", "_", output)
            name = f"{folder}/{file_of(entry, self._names)}"
            is_ids = values.dtype.kind in "biu"  # of classes or things
            maps = torch.from_numpy(values.astype(np.int64 if is_ids else np.float32))
            planes = bound.remap.back(maps)[0].numpy()
            content = io.BytesIO()
            np.save(content, planes)
            replace_file(self._out / f"maps/{name}.npy", content.getbuffer())
            answer[output] = {"map": f"maps/{name}.npy"}
            labels = planes[0] if is_ids and len(planes) == 1 else np.argmax(planes, 0)
            if len(planes) > IGNORE or (len(planes) == 1 and not is_ids):
                continue
            if labels.min() < 0 or labels.max() > IGNORE:
                continue  # ids of things
            labels = np.where(bound.remap.shown, labels, IGNORE)
            colors = palette(IGNORE if is_ids else len(planes))
            answer[output] |= self._labels(name, image, labels.astype(np.uint8), colors)
        return answer

    def _labels(
        self, name: str, image: np.ndarray, labels: np.ndarray, colors: Sequence[Any]
    ) -> dict[str, Any]:
        """Writes ids (H, W) as a PNG, and on the picture."""
        replace_file(self._out / f"labels/{name}.png", label_png(labels, colors))
        laid = overlay(image, label_image(labels, colors), where=labels != IGNORE)
        answer: dict[str, Any] = {"labels": f"labels/{name}.png"}
        answer["overlay"] = write_overlay(self._out, name, laid)
        if self.labels is not None:
            counts = np.bincount(labels.ravel(), minlength=IGNORE + 1)[:IGNORE]
            shares = (counts / max(1, counts.sum())).round(6).tolist()
            answer["shares"] = {str(self._name(k)): s for k, s in enumerate(shares) if counts[k]}
        return answer

    def _best(self, values: np.ndarray) -> list[dict[str, Any]]:
        """The `top` classes of one picture."""
        values = values.astype(np.float64)
        key = "probability"
        if values.min() < 0 or values.max() > 1:
            text = f"{self.network.path} gives logits: their softmax are the probabilities"
            warnings.warn(text, stacklevel=2)
            values = np.exp(values - values.max())
            values /= values.sum()
        elif abs(values.sum() - 1) > 1e-2:  # of half precision
            key = "score"  # of each class on its own
        best = np.argsort(-values, kind="stable")[: self._top]
        return [{"class": self._name(int(k)), key: round(float(values[k]), 6)} for k in best]


def _entries(
    detections: Instances, names: Sequence[str | int], remap: Remap
) -> list[dict[str, Any]]:
    """The detections in a picture as the entries of predictions.json."""
    there = spherical(detections.boxes, remap.rays_of_image)
    columns = {
        "label": names,
        "score": rounded(detections.scores, 4),
        "box": rounded(detections.upright, 2),
        "visible": rounded(detections.more["visible"], 4),
        "cut": detections.more["cut"].tolist(),
    }
    for angle in ("azimuth", "elevation", "width", "height"):
        columns[f"{angle}_deg"] = rounded(np.degrees(getattr(there, angle)), 3)
    columns["ray"] = rounded(there.ray, 6)
    if detections.keypoints is not None:
        columns["keypoints"] = rounded(detections.keypoints, 3)
    if detections.boxes.shape[1] == 5:
        columns["turned"] = rounded(detections.boxes, 4)
    if "floor" in detections.more:
        places = rounded(detections.more["floor"], 3)
        columns["floor"] = [None if None in place else place for place in places]
    if detections.masks is not None:
        columns["mask"] = detections.masks
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def rounded(values: Any, digits: int) -> Any:
    """Numbers in lists for JSON, which has no NaN and no infinity."""
    if np.ndim(values):
        return [rounded(value, digits) for value in values]
    return round(float(values), digits) if math.isfinite(values) else None
