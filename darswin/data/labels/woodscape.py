"""WoodScape's boxes: `box_2d_annotations/NNNNN_VIEW.txt`, with lines "name,index,left,top,right,
bottom", whose last four are the outermost pixels of an instance.

Source: github.com/valeoai/WoodScape, scripts/box_2d_generator.py.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from darswin.boxes import Instances
from darswin.data.cameras import Calibrations
from darswin.data.labels.labels import LabelledPictures, Labels, Size, labelled
from darswin.data.scenes.files import pictures_in, stems
from darswin.data.scenes.woodscape import calibration_files, unnested
from darswin.utils.text import read_text

BOXES = "box_2d_annotations"


def has_boxes(root: Path) -> bool:
    """True for a folder in the form of WoodScape that has boxes."""
    return (root / BOXES).is_dir() and (root / "rgb_images").is_dir()


def read_woodscape_boxes(root: str | Path) -> LabelledPictures:
    """The pictures of WoodScape that have files of boxes, and their lenses.

    Raises:
        FileNotFoundError: pictures, boxes or calibrations are missing.
        ValueError: a class with two names; from `labels(k)`, a line of another form.
    """
    root = Path(root)
    texts = stems(unnested(root / BOXES), (".txt",))
    folder = unnested(root / "rgb_images")
    pictures = pictures_in(folder)
    files = {stem: os.path.relpath(pictures[stem], folder) for stem in pictures if stem in texts}
    if not files:
        raise FileNotFoundError(f"no picture in {folder} has boxes in {root / BOXES}")
    names: dict[int, str] = {}
    raw = [_rows(texts[stem], names) for stem in files]
    categories = [{"id": k, "name": names[k]} for k in sorted(names)]
    calibration_of = calibration_files(root)
    lenses = {folder / file: Path(calibration_of(stem)) for stem, file in files.items()}
    return LabelledPictures(
        folder, list(files.values()), raw, _labels, categories,
        lenses=Calibrations(None, files=lenses),
    )  # fmt: skip


def _rows(file: str, names: dict[int, str]) -> tuple[list[list[float]], list[str]]:
    """The index and the outermost pixels of each instance; and what is wrong with other lines."""
    rows, wrong = [], []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip():
            continue
        try:
            name, *numbers = line.split(",")
            index, left, top, right, bottom = map(float, numbers)
            if not (np.isfinite(index) and left <= right < np.inf and top <= bottom < np.inf):
                raise ValueError
        except ValueError:
            wrong.append(
                f"{file}, line {number}: must be name,index,left,top,right,bottom, got {line!r}"
            )
            continue
        if names.setdefault(int(index), name) != name:
            raise ValueError(f"{file} names the class {int(index)} {name}, not {names[int(index)]}")
        rows.append([index, left, top, right, bottom])
    return rows, wrong


def _labels(
    raw: tuple[Sequence[Sequence[float]], list[str]], size: Size
) -> tuple[Labels, list[str]]:
    rows, wrong = raw
    outermost = np.array([0, 0, 1, 1])
    instances = [labelled(int(index), np.add(box, outermost)) for index, *box in rows]
    return Labels(Instances.joined(instances), size), wrong
