"""Finds the files of scenes: pictures, and targets and calibrations with the same stems."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from darswin.data.cameras import Calibrations
from darswin.data.folders import OTHER_SUFFIXES, PICTURES, SUFFIXES, files_below, warn_of_unread
from darswin.data.scenes.scene import Classes, read_label_map, read_palette
from darswin.data.scenes.targets import Target, read_labels
from darswin.data.splits import (
    Split,
    part_of_split,
    read_split_lists,
    some,
    split_of_each,
    taken_from,
    warn_left_out,
)
from darswin.utils.parameters import naming
from darswin.utils.tasks import IGNORE
from darswin.utils.words import counted

Pairs = dict[str, tuple[str, str]]  # stem: (picture, target), relative to a folder
ScenesSplit = Literal["train", "val", "test", "all"]
# Splits with a name: functions of all stems, sorted, that return the stems of each part.
Named = Mapping[str, Callable[[list[str]], dict[Split, list[str]]]]
Choose = Callable[[list[str]], list[str]]
# The suffixes of calibration files.
CALIBRATIONS = (".json", ".yaml", ".yml", ".xml", ".txt", ".bin", ".npz")


@dataclass(frozen=True)
class Options:
    """The arguments of `darswin.data.open_scenes`, for its readers."""

    split: ScenesSplit
    target: Target
    lens: str | Path | None
    camera: str | None
    coefficients: str | None
    classes: str | Path | None
    splits: str | Path | None
    label_map: str | Path | None
    holdout: float

    def given_lens(self, root: Path) -> Calibrations | None:
        """The lens that the caller gave in place of the data set's own."""
        if self.lens is None:
            return None
        return Calibrations(self.lens, root, self.camera, self.coefficients)

    def shared_lens(self, root: Path) -> Calibrations:
        """The lens that the caller gave, or else that of a calibration file in `root`."""
        lens = self.lens or calibration_in(root)
        if lens is None:
            text = f"no lens.json in {root}: add the calibration, or give `lens`"
            raise naming(FileNotFoundError(text), "lens")
        return Calibrations(lens, root, self.camera, self.coefficients)

    def own_lenses(self, files: Mapping[Path, Path]) -> Calibrations:
        """The lenses of pictures with a calibration each, for which the caller gave no lens."""
        for name, value in (("camera", self.camera), ("coefficients", self.coefficients)):
            if value is not None:
                text = f"`{name}` {value} needs a calibration: give `lens` too"
                raise naming(ValueError(text), name, "lens")
        return Calibrations(None, files=files)

    def labels(self, *arguments: Any, **named: Any) -> tuple[Classes, Callable[..., np.ndarray]]:
        """The classes, and the function that reads a label file; arguments as `classes_of`."""
        class_of, classes = self.classes_of(*arguments, **named)
        return classes, partial(read_labels, classes=len(classes.names), class_of=class_of)

    def classes_of(
        self,
        own: Callable[[], Classes],
        class_of: Mapping[int, int] | None = None,
        ids: Iterable[int] = (),
    ) -> tuple[Mapping[int, int] | None, Classes]:
        """The class of each id in the label files, None where they are the same; and the classes.

        `own` and `class_of` are the data set's. `ids` are all ids that its authors defined: they
        count as unlabelled without a class, also if a label map leaves them out.
        """
        given = self.classes
        palette = own if given is None else lambda: read_palette(given)
        if self.label_map is not None:
            class_of, classes = read_label_map(self.label_map, palette, given is not None)
        else:
            classes = palette()
            if class_of is None:
                return None, classes
            if (count := max(class_of.values(), default=-1) + 1) != len(classes.names):
                raise ValueError(
                    f"{given} must name {count} classes, but names {len(classes.names)}"
                )
        return {**dict.fromkeys(ids, IGNORE), **class_of}, classes

    def choose_part(self, parts: Mapping[Split, Path], root: Path) -> tuple[Split, Choose]:
        """The part of a divided data set from which the split is taken, and the function that
        chooses the stems of the split."""
        if self.splits is not None:
            raise ValueError(f"{self.splits} lists splits, but {root} has a folder for each")
        split = self.split
        if split == "all":
            raise ValueError(
                f"{root} has a folder for each split, but 'all' needs a folder without splits"
            )
        part, held_out = taken_from(split, parts)

        def choose(found: list[str]) -> list[str]:
            return part_of_split(found, split, held_out, self.holdout, parts[part])

        return part, choose

    def choose(
        self,
        found: list[str],
        root: Path,
        *,
        group: Callable[[str], str] | None = None,
        named: Named | None = None,
    ) -> list[str]:
        """The stems of the split, from all stems in a folder without folders of splits. The stems
        of a group are held out together; `named` are splits that `splits` may name."""
        if self.split == "all":
            return found
        given: dict[Split, list[str]] = {"train": found}
        if self.splits is not None:
            make = (named or {}).get(str(self.splits))
            given = make(sorted(found)) if make else _listed(Path(self.splits), found, named)
        part, held_out = taken_from(self.split, given)
        chosen = given[part]
        if unknown := sorted(set(chosen) - set(found)):
            text = f"{self.splits} lists {counted(len(unknown), 'picture')} for {part!r} missing in"
            raise FileNotFoundError(f"{text} {root}: {some(unknown)}")
        if not chosen:
            raise FileNotFoundError(f"{self.splits} lists no pictures for {part!r}")
        return part_of_split(chosen, self.split, held_out, self.holdout, root, group=group)


def _listed(path: Path, found: Sequence[str], named: Named | None) -> dict[Split, list[str]]:
    """The stems of each list; pictures are listed with or without their suffixes."""
    if named and not path.exists():
        raise FileNotFoundError(f"no lists of splits in {path}; named splits: {sorted(named)}")
    given: dict[Split, list[str]] = {}
    for split, names in read_split_lists(path).items():
        if wrong := [name for name in names if not isinstance(name, str)]:
            raise ValueError(f"{path} must list names for {split!r}, got {wrong[0]!r}")
        given[split] = list(dict.fromkeys(map(stem_of, names)))
    split_of = split_of_each(given, path)
    if left := [stem for stem in found if stem not in split_of]:
        pictures = counted(len(left), "picture")
        warn_left_out(f"{path} lists {pictures} for no split, {some(left)}: left out")
    return given


def stem_of(name: str) -> str:
    """The stem of a picture or a PNG that a list names."""
    stem, suffix = os.path.splitext(name)
    return os.path.normpath(stem if suffix.lower() in PICTURES else name)


def lenses_beside(
    options: Options, root: Path, pairs: Pairs, calibration_of: Callable[[str], str | Path]
) -> Calibrations:
    """The lenses of pictures that each have a calibration, found by their stems."""
    files = {root / picture: Path(calibration_of(stem)) for stem, (picture, _) in pairs.items()}
    there = {file: file.is_file() for file in set(files.values())}
    for picture, file in files.items():
        if not there[file]:
            text = f"no lens for {picture}: add {file}, or give `lens`"
            raise naming(FileNotFoundError(text), "lens")
    return options.own_lenses(files)


def refuse_outlines(root: Path) -> None:
    """FileNotFoundError if a JSON file of a data set has outlines of objects in COCO's form."""
    for file in (*sorted(root.glob("*.json")), *sorted(root.glob("*/*.json"))):
        text = file.read_bytes()
        if b'"annotations"' in text and b'"segmentation"' in text:
            raise FileNotFoundError(
                f"{file} has outlines of objects, but darswin reads masks, a PNG for each picture: "
                "docs/howto/scenes.md has the lines that make masks of outlines"
            )


def calibration_in(*folders: Path) -> Path | None:
    """The calibration lens.json, lens.yaml or the like in the first folder that has one."""
    for folder in folders:
        files = sorted(folder.glob("lens.*"))
        found = [file for file in files if file.suffix.lower() in CALIBRATIONS]
        if len(found) > 1:
            raise ValueError(f"{found[0]} and {found[1]} are both calibrations: keep one of them")
        if found:
            return found[0]
    return None


def stems(folder: Path, suffixes: Sequence[str] | frozenset[str]) -> dict[str, str]:
    """The files below a folder, sorted, by their relative paths without suffix."""
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}")
    found: dict[str, str] = {}
    for file in sorted(files_below(folder)):
        stem, suffix = os.path.splitext(os.path.relpath(file, folder))
        if suffix.lower() not in suffixes:
            continue
        if stem in found:
            raise ValueError(f"{found[stem]} and {file} have the same stem: keep one of them")
        found[stem] = file
    return found


def pictures_in(folder: Path) -> dict[str, str]:
    """The pictures below a folder, as `stems`; FileNotFoundError if there are none."""
    found = stems(folder, SUFFIXES)
    if not found:
        raise FileNotFoundError(f"no pictures in {folder}")
    warn_of_unread(folder, list(stems(folder, OTHER_SUFFIXES).values()))
    return found


def pair(
    pictures: dict[str, str],
    targets: dict[str, str],
    choose: Choose,
    *,
    root: Path,
    what: str,
    strict: bool = True,
) -> Pairs:
    """The pictures whose stems `choose` takes, and their targets, with paths relative to `root`. A
    picture without a target is an error, or is left out if not `strict`."""
    found = list(pictures)
    if not strict:
        found = [stem for stem in pictures if stem in targets]
        if without := len(pictures) - len(found):
            total = counted(len(pictures), "picture")
            warn_left_out(f"no {what} for {without} of {total} in {root}: left out")
        if not found:
            raise FileNotFoundError(f"none of {len(pictures)} pictures in {root} has {what}")
    if alone := [targets[stem] for stem in targets if stem not in pictures]:
        files = counted(len(alone), "file")
        warn_left_out(f"no picture for {files} of {what}, {some(alone)}: left out")
    chosen = choose(found)
    if missing := [pictures[stem] for stem in chosen if stem not in targets]:
        text = (
            f"no {what} for {len(missing)} of {counted(len(chosen), 'picture')}, {some(missing)}: "
            "add them, move the pictures away, or list the other pictures in `splits`"
        )
        raise naming(FileNotFoundError(text), "splits")
    return {
        stem: (os.path.relpath(pictures[stem], root), os.path.relpath(targets[stem], root))
        for stem in chosen
    }
