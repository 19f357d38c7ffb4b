"""COCO's panoptic labels, and data sets of the same form.

The reader uses `annotations/panoptic_SPLIT….json`, for example `panoptic_train2017.json`; the PNGs
of segments in `annotations/panoptic_train2017/` or `panoptic_train2017/`; and the pictures in
`train2017/` or `images/train2017/`. The classes are the categories, in the order of the file.

Source: Kirillov et al., Panoptic Segmentation, CVPR 2019, and cocodataset.org/#format-data.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from darswin.data.scenes.files import Options, pair, pictures_in, stems
from darswin.data.scenes.scene import IGNORE, Scenes, as_classes
from darswin.data.splits import SPLITS, Split, read_json
from darswin.utils.image import decoded, file_content

# The name of each PNG: the ids of its segments, sorted, and their classes.
Segments = Mapping[str, tuple[np.ndarray, np.ndarray]]


def is_coco(root: Path) -> bool:
    return bool(_files(root))


def open_coco(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    if options.target != "labels":
        raise ValueError(f"{root} looks like COCO panoptic, which has labels but no distances")
    parts = _files(root)
    part, choose = options.choose_part(parts, root)
    file = parts[part]
    content = read_json(file)
    try:
        categories, annotations = content["categories"], content["annotations"]
        own = [category["name"] for category in categories]
        colors = [category["color"] for category in categories if "color" in category]
        class_of, classes = options.labels(
            lambda: as_classes(own, colors, file),
            {category["id"]: k for k, category in enumerate(categories)},
        )
        assert class_of is not None
        segments = {a["file_name"]: _segments(a["segments_info"], class_of) for a in annotations}
    except (KeyError, TypeError) as error:
        raise ValueError(f"{file} is not in COCO's panoptic format: it lacks {error}") from error
    name = file.stem.removeprefix("panoptic_")
    targets = stems(_first(root / "annotations" / file.stem, root / file.stem), (".png",))
    pairs = pair(
        pictures_in(_first(root / name, root / "images" / name)),
        {stem: target for stem, target in targets.items() if f"{stem}.png" in segments},
        choose,
        root=root,
        what="labels",
        strict=False,
    )
    files, lenses = list(pairs.values()), options.shared_lens(root)
    read = partial(read_segments, segments=segments)
    return Scenes(root, files, lenses, target="labels", classes=classes, read=read)


def _files(root: Path) -> dict[Split, Path]:
    """The annotations of each split."""
    found = {split: sorted(root.glob(f"annotations/panoptic_{split}*.json")) for split in SPLITS}
    if several := [files for files in found.values() if len(files) > 1]:
        raise ValueError(f"{several[0][0]} and {several[0][1]} are for one split: keep one of them")
    return {split: files[0] for split, files in found.items() if files}


def _first(folder: Path, other: Path) -> Path:
    return folder if folder.is_dir() else other


def _segments(infos: Any, class_of: Mapping[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The ids of segments, sorted, and their classes."""
    known = sorted((info["id"], class_of.get(info["category_id"], IGNORE)) for info in infos)
    known = [(0, IGNORE), *known]  # no segment
    return np.array([k for k, _ in known], np.int32), np.array([c for _, c in known], np.uint8)


def read_segments(path: Path, segments: Segments) -> np.ndarray:
    """The classes (H, W) uint8 of a PNG whose colours are segments' ids, R + 256 G + 256² B."""
    colors = decoded(file_content(path), path, cv2.IMREAD_COLOR_RGB).astype(np.int32)
    ids = colors @ np.array([1, 256, 65536], np.int32)
    known, classes = segments[path.name]
    places = np.searchsorted(known, ids).clip(max=len(known) - 1)
    if (unknown := ids[known[places] != ids]).size:
        raise ValueError(f"{path} holds the segment {unknown[0]}, but its annotation lacks it")
    return classes[places]
