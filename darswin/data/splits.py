"""The splits of a data set: the pictures for training, validation and testing."""

import copy
import hashlib
import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np

from darswin.utils.parameters import check, naming
from darswin.utils.text import is_json_file, read_json, read_text

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
# The names of folders and lists of splits, in lower case.
SPLIT_NAMES: dict[str, Split] = {
    "train": "train", "training": "train",
    "val": "val", "valid": "val", "validation": "val",
    "test": "test", "testing": "test",
}  # fmt: skip


class LeftOut(UserWarning):
    """A warning of pictures that are in no split, or missing from a split."""


def warn_left_out(text: str) -> None:
    warnings.warn(text, LeftOut, stacklevel=2)


def check_split(split: str, allowed: tuple[str, ...], holdout: float) -> None:
    """ValueError for an unknown split or a share out of range."""
    check("split", repr(split), split in allowed, f"one of {allowed}")
    check("holdout", holdout, 0 <= holdout < 0.5, "in [0, 0.5)")


def taken_from(split: Split, given: Collection[Split]) -> tuple[Split, list[Split]]:
    """The given part from which a split is taken, and the splits that are held out of that part."""
    missing: list[Split] = [part for part in ("test", "val") if part not in given]
    part: Split = split
    held_out: list[Split] = missing if split == "train" else []
    if missing == ["test"]:
        part, held_out = ("val" if split == "test" else split), []
    elif split in missing:
        part, held_out = "train", missing
    if part not in given:
        raise FileNotFoundError(f"there are {sorted(given)} pictures, but none for {split!r}")
    return part, held_out


def part_of_split(
    paths: list[str],
    split: Split,
    held_out: Sequence[Split],
    holdout: float,
    where: Path,
    *,
    label: Callable[[str], str] = lambda path: "",
    group: Callable[[str], str] | None = None,
) -> list[str]:
    """The paths of a split, if `held_out` and "train" share `paths`. Each label is divided in the
    same way, and the paths of a group stay together."""
    if not held_out:
        return paths
    groups = {path: group(path) if group else path for path in paths}
    keys = sorted(set(groups.values()))
    chosen = hold_out([label(key) for key in keys], keys, holdout, held_out)[split]
    kept = {keys[k] for k in chosen}
    if not kept:
        text = (
            f"no pictures for the {split!r} split in {where}: `holdout` {holdout:g} of "
            f"{len(keys)} {'groups' if group else 'pictures'} leaves none"
        )
        raise naming(FileNotFoundError(text), "holdout")
    return [path for path in paths if groups[path] in kept]


def hold_out(
    labels: Sequence, keys: Sequence[str], share: float, parts: Sequence[Split]
) -> dict[Split, list[int]]:
    """The indices of each split: `parts` get a share of each class, and "train" gets the rest.

    Hashes of the keys shuffle each class, so that a new picture moves hardly any others. At least
    one picture of each class is left to train on.
    """
    classes: dict[Any, list[int]] = {}
    for index in sorted(
        range(len(keys)), key=lambda k: hashlib.sha1(os.fsencode(keys[k])).digest()
    ):
        classes.setdefault(labels[index], []).append(index)
    chosen: dict[Split, list[int]] = {part: [] for part in (*parts, "train")}
    for members in classes.values():
        count = min(math.ceil(share * len(members)), (len(members) - 1) // len(parts))
        for place, part in enumerate(parts):
            chosen[part] += members[place * count : (place + 1) * count]
        chosen["train"] += members[len(parts) * count :]
    return {part: sorted(indices) for part, indices in chosen.items()}


class Limited:
    """Base of collections of pictures; `PER_PICTURE` names arrays with an entry per picture."""

    PER_PICTURE: ClassVar[tuple[str, ...]]

    def limited(self, count: int) -> Self:
        """At most `count` pictures, chosen by a fixed shuffle; ValueError for a count below 1."""
        check("limit", count, count >= 1, "at least 1")
        arrays = {name: getattr(self, name) for name in self.PER_PICTURE}
        total = len(arrays[self.PER_PICTURE[0]])
        chosen = np.sort(np.random.default_rng(0).permutation(total)[:count])
        part = copy.copy(self)
        vars(part).update({name: array[chosen] for name, array in arrays.items()})
        return part


def split_folders(folders: Iterable[Path], holds: Callable[[Path], bool]) -> dict[Split, Path]:
    """The folders that have the name of a split and for which `holds` is true."""
    named: dict[Split, Path] = {}
    for folder in folders:
        split = SPLIT_NAMES.get(folder.name.lower())
        if split is None or not holds(folder):
            continue
        if split in named and not folder.samefile(named[split]):
            raise ValueError(
                f"{named[split]} and {folder} are both named as the {split!r} split: keep one"
            )
        named[split] = folder
    return named


# -- lists ------------------------------------------------------------------------------------


def read_split_lists(lists: Path) -> dict[Split, list]:
    """The entries of each split, from a JSON file or from a folder with a text file per split."""
    form = f'{lists} must hold {{"train": [paths], "val": [paths], "test": [paths]}}'
    if lists.is_dir():
        entries: list[tuple[str, Any]] = [
            (file.stem, read_list(file))
            for file in sorted(lists.iterdir())
            if file.suffix.lower() == ".txt" and file.stem.lower() in SPLIT_NAMES
        ]
    else:
        content = read_json(lists)
        if not isinstance(content, dict):
            raise ValueError(form)
        entries = list(content.items())
    given: dict[Split, list] = {}
    for name, paths in entries:
        split = SPLIT_NAMES.get(name.lower())
        if split is None or split in given:
            raise ValueError(f"{form}, got {[name for name, _ in entries]}")
        if not isinstance(paths, list):
            raise ValueError(f"{form}, got {paths!r} for {name!r}")
        given[split] = paths
    return given


def split_of_each(given: Mapping[Split, Iterable[str]], lists: Path) -> dict[str, Split]:
    """The split of each path in lists; ValueError for one to train with and also in another."""
    split_of: dict[str, Split] = {}
    for split, paths in given.items():
        for path in paths:
            if split_of.setdefault(path, split) != split and "train" in (split_of[path], split):
                raise ValueError(f"{lists} lists {path} for {split_of[path]!r} and for {split!r}")
    return split_of


def read_list(path: str | Path) -> list[str]:
    """The names in a text file, one per line, or in a JSON list."""
    if not is_json_file(path):
        return [line.strip() for line in read_text(path).splitlines() if line.strip()]
    names = read_json(path)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{path} must hold a JSON list of names")
    return names


def read_classes(path: str | Path) -> list[str]:
    """The names of classes in a file, as for `read_list`, without a slash at the end, as shells
    write the names of folders; ValueError for repeated names."""
    names = [name.rstrip("/") for name in read_list(path)]
    if not names:
        raise ValueError(f"{path} must list the classes, but is empty")
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{path} must list each class once, but repeats {some(twice)}")
    return names


def some(names: Sequence) -> str:
    """The first few names, and the number of others."""
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return f"{list(names[:5])}{more}"
