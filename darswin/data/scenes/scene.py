"""Scenes: pictures with a label or a distance for each pixel, and the lenses that took them."""

import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch

from darswin.data.cameras import Calibrations
from darswin.data.pictures import Form, form_of
from darswin.data.sample import Sample
from darswin.data.scenes.targets import (
    IGNORE,
    KINDS,
    Target,
    nothing_of,
    target_header,
)
from darswin.data.splits import Limited, read_classes, some
from darswin.lens import Lens
from darswin.utils.image import Header, read_header, read_oriented
from darswin.utils.text import is_json_file, read_json
from darswin.utils.words import in_px


class Classes(NamedTuple):
    """Attributes: names: in the order of the ids; colors: (r, g, b) in 0 … 255, or empty."""

    names: list[str]
    colors: list[list[int]]


NO_CLASSES = Classes([], [])


class Scenes(Limited):
    """A sequence of scenes; a scene is read from its files when it is indexed.

    Args:
        root: the folder of the files. files: (picture, target) pairs, relative to `root`.
        lenses: the lenses of the pictures. target: "labels" or "distance", the kind of the targets.
        classes: the names and colours of the ids in labels.
        views: the name of each picture's camera in `cameras`; None takes the names from `lenses`.
        read: the function that reads a target file; None means the one of `target`.
        trim: (rows, height): the number of rows that are cut at the top and at the bottom of a
            picture of this height, and the same share of other pictures. The lenses follow.

    Attributes:
        channels: the channels of the images, 3 or 1.
        classes, colors: the names and colours of the classes. cameras: the names of the cameras.
        unknown: (N,) int64, the number of pixels in each target without a label or a distance; -1
            if no process has read the target yet.
    """

    PER_PICTURE = ("_pictures", "_targets", "_camera", "unknown")

    def __init__(
        self,
        root: Path,
        files: Sequence[tuple[str, str]],
        lenses: Calibrations,
        *,
        target: Target,
        classes: Classes = NO_CLASSES,
        views: Sequence[str] | None = None,
        read: Callable[[Path], np.ndarray] | None = None,
        trim: tuple[int, int] = (0, 1),
    ):
        self.root, self.lenses, self.target, self.channels = Path(root), lenses, target, 3
        self.classes, self.colors = list(classes.names), list(classes.colors)
        if read is None:
            read = KINDS[target].read
            read = partial(read, classes=len(classes.names)) if target == "labels" else read
        self.read, self.trim = read, trim
        # Worker processes share arrays, but would copy a million strings.
        self._pictures = np.array([os.fsencode(picture) for picture, _ in files], np.bytes_)
        self._targets = np.array([os.fsencode(file) for _, file in files], np.bytes_)
        if views is None:
            self.cameras = [camera.name for camera in lenses.cameras]
            self._camera = lenses.cameras_of([self.file(k) for k in range(len(files))])
        else:
            self.cameras = list(dict.fromkeys(views))
            number = {name: k for k, name in enumerate(self.cameras)}
            self._camera = np.array([number[name] for name in views], np.int64)
        self.unknown = torch.full((len(files),), -1, dtype=torch.int64).share_memory_()

    def __len__(self) -> int:
        return len(self._pictures)

    def __getitem__(self, index: int) -> Sample:
        """The scene; BrokenImageError or ValueError for files that are broken or do not fit."""
        image, orientation = read_oriented(self.file(index), self.channels)
        target = self.read(self.target_file(index))
        size = image.shape[0], image.shape[1]
        self._check(index, size, orientation, target.shape)
        lens = self.lenses.lens_of(self.file(index), size)
        rows = self._rows(size[0])
        kept = slice(rows, size[0] - rows)
        image, target = image[kept], target[kept]
        self.unknown[index] = int(np.count_nonzero(target == nothing_of(target)))
        return Sample(image, target, self._trimmed(lens))

    def headers(self, index: int) -> list[Header]:
        """The headers of the picture and of its target."""
        return [read_header(self.file(index)), target_header(self.target_file(index))]

    def check(self, index: int, picture: Header, target: Header) -> None:
        """Raises the ValueErrors of `self[index]` that the headers of its files tell."""
        self._check(index, picture.upright, picture.orientation, target.size)
        self.lenses.check(self.file(index), picture.size)

    def _check(
        self, index: int, size: tuple[int, int], orientation: int, target: tuple[int, ...]
    ) -> None:
        if orientation != 1:
            raise ValueError(
                f"{self.file(index)} has the EXIF orientation {orientation}, so its labels or "
                "distances may fit the stored or the upright picture: store it upright"
            )
        if target != size:
            raise ValueError(
                f"{self.target_file(index)} has {in_px(target)}, but its picture "
                f"{self.file(index)} has {in_px(size)}"
            )

    def limited(self, count: int) -> Self:
        part = super().limited(count)
        part.unknown.share_memory_()
        return part

    def file(self, index: int) -> Path:
        """The file of the picture."""
        return self.root / os.fsdecode(self._pictures[index])

    def target_file(self, index: int) -> Path:
        """The file of the labels or distances."""
        return self.root / os.fsdecode(self._targets[index])

    def form(self) -> Form:
        """The form of the pictures as they are stored."""
        return form_of(self.file, len(self))

    def camera_of(self, index: int) -> int:
        """The number in `cameras` of the camera that took a picture."""
        return int(self._camera[index])

    def lens_alone(self, index: int) -> Lens:
        """The lens of a picture that cannot be read, at the size of the calibration."""
        lens = self.lenses.lens_alone(self.file(index))
        return self._trimmed(lens)

    def _rows(self, height: int) -> int:
        """The number of rows to cut at the top of a picture."""
        rows, of = self.trim
        return -(-rows * height // of)

    def _trimmed(self, lens: Lens) -> Lens:
        if not self.trim[0] or lens.image_size is None:
            return lens
        height, width = (round(side) for side in lens.image_size[0].tolist())
        rows = self._rows(height)
        return lens.cropped(rows, 0, height - 2 * rows, width)


# -- classes ----------------------------------------------------------------------------------


def read_palette(path: str | Path) -> Classes:
    """The classes in a list, as for `read_classes`, or in a JSON object of "names" and "colors"."""
    content = read_json(path) if is_json_file(path) else None
    if isinstance(content, Mapping):
        return as_classes(content.get("names"), content.get("colors", []), path)
    return as_classes(read_classes(path), [], path)


def read_label_map(
    path: str | Path, own: Callable[[], Classes], is_given: bool
) -> tuple[dict[int, int], Classes]:
    """The class of each id in the label files, or `IGNORE`, from a JSON object, and all classes.

    The values are names or ids of classes, or null for ids that mean unlabelled. The classes are
    `own()`, or the names in the order of the file unless `is_given`.
    """
    content = read_json(path)
    form = (
        f'{path} must be a JSON object that maps ids to classes, such as {{"7": "road", "8": 1, '
        '"9": null}'
    )
    if not isinstance(content, Mapping) or not content:
        raise ValueError(f"{form}, got {content!r}")
    names = [value for value in content.values() if isinstance(value, str)]
    from_names = bool(names) and not is_given
    classes = as_classes(list(dict.fromkeys(names)), [], path) if from_names else own()
    found: dict[int, int] = {}
    for key, value in content.items():
        if not key.isdecimal():
            raise ValueError(f"{form}, got the id {key!r}")
        if int(key) in found:
            raise ValueError(f"{path} maps the id {int(key)} twice")
        if value is None or value == IGNORE:
            found[int(key)] = IGNORE
            continue
        class_ = classes.names.index(value) if value in classes.names else value
        if type(class_) is not int or not 0 <= class_ < len(classes.names):
            raise ValueError(
                f"{path} maps the id {key} to {value!r}, but the classes are "
                f"{some(classes.names)} with the ids 0 to {len(classes.names) - 1}"
            )
        found[int(key)] = class_
    return found, classes


def as_classes(names: Any, colors: Any, path: str | Path) -> Classes:
    """The checked classes of a file."""
    is_list = isinstance(names, list) and names and all(isinstance(name, str) for name in names)
    if not is_list:
        raise ValueError(f"{path} must name the classes as a list of words, got {names!r}")
    if len(set(names)) < len(names) or len(names) > IGNORE:
        raise ValueError(f"{path} must name each class once, and at most {IGNORE}, got {names}")
    is_list = isinstance(colors, list) and len(colors) in (0, len(names))
    if not is_list or not all(_is_color(color) for color in colors):
        raise ValueError(
            f"{path} must give all {len(names)} classes a color [r, g, b] in 0 … 255, or none, got "
            f"{colors!r}"
        )
    return Classes(list(names), [list(color) for color in colors])


def _is_color(value: Any) -> bool:
    numbers = isinstance(value, list) and len(value) == 3
    return numbers and all(type(v) is int and 0 <= v <= 255 for v in value)
