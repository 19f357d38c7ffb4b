"""Finds the pictures of each split in a folder.

Nothing is left out silently: an ambiguous folder is an error that names it, and a `LeftOut` warning
names pictures that are in no split.
"""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from darswin.data.splits import (
    SPLIT_NAMES,
    Split,
    part_of_split,
    read_split_lists,
    some,
    split_folders,
    split_of_each,
    taken_from,
    warn_left_out,
)
from darswin.utils.parameters import naming
from darswin.utils.video import SUFFIXES as VIDEOS
from darswin.utils.words import counted

SUFFIXES = frozenset((
    ".jpg", ".jpeg", ".jpe", ".jfif", ".insp", ".mpo", ".jps", ".png", ".bmp", ".dib", ".webp",
    ".tif", ".tiff", ".ppm", ".pgm", ".pbm", ".pnm",
))  # fmt: skip
# Formats that OpenCV reads only in some builds, or not at all.
OTHER_SUFFIXES = frozenset((
    ".gif", ".heic", ".heif", ".avif", ".jp2", ".j2k", ".jxl", ".psd", ".svg", ".tga", ".exr",
    ".hdr", ".dng", ".gpr", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2",
))  # fmt: skip
PICTURES = SUFFIXES | OTHER_SUFFIXES
LOOKED_FOR = (
    "darswin looks for ROOT/CLASS/*.jpg (also png, bmp, webp, tif, ppm), or for such folders in "
    "ROOT/train, ROOT/val and ROOT/test"
)


class Pictures(NamedTuple):
    """A folder, and the paths "class/….jpg" of its pictures."""

    folder: Path
    paths: list[str]


def open_folder(
    root: Path, split: Split, names: list[str] | None, lists: str | Path | None, holdout: float
) -> tuple[Pictures, list[str]]:
    """The pictures of a split, and the names of all classes; errors as for `open_source`."""
    given = _found(root, names) if lists is None else _listed(root, Path(lists))
    if "train" not in given or (split == "train" and not given["train"].paths):
        raise FileNotFoundError(f"no images for the 'train' split in {root}: {LOOKED_FOR}")
    classes = names or _classes(given["train"].paths)
    for part, (folder, paths) in given.items():
        if unknown := sorted(set(_classes(paths)) - set(classes)):
            reason = "the list of classes lacks" if names else "the training split lacks"
            text = (
                f"the {part!r} split in {folder} holds pictures of the classes {some(unknown)}, "
                f"but {reason} them: move them away, or list the classes to use in `classes`"
            )
            raise naming(ValueError(text), "classes")
    part, held_out = taken_from(split, given)
    folder, paths = given[part]
    if not paths:
        raise FileNotFoundError(f"no images for the {split!r} split in {folder}: {LOOKED_FOR}")
    counts = Counter(map(class_of, paths))
    small = sorted(name for name in counts if counts[name] <= len(held_out))
    if small and holdout > 0:
        warn_left_out(
            f"{folder}: the classes {some(small)} have too few pictures to hold any out: all of "
            f"them are for training, and none for {' or '.join(held_out)}"
        )
    paths = part_of_split(paths, split, held_out, holdout, folder, label=class_of)
    return Pictures(folder, paths), classes


def pictures_and_videos_below(folder: Path) -> list[str]:
    """The pictures and videos below a folder, sorted; FileNotFoundError if there are none."""
    files = sorted(files_below(folder), key=_parts)
    read = [file for file in files if _suffix(file) in SUFFIXES | VIDEOS]
    others = [file for file in files if _suffix(file) in OTHER_SUFFIXES]
    if not read:
        found = f", but {_kinds(others)}, which darswin does not read" if others else ""
        raise FileNotFoundError(f"no pictures or videos in {folder}{found}")
    warn_of_unread(folder, others)
    return read


def files_below(folder: Path) -> list[str]:
    """The files below a folder, through links, without hidden files and folders."""
    return list(_below(folder))


def class_of(path: str) -> str:
    return path.split(os.sep, 1)[0]


def _classes(paths: Iterable[str]) -> list[str]:
    return sorted(set(map(class_of, paths)))


def _found(root: Path, names: list[str] | None) -> dict[Split, Pictures]:
    """The pictures of each split that has a folder; only "train" for a folder without splits."""
    # The real paths of folders: a link to one of them, or to one above, would repeat its pictures.
    real = Path(os.path.realpath(root))
    seen = {str(folder): str(folder) for folder in (real, *real.parents)}
    folders = _split_folders(root, names) or {"train": root}
    return {
        split: _pictures(folder, names, seen, whole=split == "train")
        for split, folder in folders.items()
    }


def _split_folders(root: Path, names: list[str] | None) -> dict[Split, Path] | None:
    """The folders of the splits, or None if the folders in `root` are classes."""
    folders, loose = _entries(root)
    named = split_folders(folders, _has_pictures)
    if not named or {folder.name for folder in named.values()} & set(names or ()):
        return None
    if "test" in named and "val" in named and named["test"].samefile(named["val"]):
        del named["test"]  # "val" serves as the test set
    others = [f for f in folders if f.name.lower() not in SPLIT_NAMES and _has_pictures(f)]
    has_classes = "train" in named and any(map(_has_pictures, _entries(named["train"])[0]))
    if has_classes and (len(named) > 1 or not others):
        for folder in others:
            warn_left_out(
                f"{folder} holds pictures, but is no split like {named['train']}: left out"
            )
        for folder in folders:
            if folder.name.lower() in SPLIT_NAMES and not _has_pictures(folder):
                warn_left_out(f"{folder} holds no pictures: it is not a split")
        _warn_of_loose(root, loose)
        return named
    if names and all((root / name).is_dir() for name in names):
        return None
    if others and all(any(map(_is_picture, _entries(f)[1])) for f in named.values()):
        return None
    shown = " and ".join(str(folder) for folder in named.values())
    text = (
        f"{shown} may be splits or classes: {LOOKED_FOR}. If they are classes, list all classes in "
        "`classes`"
    )
    raise naming(ValueError(text), "classes")


def _pictures(folder: Path, names: list[str] | None, seen: dict[str, str], whole: bool) -> Pictures:
    """The pictures of the classes, None for all classes; if `whole`, no class may be empty."""
    folders, loose = _entries(folder)
    _warn_of_loose(folder, loose)
    by_name = {f.name: f for f in folders}
    paths, others = [], []
    for name in by_name if names is None else [name for name in names if name in by_name]:
        files = list(_below(by_name[name], seen))
        read = [file for file in files if _suffix(file) in SUFFIXES]
        unread = [file for file in files if _suffix(file) in OTHER_SUFFIXES]
        if unread and not read:
            text = (
                f"{by_name[name]} holds no picture that darswin can read, but {_kinds(unread)}: "
                "convert them, or list the classes to use in `classes`"
            )
            raise naming(ValueError(text), "classes")
        if not read and not (whole and names):  # a listed class must have pictures
            kind = "files, but no pictures" if files else "no pictures"
            end = "it is not a class" if whole else "left out"
            warn_left_out(f"{by_name[name]} holds {kind}: {end}")
        start = len(str(by_name[name])) - len(name)
        paths += sorted((file[start:] for file in read), key=_parts)
        others += unread
    warn_of_unread(folder, others)
    found = set(_classes(paths))
    if whole and names and (missing := [name for name in names if name not in found]):
        raise FileNotFoundError(f"no pictures of the classes {some(missing)} in {folder}")
    return Pictures(folder, paths)


def warn_of_unread(folder: Path, files: list[str]) -> None:
    if files:
        warn_left_out(
            f"{folder} holds pictures that darswin does not read, {_kinds(files)}, e.g. "
            f"{files[0]}: left out"
        )


def _warn_of_loose(folder: Path, files: list[Path]) -> None:
    if loose := [file for file in files if _is_picture(file)]:
        count = f"{len(loose)}, e.g. {loose[0]}"
        warn_left_out(f"{folder} holds pictures outside the folders of classes ({count}): left out")


def _entries(folder: Path) -> tuple[list[Path], list[Path]]:
    folders: list[Path] = []
    files: list[Path] = []
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            if not entry.name.startswith("."):
                (folders if entry.is_dir() else files).append(folder / entry.name)
    return folders, files


def _below(folder: Path, seen: dict[str, str] | None = None) -> Iterator[str]:
    """As `files_below`. With `seen`, a folder whose real path is in it is an error; without `seen`,
    each folder is read once."""
    strict, seen = seen is not None, {} if seen is None else seen
    for here, folders, files in os.walk(folder, followlinks=True, onerror=_raise):
        real = os.path.realpath(here)
        if real in seen and strict:
            raise ValueError(
                f"{here} and {seen[real]} are the same folder because of a link, so its pictures "
                "would count twice: remove one of them"
            )
        if real in seen:
            folders.clear()
            continue
        seen[real] = here
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (os.path.join(here, name) for name in sorted(files) if not name.startswith("."))


def _raise(error: OSError) -> None:
    raise error


def _has_pictures(folder: Path) -> bool:
    return any(map(_is_picture, _below(folder)))


def _is_picture(path: str | Path) -> bool:
    return _suffix(path) in PICTURES


def _suffix(path: str | Path) -> str:
    return os.path.splitext(path)[1].lower()


def _parts(path: str) -> list[str]:
    return path.split(os.sep)


def _kinds(paths: Iterable[str]) -> str:
    """ "3 .gif, 1 .heic" """
    counts = Counter(map(_suffix, paths))
    return ", ".join(f"{count} {suffix}" for suffix, count in counts.most_common())


def _listed(root: Path, lists: Path) -> dict[Split, Pictures]:
    """The pictures of each split in the lists."""
    given: dict[Split, list[str]] = {}
    for split, paths in read_split_lists(lists).items():
        for path in paths:
            parts = Path(path).parts if isinstance(path, str) else ()
            if len(parts) < 2 or Path(path).is_absolute() or ".." in parts:
                raise ValueError(
                    f"{lists}: {split!r} must list paths CLASS/… below {root}, got {path!r}"
                )
        given[split] = list(dict.fromkeys(map(os.path.normpath, paths)))
    split_of = split_of_each(given, lists)
    if missing := _missing(root, split_of):
        raise FileNotFoundError(
            f"{lists} lists {counted(len(missing), 'picture')} missing in {root}: {some(missing)}"
        )
    return {split: Pictures(root, paths) for split, paths in given.items()}


def _missing(root: Path, paths: Iterable[str]) -> list[str]:
    """The paths that are no files in `root`. Reading folders is faster than to look for each."""
    there: dict[str, set[str]] = {}
    missing: list[str] = []
    for path in paths:
        folder, name = os.path.split(path)
        if folder not in there:
            place = root / folder
            there[folder] = set(os.listdir(place)) if place.is_dir() else set()
        # Some systems give names in another case or form of Unicode.
        if name not in there[folder] and not (root / path).is_file():
            missing.append(path)
    return missing
