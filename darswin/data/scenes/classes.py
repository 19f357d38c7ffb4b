"""The names and colours of classes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from darswin.data.scenes.targets import IGNORE
from darswin.data.splits import read_classes, read_json


class Classes(NamedTuple):
    """Attributes: names: in the order of the ids; colors: (r, g, b) in 0 … 255 of each, or none."""

    names: list[str]
    colors: list[list[int]]


def read_palette(path: str | Path) -> Classes:
    """Names of classes as `darswin.data.splits.read_classes`, or a JSON object
    {"names": [...], "colors": [[r, g, b], ...]}, whose colours may be left out.

    Raises:
        ValueError: what is neither; it names the file. OSError: it cannot be read.
    """
    content = read_json(path) if Path(path).suffix == ".json" else None
    if isinstance(content, Mapping):
        return as_classes(content.get("names"), content.get("colors", []), path)
    return as_classes(read_classes(path), [], path)


def as_classes(names: Any, colors: Any, path: str | Path) -> Classes:
    """The classes that a file says; ValueError where that is not one name, and one colour, each."""
    if not _is_list(names, str) or not names:
        raise ValueError(f"{path} must name the classes as a list of words, got {names!r}")
    if len(set(names)) < len(names) or len(names) > IGNORE:
        raise ValueError(f"{path} must name each class once, and at most {IGNORE}, got {names}")
    fits = _is_list(colors, list) and len(colors) in (0, len(names))
    if not fits or not all(_is_color(color) for color in colors):
        raise ValueError(
            f"{path} must give each of {len(names)} classes a color [r, g, b] in 0 … 255, or none "
            f"a color, got {colors!r}"
        )
    return Classes(list(names), [list(color) for color in colors])


def _is_list(value: Any, kind: type) -> bool:
    return isinstance(value, list) and all(isinstance(entry, kind) for entry in value)


def _is_color(value: Sequence) -> bool:
    return len(value) == 3 and all(type(v) is int and 0 <= v <= 255 for v in value)
