"""COCO's panoptic labels, and data sets of the same form.

The reader uses `annotations/panoptic_SPLIT….json`, for example `panoptic_train2017.json`; the PNGs
of segments in `annotations/panoptic_train2017/` or `panoptic_train2017/`; and the pictures in
`train2017/` or `images/train2017/`. The classes are the categories, in the order of the file.
Pictures and PNGs may lie in folders there, as `file_name` says. The id 0 means no segment. Ids of
2²⁴ or more count modulo 2²⁴, because the colour of a pixel holds no more.

Source: Kirillov et al., Panoptic Segmentation, CVPR 2019, and cocodataset.org/#format-data.
"""

import os
import reprlib
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from darswin.data.scenes.files import Options, pair, pictures_in, stem_of, stems
from darswin.data.scenes.scene import Scenes, as_classes
from darswin.data.splits import SPLITS, Split, some
from darswin.utils.image import decoded, file_content
from darswin.utils.tasks import IGNORE
from darswin.utils.text import read_json

COLORS = 1 << 24
T = TypeVar("T")
_KINDS: dict[type, str] = {int: "a whole number", str: "a text", list: "a list"}
_FORM = "is not in COCO's panoptic format"


class Segments(NamedTuple):
    """The segments of a PNG. Attributes: ids: sorted; classes: of these ids, or `IGNORE`."""

    ids: np.ndarray
    classes: np.ndarray


def is_coco(root: Path) -> bool:
    return bool(_files(root))


def open_coco(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    parts = _files(root)
    part, choose = options.choose_part(parts, root)
    file = parts[part]
    content = read_json(file)
    if not isinstance(content, dict):
        raise ValueError(f"{file} {_FORM}: it must be a JSON object, got {reprlib.repr(content)}")
    categories = _objects(content, "categories", file)
    own = [_entry(category, "name", str, file) for category in categories]
    colors = [category["color"] for category in categories if "color" in category]
    ids = {_entry(category, "id", int, file): k for k, category in enumerate(categories)}
    named = [
        (_entry(annotation, "file_name", str, file), _objects(annotation, "segments_info", file))
        for annotation in _objects(content, "annotations", file)
    ]
    if len(ids) < len(own):
        counts = Counter(category["id"] for category in categories)
        raise ValueError(f"{file} defines the category {counts.most_common(1)[0][0]} twice")
    class_of, classes = options.classes_of(lambda: as_classes(own, colors, file), ids, ids)
    assert class_of is not None
    folder = _first(root / "annotations" / file.stem, root / file.stem)
    targets = stems(folder, (".png",))
    segments: dict[str, Segments] = {}
    for png, infos in named:
        if (stem := _named(png, targets)) is None:
            continue  # `pair` tells of pictures without labels
        if stem in segments:
            raise ValueError(f"{file} has two annotations for {targets[stem]}")
        segments[stem] = _segments(infos, class_of, f"{file}: {png}")
    name = file.stem.removeprefix("panoptic_")
    pairs = pair(
        pictures_in(_first(root / name, root / "images" / name)),
        {stem: target for stem, target in targets.items() if stem in segments},
        choose,
        root=root,
        what="labels",
        strict=False,
    )
    files, lenses = list(pairs.values()), options.shared_lens(root)
    read = partial(read_segments, folder=folder, segments=segments)
    return Scenes(root, files, lenses, target="labels", classes=classes, read=read)


def _files(root: Path) -> dict[Split, Path]:
    """The annotations of each split."""
    found = {split: sorted(root.glob(f"annotations/panoptic_{split}*.json")) for split in SPLITS}
    if several := [files for files in found.values() if len(files) > 1]:
        raise ValueError(f"{several[0][0]} and {several[0][1]} are for one split: keep one of them")
    return {split: files[0] for split, files in found.items() if files}


def _objects(parent: Mapping, name: str, file: Path) -> list[Mapping]:
    """The list of objects that `parent` has under a name."""
    entries = _entry(parent, name, list, file)
    if wrong := [entry for entry in entries if not isinstance(entry, dict)]:
        raise ValueError(
            f"{file} {_FORM}: {name!r} must list objects, got {reprlib.repr(wrong[0])}"
        )
    return entries


def _entry(parent: Mapping, name: str, kind: type[T], file: Path) -> T:
    if name not in parent:
        raise ValueError(f"{file} {_FORM}: it lacks {name!r} in {reprlib.repr(parent)}")
    value = parent[name]
    if type(value) is not kind:
        raise ValueError(
            f"{file} {_FORM}: {name!r} must be {_KINDS[kind]}, got {reprlib.repr(value)}"
        )
    return value


def _first(folder: Path, other: Path) -> Path:
    return folder if folder.is_dir() else other


def _named(file_name: str, targets: Mapping[str, str]) -> str | None:
    """The stem of the PNG that an annotation names, with more folders than `targets` or as many."""
    parts = stem_of(file_name.replace("\\", "/")).split(os.sep)
    ends = (os.path.join(*parts[k:]) for k in range(len(parts)))
    return next((stem for stem in ends if stem in targets), None)


def _segments(infos: Sequence[Mapping], class_of: Mapping[int, int], where: str) -> Segments:
    """The segments of a PNG, and 0 for no segment."""
    found = {-1: IGNORE, 0: IGNORE}  # no colour is -1, so that the table is never empty
    for info in infos:
        if missing := [name for name in ("id", "category_id") if name not in info]:
            raise ValueError(f"{where}: a segment has no {missing[0]!r}")
        id_, category = info["id"], info["category_id"]
        if type(category) is not int or category not in class_of:
            raise ValueError(
                f"{where}: the segment {id_} has the category {reprlib.repr(category)}, but "
                f"the known categories are {some(list(class_of))}"
            )
        if type(id_) is not int or id_ < 1:
            raise ValueError(
                f"{where}: the id of a segment must be a whole number above 0, which means no "
                f"segment, got {id_!r}"
            )
        if id_ % COLORS == 0:
            found.pop(0, None)  # black pixels, if there are any, may be its own
            continue
        class_ = class_of[category]
        if found.setdefault(id_ % COLORS, class_) != class_:
            raise ValueError(f"{where}: two segments have the colour of the id {id_}")
    ids = sorted(found)
    return Segments(np.array(ids, np.int32), np.array([found[k] for k in ids], np.uint8))


def read_segments(path: Path, folder: Path, segments: Mapping[str, Segments]) -> np.ndarray:
    """The classes (H, W) uint8 of a PNG whose colours are segments' ids, R + 256 G + 256² B.
    `segments` are those of each PNG, by its stem in `folder`."""
    colors = decoded(file_content(path), path, cv2.IMREAD_COLOR_RGB).astype(np.int32)
    ids = colors @ np.array([1, 256, 65536], np.int32)
    known, classes = segments[stem_of(os.path.relpath(path, folder))]
    places = np.searchsorted(known, ids).clip(max=len(known) - 1)
    if (unknown := ids[known[places] != ids]).size:
        raise ValueError(f"{path} holds the segment {unknown[0]}, but its annotation lacks it")
    return classes[places]
