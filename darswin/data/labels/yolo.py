"""YOLO's text files: a line for each instance, with its class and its box, outline or keypoints.

The labels of `…/images/…/NAME.jpg` are in `…/labels/…/NAME.txt`, or else beside the picture; a
picture without a file has none. `data.yaml` has the names of the classes, and `kpt_shape` if
there are keypoints; or `classes.txt` has one name per line. All numbers are shares of the sides of
the picture. The four corners of an oriented box are an outline, and become one of many corners.

Source: docs.ultralytics.com/datasets.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from darswin.boxes import Instances, corners, decode_rle
from darswin.boxes.regions import NO_AREA, area_of, box_of
from darswin.data.cameras import Calibrations
from darswin.data.folders import files_below
from darswin.data.labels.judge import MIDDLE, boxes_with_more, check_form, check_shares
from darswin.data.labels.labels import (
    LabelledPictures,
    Labels,
    Size,
    check_labels,
    known_keypoints,
    labelled,
)
from darswin.data.scenes.files import calibration_in, pictures_in
from darswin.data.splits import read_list, some
from darswin.utils.files import replace_file
from darswin.utils.text import read_text
from darswin.utils.words import counted

_SPLITS = ("train", "val", "test")
_NAMES = ("data.yaml", "dataset.yaml", "data.yml", "classes.txt")


def is_yolo(path: Path) -> bool:
    """True for a folder that has a file of classes, or for its data.yaml."""
    if path.suffix.lower() in (".yaml", ".yml"):
        return path.is_file()
    return any((path / name).is_file() for name in _NAMES)


def read_yolo(path: str | Path) -> LabelledPictures:
    """The pictures below a folder, of all splits, and their instances.

    Raises:
        FileNotFoundError: no classes, no pictures, or no labels.
        ValueError: lines that together are in another unit or order; or from `labels(k)`, one of
            another form. It names the file. Texts without a picture are named in `wrong`.
    """
    root, content = _content(Path(path))
    names, shape = content["names"], content.get("kpt_shape") or (0, 0)
    pictures = pictures_in(root)
    texts = [_text_of(root, Path(stem)) for stem in pictures]
    if not any(text.is_file() for text in texts):
        raise FileNotFoundError(f"no labels in {root}: the first would be {texts[0]}")
    lines = [_lines(text) for text in texts]
    rows = {place: row[1:] for part in lines for place, _, row in part if len(row) > 4}
    check_shares(rows)
    check_form(root, MIDDLE, [row[:4] for row in rows.values() if len(row) == 4 or shape[0]])
    more = set() if shape[0] else boxes_with_more(rows)
    raw = [
        [(place, line, row[:0] if place in more else row) for place, line, row in part]
        for part in lines
    ]
    calibration = calibration_in(root)
    return LabelledPictures(
        root, [str(Path(file).relative_to(root)) for file in pictures.values()], raw,
        partial(_labels, classes=len(names), shape=shape),
        [{"id": k, "name": name} for k, name in enumerate(names)],
        lenses=Calibrations(calibration, root) if calibration else None,
        wrong=_without_picture(root, texts),
    )  # fmt: skip


def write_yolo(
    root: str | Path,
    pictures: Sequence[tuple[Mapping[str, Any], Labels]],
    categories: Sequence[Mapping[str, Any]],
    more: Mapping[str, Any] | None = None,
) -> None:
    """Writes the text files and `data.yaml` for pictures in `root`; arguments as for `write_coco`.

    The classes are the categories in their order. Crowds are left out, as YOLO has none; see
    `yolo_lines` for the others. Raises the errors of `write_coco`.

    Args:
        more: other entries of `data.yaml`, such as the splits.
    """
    number = {category["id"]: k for k, category in enumerate(categories)}
    shape = list((more or {}).get("kpt_shape") or (0, 3))
    for entry, labels in pictures:
        instances = labels.instances
        if "crowd" in instances.more:
            instances = instances[~instances.more["crowd"]]
        if instances.keypoints is not None and len(instances):
            shape = [max(instances.keypoints.shape[1], shape[0]), 3]
        classes = [number[label] for label in check_labels(instances, number)]
        lines = yolo_lines(replace(instances, labels=np.array(classes)), labels.size)
        text = _text_of(Path(root), Path(entry["file_name"]).with_suffix(""))
        replace_file(text, lines)
    names = {k: category["name"] for k, category in enumerate(categories)}
    content = {"path": ".", **(more or {}), "names": names}
    content |= {"kpt_shape": shape} if shape[0] else {}
    replace_file(Path(root) / _NAMES[0], yaml.safe_dump(content, sort_keys=False))


def yolo_lines(instances: Instances, size: Size) -> str:
    """The lines of the instances of a picture of (H, W): class, place, and score if there are any.

    The place is the outline, whose parts are joined, or that of the mask; the corners of a turned
    box; or else the box. Instances with keypoints are written as boxes, since a line of YOLO
    holds either an outline or keypoints.
    """
    sides, upright = np.array(size[::-1], float), instances.upright.reshape(-1, 2, 2)
    lines = []
    for k, (low, high) in enumerate(upright):
        numbers = np.stack(((low + high) / 2, high - low)) / sides
        if len(points := known_keypoints(instances, k)):
            numbers = np.concatenate((numbers.ravel(), (points / [*sides, 1.0]).ravel()))
        elif len(outline := _outline(instances, k)):
            numbers = _one_part(outline) / sides
        elif instances.boxes.shape[1] == 5 and instances.boxes[k, 4]:
            numbers = corners(instances.boxes[k, None])[0] / sides
        score = [] if instances.scores is None else [instances.scores[k]]
        text = " ".join(f"{number:.6f}" for number in (*numbers.ravel(), *score))
        lines.append(f"{int(instances.labels[k])} {text}\n")
    return "".join(lines)


def _outline(instances: Instances, row: int) -> Sequence[np.ndarray]:
    """The parts of the outline of an instance, or of its mask; none if it has neither."""
    if (mask := instances.mask_of(row)) is None:
        return instances.outline_of(row)
    pixels = decode_rle(mask).astype(np.uint8)
    outlines, _ = cv2.findContours(pixels, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outlines = [outline.reshape(-1, 2) + 0.5 for outline in outlines]
    return [outline for outline in outlines if area_of(outline) > NO_AREA]


def _one_part(polygons: Sequence[np.ndarray]) -> np.ndarray:
    """The parts of an outline, joined by lines there and back between their first points."""
    closed = [np.concatenate((part, part[:1])) for part in polygons]
    back = [part[:1] for part in polygons[-2::-1]]
    return np.concatenate(closed + back)[:-1]


def _text_of(root: Path, stem: Path) -> Path:
    """The file of the labels of a picture; a path relative to `root`."""
    parts = list(stem.parts)
    for place in range(len(parts) - 2, -1, -1):
        if parts[place] == "images":
            parts[place] = "labels"
            break
    return root.joinpath(*parts[:-1], f"{parts[-1]}.txt")


def _content(path: Path) -> tuple[Path, dict[str, Any]]:
    """The folder of the pictures, and what the file of classes says; its names as a list."""
    file = path
    if path.suffix.lower() not in (".yaml", ".yml"):
        files = [path / name for name in _NAMES if (path / name).is_file()]
        if not files:
            raise FileNotFoundError(f"no data.yaml or classes.txt in {path}")
        file = files[0]
    if file.suffix == ".txt":
        return file.parent, {"names": read_list(file)}
    try:
        content = dict(yaml.safe_load(read_text(file)))
        names, shape = content["names"], content.get("kpt_shape")
        if isinstance(names, Mapping):
            names = [names[k] for k in range(len(names))]
        content |= {"names": list(map(str, names))}
        content |= {} if shape is None else {"kpt_shape": [int(number) for number in shape[:2]]}
        if (content.get("kpt_shape") or (0, 3))[1] not in (2, 3):
            raise ValueError(f"kpt_shape is a count, and 2 or 3 numbers of each, not {shape}")
    except (yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{file} must name the classes 0, 1, … under names: {error}") from error
    root = file.parent / str(content.get("path") or ".")
    return (root if root.is_dir() else file.parent), content


def moved_splits(
    source: Path, folder: Path, new_names: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Any], list[str], list[str]]:
    """The entries of `data.yaml` for pictures that have moved to another folder.

    The lists of pictures of the splits are written anew. A backslash may stand for a slash.

    Args:
        source: the folder or data.yaml that was read. folder: of the new pictures.
        new_names: the new pictures of each old one, relative to their folders.

    Returns:
        The entries; the splits that are left out because their pictures are not there, in words;
        and lists that have lines without a picture, in words.
    """
    root, content = _content(source)
    missing, wrong = [], []
    for split in _SPLITS:
        if not content.get(split):
            continue
        listed = content[split] if isinstance(content[split], list) else [content[split]]
        places = [_below(root, str(name)) for name in listed]
        if lost := [name for name, place in zip(listed, places, strict=True) if place is None]:
            missing.append(f"{split}: {', '.join(map(str, lost))}")
        kept = [place for place in places if place is not None]
        for place in kept:
            if (root / place).is_file():
                wrong += _write_list(root, place, folder, new_names)
        content[split] = kept if isinstance(content[split], list) else "".join(kept)
        if not kept:
            del content[split]
    for name in ("path", "names"):
        content.pop(name, None)
    return content, missing, wrong


def _below(root: Path, listed: str) -> str | None:
    """A folder or list of pictures of a split relative to `root`. Roboflow writes "../" before it,
    though it is beside data.yaml."""
    listed = plain = listed.replace("\\", "/")
    while plain.startswith("../"):
        plain = plain[3:]
    for name in dict.fromkeys((listed, plain)):
        place = Path(os.path.relpath(root / name, root))
        if ".." not in place.parts and (root / place).exists():
            return place.as_posix()
    return None


def _write_list(
    root: Path, name: str, folder: Path, new_names: Mapping[str, Sequence[str]]
) -> list[str]:
    """Writes the list of pictures of a split, with the new names; says which lines name none."""
    lines: list[str] = []
    lost: list[str] = []
    for line in read_list(root / name):
        plain = line.replace("\\", "/")
        files = [os.path.relpath(place / plain, root) for place in (root / name / "..", root)]
        new = next((new_names[file] for file in files if file in new_names), None)
        lines += new or ()
        lost += [line] * (new is None)
    replace_file(folder / name, "".join(f"./{line}\n" for line in lines))
    return [f"{root / name} lists pictures that are not in {root}, {some(lost)}"] if lost else []


def _lines(text: Path) -> list[tuple[str, str, np.ndarray]]:
    """The lines of a text, if it is there: their places in words, what they hold, and its numbers,
    none if they are no numbers."""
    lines = []
    try:
        content = read_text(text).splitlines() if text.is_file() else []
    except ValueError as error:
        return [(f"{error}:", "", np.zeros(0))]
    for number, line in enumerate(map(str.strip, content), 1):
        try:
            row = np.array(line.split(), float)
        except ValueError:
            row = np.zeros(0)
        lines += [(f"{text}, line {number}", line, row)] * bool(line)
    return lines


def _without_picture(root: Path, texts: Sequence[Path]) -> list[str]:
    """Texts with labels that are those of no picture, in words, where those of pictures are."""
    used, folders = set(texts), {text.parent for text in texts}
    roots = {place for folder in folders for place in (folder, *folder.parents)}
    roots = {place for place in roots if place.name == "labels"}
    alone = [text for text in map(Path, files_below(root)) if text not in used]
    return [
        f"{text} has {counted(count, 'label')}, but no picture has its name: did a tool change it?"
        for text in alone
        if text.suffix == ".txt" and (text.parent in folders or not roots.isdisjoint(text.parents))
        if (count := sum(len(row) > 4 for *_, row in _lines(text)))
    ]  # fmt: skip


def _labels(
    lines: Sequence[tuple[str, str, np.ndarray]], size: Size, classes: int, shape: Sequence[int]
) -> tuple[Labels, list[str]]:
    instances, wrong = [], []
    for place, line, row in lines:
        try:
            instances.append(_instance(row, size, classes, *shape))
        except ValueError as error:
            wrong.append(f"{place} {error}, got {line[:80]!r}")
    return Labels(Instances.joined(instances), size), wrong


def _instance(
    row: np.ndarray, size: Size, classes: int, count: int, per_keypoint: int
) -> Instances:
    category, numbers = row[0] if len(row) else -1.0, row[1:]
    keypoints, more, sides = None, count * per_keypoint, np.array(size[::-1])
    counts = (4, 4 + more) if more else (4, *range(6, len(row), 2))
    if not (category in range(classes) and len(numbers) in counts and np.isfinite(row).all()):
        others = f"{more} of keypoints, by kpt_shape" if more else "pairs of an outline"
        raise ValueError(
            f"must be a class below {classes} and 4 numbers of a box, or {others}, without a score "
            "or a track"
        )
    if len(numbers) == 4 + more > 4:
        keypoints = numbers[4:].reshape(-1, per_keypoint)
        numbers = numbers[:4]
        visibility = keypoints[:, 2] if per_keypoint == 3 else 2.0 * keypoints.any(1)
        keypoints = np.column_stack((keypoints[:, :2] * sides, visibility))
    table = numbers.reshape(-1, 2) * sides
    if len(table) == 2:
        box = np.concatenate((table[0] - table[1] / 2, table[0] + table[1] / 2))
    else:
        box = box_of([table])
    if not (box[:2] < box[2:]).all():
        raise ValueError("must have an area")
    outline = [table] if len(table) > 2 and area_of(table) > NO_AREA else ()
    unit = "shares of the sides of the picture"
    return labelled(int(category), box, size, unit, outline=outline, keypoints=keypoints)
