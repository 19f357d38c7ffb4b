"""The names of a network's classes, in the files that other tools write."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

from darswin.utils.parameters import naming
from darswin.utils.text import is_json_file, mapping, parse_json, read_text

_FORMS = (
    "known are a text file with a name in each line, where line k is class k and an empty line is "
    "no class; JSON or YAML with a list of names, or with {number: name}, also under `names`; and "
    "a label map of TensorFlow (.pbtxt)"
)
_ITEM = re.compile(r"\bitem\s*\{([^{}]*)\}")
_ENTRY = re.compile(r"(\w+)\s*:\s*(?:\"((?:[^\"\\]|\\.)*)\"|'((?:[^'\\]|\\.)*)'|([^\s,;}]+))")


def read_names(path: str | Path) -> dict[int, str]:
    """The names of classes by their numbers, from 0.

    Raises:
        ValueError: the file holds no names, or two of one class.
    """
    suffix = Path(path).suffix.lower()
    try:
        text = read_text(path)
        if is_json_file(path):
            names = _listed(parse_json(text))
        elif suffix in (".yaml", ".yml"):
            names = _listed(yaml.safe_load(text))
        elif suffix == ".pbtxt":
            names = _label_map(text)
        else:
            names = _listed([line.strip() or None for line in text.splitlines()])
    except (OSError, ValueError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        text = f"`labels` must be a file with the names of classes, got {path}: {reason}; {_FORMS}"
        raise naming(ValueError(text), "labels") from error
    return names


def _listed(content: Any) -> dict[int, str]:
    """Names in a list or in a mapping from their numbers."""
    for key in ("names", "id2label"):  # of Ultralytics, and of configurations of transformers
        if isinstance(content, dict) and key in content:
            content = content[key]
    if not isinstance(content, dict | list):
        raise ValueError(f"it has no list of names, but {content!s:.60}")
    pairs = content.items() if isinstance(content, dict) else enumerate(content)
    return _named((number, name) for number, name in pairs if name is not None)


def _named(pairs: Iterable[tuple[Any, Any]]) -> dict[int, str]:
    names: list[tuple[int, str]] = []
    for number, name in pairs:
        if isinstance(number, bool) or not re.fullmatch(r"\d{1,9}", str(number)):
            raise ValueError(f"{number!s:.60} is no number of a class")
        if not isinstance(name, str):
            raise ValueError(f"{name!s:.60} is no name of class {number}")
        names.append((int(number), name))
    if not names:
        raise ValueError("it has no names")
    return mapping(names)


def _label_map(text: str) -> dict[int, str]:
    """The names in a label map of TensorFlow; a name to show goes before an internal one."""
    entries_of = []
    for item in _ITEM.findall(re.sub(r"(?m)^\s*#.*$", "", text)):
        entries = {key: a or b or c for key, a, b, c in _ENTRY.findall(item)}
        if "id" not in entries:
            raise ValueError(f"an item has no id: {' '.join(item.split()):.60}")
        name = entries.get("display_name") or entries.get("name")
        entries_of.append((entries["id"], name))
    return _named(entries_of)
