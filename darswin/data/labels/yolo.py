"""YOLO's text files: a line for each thing, with its class and its box, outline or keypoints.

The labels of `…/images/…/NAME.jpg` are in `…/labels/…/NAME.txt`, or else beside the picture; a
picture without a file has no things. `data.yaml` has the names of the classes, and `kpt_shape` if
there are keypoints; or `classes.txt` has one name per line. All numbers are shares of the sides of
the picture.

Source: docs.ultralytics.com/datasets.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from darswin.data.cameras import Calibrations
from darswin.data.labels.labels import LabelledPictures, Labels, Size, Thing
from darswin.data.scenes.files import calibration_in, pictures_in
from darswin.utils.files import replace_file
from darswin.utils.text import read_text

_NAMES = ("data.yaml", "dataset.yaml", "data.yml", "classes.txt")


def is_yolo(root: Path) -> bool:
    """True for a folder that has a file of classes."""
    return any((root / name).is_file() for name in _NAMES)


def read_yolo(root: str | Path) -> LabelledPictures:
    """The pictures below a folder, of all splits, and their things.

    Raises:
        FileNotFoundError: no classes, no pictures, or no labels.
        ValueError: from `labels(k)`, a line of another form; it names the file.
    """
    root = Path(root)
    names, per_keypoint = _classes(root)
    pictures = pictures_in(root)
    texts = [str(_text_of(root, Path(stem))) for stem in pictures]
    if not any(Path(text).is_file() for text in texts):
        raise FileNotFoundError(f"no labels in {root}: the first would be {texts[0]}")
    calibration = calibration_in(root)
    return LabelledPictures(
        root, [str(Path(file).relative_to(root)) for file in pictures.values()], texts,
        partial(_labels, classes=len(names), per_keypoint=per_keypoint),
        [{"id": k, "name": name} for k, name in enumerate(names)],
        lenses=Calibrations(calibration, root) if calibration else None,
    )  # fmt: skip


def write_yolo(
    root: str | Path,
    pictures: Sequence[tuple[Mapping[str, Any], Labels]],
    categories: Sequence[Mapping[str, Any]],
) -> None:
    """Writes the text files and `data.yaml` for pictures in `root`; arguments as for `write_coco`.

    The classes are the categories in their order. A thing with masks or without an outline is
    written as a box, and parts of an outline are joined. Crowds are left out, as YOLO has none.
    """
    number = {category["id"]: k for k, category in enumerate(categories)}
    shape = None
    for entry, labels in pictures:
        lines = []
        for thing in labels.things:
            if not thing.crowd:
                numbers = _numbers(thing, np.array(labels.size[::-1]))
                lines.append(
                    " ".join([str(number[thing.category]), *map("{:.6f}".format, numbers)])
                )
            if thing.keypoints is not None:
                shape = list(thing.keypoints.shape)
        text = _text_of(Path(root), Path(entry["file_name"]).with_suffix(""))
        replace_file(text, "".join(f"{line}\n" for line in lines))
    content: dict[str, Any] = {"path": ".", "train": "images", "val": "images"}
    content |= {"names": {k: category["name"] for k, category in enumerate(categories)}}
    content |= {} if shape is None else {"kpt_shape": shape}
    replace_file(Path(root) / _NAMES[0], yaml.safe_dump(content, sort_keys=False))


def _numbers(thing: Thing, sides: np.ndarray) -> np.ndarray:
    if len(thing.polygons) and thing.keypoints is None:
        # Parts are joined by lines there and back between their first points.
        closed = [np.concatenate((part, part[:1])) for part in thing.polygons]
        back = [part[:1] for part in thing.polygons[-2::-1]]
        return (np.concatenate(closed + back)[:-1] / sides).ravel()
    low, high = thing.box[:2] / sides, thing.box[2:] / sides
    found = [(low + high) / 2, high - low]
    if thing.keypoints is not None:
        found.append((thing.keypoints / [*sides, 1.0]).ravel())
    return np.concatenate(found)


def _text_of(root: Path, stem: Path) -> Path:
    """The file of the labels of a picture; a path relative to `root`."""
    parts = list(stem.parts)
    for place in range(len(parts) - 2, -1, -1):
        if parts[place] == "images":
            parts[place] = "labels"
            break
    return root.joinpath(*parts[:-1], f"{parts[-1]}.txt")


def _classes(root: Path) -> tuple[list[str], int]:
    """The names, and the numbers of each keypoint: 0 if there are none."""
    file = next((root / name for name in _NAMES if (root / name).is_file()), None)
    if file is None:
        raise FileNotFoundError(f"no data.yaml or classes.txt in {root}")
    if file.suffix == ".txt":
        return [line.strip() for line in read_text(file).splitlines() if line.strip()], 0
    try:
        content = yaml.safe_load(read_text(file))
        names, shape = content["names"], content.get("kpt_shape")
        if isinstance(names, Mapping):
            names = [names[k] for k in range(len(names))]
        return list(map(str, names)), 0 if shape is None else int(shape[1])
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{file} must name the classes 0, 1, … under names: {error}") from error


def _labels(text: str, size: Size, classes: int, per_keypoint: int) -> Labels:
    sides, things = np.array(size[::-1], float), []
    lines = read_text(text).splitlines() if Path(text).is_file() else []
    for line_number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            category, *rest = map(float, line.split())
            numbers = np.array(rest)
        except ValueError:
            category, numbers = -1.0, np.zeros(0)
        keypoints = None
        if per_keypoint and len(numbers) > 4 and (len(numbers) - 4) % per_keypoint == 0:
            keypoints = numbers[4:].reshape(-1, per_keypoint)
            numbers = numbers[:4]
            seen = keypoints[:, 2] if per_keypoint == 3 else 2.0 * keypoints.any(1)
            keypoints = np.column_stack((keypoints[:, :2] * sides, seen))
        is_class = category in range(classes)
        is_form = len(numbers) == 4 or (len(numbers) >= 6 and len(numbers) % 2 == 0)
        if not (is_class and is_form and np.isfinite(numbers).all()):
            raise ValueError(
                f"{text}, line {line_number}: must be a class below {classes} and 4 numbers of a "
                f"box, or pairs of an outline, got {line.strip()[:80]!r}"
            )
        table = numbers.reshape(-1, 2) * sides
        if len(table) == 2:
            box = np.concatenate((table[0] - table[1] / 2, table[0] + table[1] / 2))
            things.append(Thing(int(category), box, keypoints=keypoints))
        else:
            box = np.concatenate((table.min(0), table.max(0)))
            things.append(Thing(int(category), box, [table]))
    return Labels(things, size)
