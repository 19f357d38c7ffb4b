"""The parts of a data set, for training, validation and testing, and lists of what is in them."""

import hashlib
import json
import math
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

Split = Literal["train", "val", "test"]
SPLITS = ("train", "val", "test")


def hold_out(
    labels: Sequence, keys: Sequence[str], share: float, parts: Sequence[Split]
) -> dict[Split, list[int]]:
    """Indices of each split, where `parts` take a share of each class and "train" the rest.

    Each class is shuffled by hashes of its keys, so that a picture more or less moves hardly any.
    At least one of each class is left to train on.
    """
    classes: dict[Any, list[int]] = {}
    for index in sorted(
        range(len(keys)), key=lambda k: hashlib.sha1(os.fsencode(keys[k])).digest()
    ):
        classes.setdefault(labels[index], []).append(index)
    chosen: dict[Split, list[int]] = {part: [] for part in (*parts, "train")}
    for members in classes.values():
        count = math.ceil(share * len(members))
        if parts:
            count = min(count, (len(members) - 1) // len(parts))
        for place, part in enumerate(parts):
            chosen[part] += members[place * count : (place + 1) * count]
        chosen["train"] += members[len(parts) * count :]
    return {part: sorted(indices) for part, indices in chosen.items()}


def read_list(path: str | Path) -> list[str]:
    """Names from a text file, one a line, or from a JSON list."""
    if Path(path).suffix != ".json":
        return [line.strip() for line in Path(path).read_text().splitlines() if line.strip()]
    names = read_json(path)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path} must hold a JSON list of names")
    return names


def read_classes(path: str | Path) -> list[str]:
    """Names of classes as `read_list`; ValueError where there are none, or one is there twice."""
    names = read_list(path)
    if not names:
        raise ValueError(f"{path} must name the classes, but is empty")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{path} must name each class once, but repeats {some(twice)}")
    return names


def some(names: Sequence) -> str:
    """The first few of them, and how many more."""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{list(names[:5])}{more}"


def read_json(path: str | Path) -> Any:
    """What a JSON file holds; ValueError names a file that is none."""
    try:
        return json.loads(Path(path).read_text())
    except ValueError as error:
        raise ValueError(f"{path} must be JSON: {error}") from error
