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
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from darswin.boxes import Instances, corners, decode_rle
from darswin.boxes.regions import NO_AREA, area_of, box_of
from darswin.data.cameras import Calibrations
from darswin.data.folders import files_below
from darswin.data.labels.judge import (
    MIDDLE,
    boxes_with_more,
    check_form,
    check_place,
    check_shares,
    similar,
)
from darswin.data.labels.labels import (
    LabelledPictures,
    Labels,
    Size,
    check_labels,
    known_keypoints,
    labelled,
)
from darswin.data.scenes.files import calibration_in, pictures_in
from darswin.data.splits import some
from darswin.utils.files import replace_file
from darswin.utils.text import read_text

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
        ValueError: from `labels(k)`, a line of another form; it names the file.
    """
    root, content = _content(Path(path))
    names, shape = content["names"], content.get("kpt_shape") or (0, 0)
    pictures = pictures_in(root)
    texts = {stem: str(_text_of(root, Path(stem))) for stem in pictures}
    if not any(Path(text).is_file() for text in texts.values()):
        raise FileNotFoundError(f"no labels in {root}: the first would be {min(texts.values())}")
    lines = [_lines(text, len(names), shape) for text in texts.values()]
    calibration = calibration_in(root)
    return LabelledPictures(
        root, [str(Path(file).relative_to(root)) for file in pictures.values()],
        _judged(root, lines), _labels, [{"id": k, "name": name} for k, name in enumerate(names)],
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
    count = ((more or {}).get("kpt_shape") or [0])[0]
    for entry, labels in pictures:
        instances = labels.instances
        if "crowd" in instances.more:
            instances = instances[~instances.more["crowd"]]
        if instances.keypoints is not None and len(instances):
            count = max(instances.keypoints.shape[1], count)
        classes = [number[label] for label in check_labels(instances, number)]
        lines = yolo_lines(replace(instances, labels=np.array(classes)), labels.size)
        text = _text_of(Path(root), Path(entry["file_name"]).with_suffix(""))
        replace_file(text, lines)
    names = {k: category["name"] for k, category in enumerate(categories)}
    content = {"path": ".", **(more or {}), "names": names}
    content |= {"kpt_shape": [count, 3]} if count else {}
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
        names = [line.strip() for line in read_text(file).splitlines() if line.strip()]
        return file.parent, {"names": names}
    try:
        content = dict(yaml.safe_load(read_text(file)))
        names, shape = content["names"], content.get("kpt_shape")
        if isinstance(names, Mapping):
            names = [names[k] for k in range(len(names))]
        content |= {"names": list(map(str, names))}
        if shape is not None:
            content["kpt_shape"] = [int(number) for number in shape[:2]]
            if content["kpt_shape"][1] not in (2, 3):
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
        and lists whose lines name no picture, in words.
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
    plain = listed.replace("\\", "/")
    while plain.startswith("../"):
        plain = plain[3:]
    for name in (listed, listed.replace("\\", "/"), plain):
        place = Path(os.path.relpath(root / name, root))
        if ".." not in place.parts and (root / place).exists():
            return place.as_posix()
    return None


def _write_list(
    root: Path, name: str, folder: Path, new_names: Mapping[str, Sequence[str]]
) -> list[str]:
    """Writes the list of pictures of a split, with the new names; says which lines name none."""
    lines, lost = [], []
    for line in filter(None, map(str.strip, read_text(root / name).splitlines())):
        ways = [line, line.replace("\\", "/")]
        places = [place / way for way in ways for place in (root / name / "..", root)]
        files = [os.path.relpath(place, root) for place in places]
        if (file := next((file for file in files if file in new_names), None)) is None:
            lost.append(line)
        else:
            lines += new_names[file]
    replace_file(folder / name, "".join(f"./{line}\n" for line in lines))
    what = f"{root / name}: {len(lost)} lines name no picture below {root}"
    return [f"{what}, as {some(lost)}: write them relative to it"] if lost else []


class _Line(NamedTuple):
    """A line of a text file: its place in words, its content, and its numbers, all as shares:
    4 of a box or pairs of an outline; and keypoints (P, 3), with COCO's v."""

    place: str
    content: str
    category: int
    numbers: np.ndarray
    keypoints: np.ndarray | None

    def wrong(self, reason: Any) -> str:
        return f"{self.place} {reason}, got {self.content[:80]!r}"

    @property
    def box(self) -> np.ndarray:
        table = self.numbers.reshape(-1, 2)
        if len(table) > 2:
            return box_of([table])
        return np.concatenate((table[0] - table[1] / 2, table[0] + table[1] / 2))

    def check(self, has_more: bool) -> None:
        """ValueError for what cannot be labelled in a picture."""
        if has_more:
            raise ValueError(
                "looks like a box with more numbers, such as a score and a track: keep its class "
                "and box, or name the keypoints by kpt_shape in data.yaml"
            )
        unit = "shares of the sides of the picture"
        check_place(unit, (1, 1), self.box, [self.numbers], self.keypoints)
        if not (self.box[:2] < self.box[2:]).all():
            raise ValueError("must have an area")


def _lines(text: str, classes: int, shape: Sequence[int]) -> tuple[list[_Line], list[str]]:
    """The lines of the text file of a picture, and what is wrong with others."""
    lines, wrong = [], []
    try:
        contents = read_text(text).splitlines() if Path(text).is_file() else []
    except ValueError as error:
        return [], [str(error)]
    for number, content in enumerate(map(str.strip, contents), 1):
        line = _Line(f"{text}, line {number}", content, 0, np.zeros(4), None)
        if content:
            try:
                lines.append(_parsed(line, classes, *shape))
            except ValueError as error:
                wrong.append(line.wrong(error))
    return lines, wrong


def _numbers(content: str) -> list[float]:
    """The numbers of a line; none if it holds something else."""
    try:
        return [*map(float, content.split())]
    except ValueError:
        return []


def _without_picture(root: Path, texts: Mapping[str, str]) -> list[str]:
    """Texts with labels that are those of no picture, in words: they are where others are."""
    used = {Path(text) for text in texts.values()}
    folders = {place for text in used for place in text.parents if place.name == "labels"}
    lonely = [stem for stem, text in texts.items() if not Path(text).is_file()]
    said = []
    for text in map(Path, sorted(files_below(root))):
        is_ours = text.parent in {place.parent for place in used} or folders & set(text.parents)
        if text.suffix != ".txt" or text in used or not is_ours:
            continue
        lines = [line for line in read_text(text).splitlines() if len(_numbers(line)) > 4]
        if lines:
            other = similar(text.stem, lonely)
            hint = f": it may be that of the picture {other}" if other else ""
            said.append(f"{text}: no picture has this name, for {len(lines)} labels{hint}")
    return said


def _parsed(line: _Line, classes: int, count: int, per_keypoint: int) -> _Line:
    category, *rest = _numbers(line.content) or [-1.0]
    numbers = np.array(rest)
    more = count * per_keypoint
    is_form = len(numbers) == 4 or (
        len(numbers) == 4 + more if more else len(numbers) >= 6 and len(numbers) % 2 == 0
    )
    if not (category in range(classes) and is_form and np.isfinite(numbers).all()):
        others = f"{more} of keypoints, as kpt_shape says" if more else "pairs of an outline"
        raise ValueError(
            f"must be a class below {classes} and 4 numbers of a box, or {others}; it has "
            f"{len(line.content.split())} numbers"
        )
    keypoints = None
    if more and len(numbers) > 4:
        keypoints = numbers[4:].reshape(-1, per_keypoint)
        visibility = keypoints[:, 2] if per_keypoint == 3 else 2.0 * keypoints.any(1)
        keypoints = np.column_stack((keypoints[:, :2], visibility))
        numbers = numbers[:4]
    return line._replace(category=int(category), numbers=numbers, keypoints=keypoints)


def _judged(
    root: Path, files: Sequence[tuple[list[_Line], list[str]]]
) -> list[tuple[list[_Line], list[str]]]:
    """The lines of each file that can be right, after a look at all of them; and what is wrong with
    others."""
    lines = [line for of_file, _ in files for line in of_file]
    check_shares([(line.place, line.numbers) for line in lines])
    outlines = [line for line in lines if len(line.numbers) > 4]
    has_more = boxes_with_more([line.numbers for line in outlines])
    with_more = {line.place for line in compress(outlines, has_more)}
    boxes = [line.numbers for line in lines if len(line.numbers) == 4]
    check_form(root, MIDDLE, np.reshape(boxes, (-1, 4)))
    judged = []
    for of_file, wrong in files:
        kept, wrong = [], list(wrong)
        for line in of_file:
            try:
                line.check(line.place in with_more)
                kept.append(line)
            except ValueError as error:
                wrong.append(line.wrong(error))
        judged.append((kept, wrong))
    return judged


def _labels(raw: tuple[Sequence[_Line], list[str]], size: Size) -> tuple[Labels, list[str]]:
    lines, wrong = raw
    sides, instances = np.array(size[::-1]), []
    for line in lines:
        table = line.numbers.reshape(-1, 2) * sides
        has_outline = len(table) > 2 and area_of(table) > NO_AREA
        keypoints = None if line.keypoints is None else line.keypoints * [*sides, 1]
        instances.append(
            labelled(
                line.category,
                line.box * [*sides, *sides],
                outline=[table] if has_outline else (),
                keypoints=keypoints,
            )
        )
    return Labels(Instances.joined(instances), size), wrong
