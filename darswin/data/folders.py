"""Which pictures a folder holds, and which of them are for training, validation and testing.

Nothing is left out silently: what can be read in two ways is refused with a sentence that names the
folder, and what no split takes is said as a `LeftOut` warning.
"""

import os
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from darswin.data.sources import ImageFiles
from darswin.data.splits import Split, hold_out, read_json, read_list, some

# What folders and lists of a split are called, in any case.
SPLIT_NAMES: dict[str, Split] = {
    "train": "train", "training": "train",
    "val": "val", "valid": "val", "validation": "val",
    "test": "test", "testing": "test",
}  # fmt: skip
SUFFIXES = frozenset((
    ".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".bmp", ".dib", ".webp", ".tif", ".tiff", ".ppm",
    ".pgm", ".pbm", ".pnm",
))  # fmt: skip
# Pictures that OpenCV reads only in some builds, or not at all.
OTHER_SUFFIXES = frozenset((
    ".gif", ".heic", ".heif", ".avif", ".jp2", ".j2k", ".jxl", ".psd", ".svg", ".tga", ".exr",
    ".hdr", ".dng", ".cr2", ".nef", ".arw",
))  # fmt: skip
PICTURES = SUFFIXES | OTHER_SUFFIXES
LOOKED_FOR = (
    "darswin looks for ROOT/CLASS/*.jpg (and png, bmp, webp, tif, ppm), or for folders of that "
    "kind in ROOT/train, ROOT/val and ROOT/test"
)


class LeftOut(UserWarning):
    """Pictures that are in no split, or in fewer than they should be."""


@dataclass(frozen=True)
class Pictures:
    """Attributes: folder; paths: "class/….jpg" below it."""

    folder: Path
    paths: list[str]


def pictures_of(
    split: Split,
    root: Path,
    *,
    names: list[str] | None = None,
    lists: str | Path | None = None,
    holdout: float = 0.1,
) -> tuple[Pictures, list[str]]:
    """The pictures of a split, and the names of all classes. See `darswin.data.open_source`.

    Raises:
        FileNotFoundError: no pictures. ValueError: folders or lists that can be read in two ways,
            or do not fit each other.
    """
    given = _found(root, names) if lists is None else _listed(root, Path(lists))
    if "train" not in given or (split == "train" and not given["train"].paths):
        raise FileNotFoundError(f"no images for the 'train' split in {root}: {LOOKED_FOR}")
    classes = names or _classes(given["train"].paths)
    for part, pictures in given.items():
        if unknown := sorted(set(_classes(pictures.paths)) - set(classes)):
            reason = "the list of classes does not name" if names else "training has no pictures of"
            raise ValueError(
                f"{pictures.folder} holds pictures for the {part!r} split of the classes "
                f"{some(unknown)}, which {reason}: move them away, or list the classes to take in "
                "--data.classes"
            )
    # Without a test set of its own, "val" serves as one.
    held_out: list[Split] = [part for part in ("test", "val") if part not in given]
    if held_out == ["test"]:
        held_out, given["test"] = [], given["val"]
    if held_out and split in ("train", *held_out):
        given |= _held_out(given["train"], held_out, holdout)
    pictures = given[split]
    if not pictures.paths:
        none_left = f"--data.holdout {holdout:g} leaves none for it"
        raise FileNotFoundError(
            f"no images for the {split!r} split in {pictures.folder}: "
            f"{none_left if split in held_out else LOOKED_FOR}"
        )
    return pictures, classes


def pictures_below(folder: Path) -> list[str]:
    """The pictures in a folder and in those below it, sorted; links are followed, hidden ones not.

    Raises:
        FileNotFoundError: none that darswin reads.
    """
    files = sorted(files_below(folder), key=_parts)
    read = [file for file in files if _suffix(file) in SUFFIXES]
    others = [file for file in files if _suffix(file) in OTHER_SUFFIXES]
    if not read:
        found = f", but {_kinds(others)}, which darswin does not read" if others else ""
        raise FileNotFoundError(f"no pictures in {folder}{found}")
    _say_unread(folder, others)
    return read


def open_folder(
    root: Path, split: Split, channels: int, names: list[str] | None,
    lists: str | Path | None, holdout: float,
) -> ImageFiles:  # fmt: skip
    """The pictures of a split as a source; arguments and errors as `darswin.data.open_source`."""
    pictures, names = pictures_of(split, root, names=names, lists=lists, holdout=holdout)
    label = {name: k for k, name in enumerate(names)}
    files = [(path, label[class_of(path)]) for path in pictures.paths]
    return ImageFiles(pictures.folder, files, names, channels)


def _held_out(training: Pictures, parts: Sequence[Split], holdout: float) -> dict[Split, Pictures]:
    """A share of the training pictures for each of `parts`, and for "train" what is left."""
    labels = [class_of(path) for path in training.paths]
    small = sorted(name for name, count in Counter(labels).items() if count <= len(parts))
    if small and holdout > 0:
        _say(
            f"{training.folder}: too few pictures to hold any out of the classes {some(small)}: "
            f"all of them are trained on, none is for {' or '.join(parts)}"
        )
    return {
        part: Pictures(training.folder, [training.paths[k] for k in chosen])
        for part, chosen in hold_out(labels, training.paths, holdout, parts).items()
    }


def files_below(folder: Path) -> list[str]:
    """The files in a folder and in those below it; links are followed, hidden ones not."""
    return list(_below(folder, {}, strict=False))


def class_of(path: str) -> str:
    """The first folder of a path."""
    return path.split(os.sep, 1)[0]


def _classes(paths: Iterable[str]) -> list[str]:
    return sorted({class_of(path) for path in paths})


def _say(text: str) -> None:
    warnings.warn(text, LeftOut, stacklevel=2)


# -- folders ----------------------------------------------------------------------------------


def _found(root: Path, names: list[str] | None) -> dict[Split, Pictures]:
    """The pictures of each split that has a folder; of a folder without splits, "train" alone."""
    # Folders by their real path: a link to one of them, or to one above, gives its pictures twice.
    real = Path(os.path.realpath(root))
    seen = {str(folder): str(folder) for folder in (real, *real.parents)}
    folders = _split_folders(root, names)
    if folders is None:
        return {"train": _pictures(root, names, seen, whole=True)}
    return {
        split: _pictures(folder, names, seen, whole=split == "train")
        for split, folder in folders.items()
    }


def _split_folders(root: Path, names: list[str] | None) -> dict[Split, Path] | None:
    """The folders of the splits, or None where the folders in `root` are those of the classes."""
    named: dict[Split, Path] = {}
    others = []
    folders, loose = _entries(root)
    for folder in folders:
        split = SPLIT_NAMES.get(folder.name.lower())
        if split is None:
            others.append(folder)
        elif _has_pictures(folder):
            if split in named and not folder.samefile(named[split]):
                raise ValueError(
                    f"{named[split]} and {folder} both have a name of the {split!r} split: keep one"
                )
            named[split] = folder
    if not named or {folder.name for folder in named.values()} & set(names or ()):
        return None
    if "test" in named and "val" in named and named["test"].samefile(named["val"]):
        del named["test"]  # "val" serves as the test set
    others = [folder for folder in others if _has_pictures(folder)]
    has_classes = "train" in named and any(map(_has_pictures, _entries(named["train"])[0]))
    if has_classes and (len(named) > 1 or not others):
        for folder in others:
            _say(f"{folder} holds pictures, but is no split beside {named['train']}: left out")
        _say_loose(root, loose)
        return named
    if names and all((root / name).is_dir() for name in names):
        return None
    if others and all(any(map(_is_picture, _entries(f)[1])) for f in named.values()):
        return None
    shown = " and ".join(str(folder) for folder in named.values())
    raise ValueError(
        f"{shown} may be meant as splits or as classes: {LOOKED_FOR}; if they are classes, list "
        "all classes in --data.classes"
    )


def _pictures(folder: Path, names: list[str] | None, seen: dict[str, str], whole: bool) -> Pictures:
    """The pictures in the folders of classes, of these classes or of all.

    Args:
        seen: real paths of folders that were read, to which those read here are added.
        whole: each of `names` must have pictures.
    """
    folders, loose = _entries(folder)
    _say_loose(folder, loose)
    by_name = {f.name: f for f in folders}
    paths, others = [], []
    for name in by_name if names is None else [name for name in names if name in by_name]:
        files = list(_below(by_name[name], seen))
        read = [file for file in files if _suffix(file) in SUFFIXES]
        unread = [file for file in files if _suffix(file) in OTHER_SUFFIXES]
        if unread and not read:
            raise ValueError(
                f"{by_name[name]} holds no picture that darswin reads, but {_kinds(unread)}: "
                "convert them, or list the classes to take in --data.classes"
            )
        if files and not read:
            _say(f"{by_name[name]} holds files, but no pictures: it is no class")
        start = len(str(by_name[name])) - len(name)
        paths += sorted((file[start:] for file in read), key=_parts)
        others += unread
    _say_unread(folder, others)
    found = set(_classes(paths))
    if whole and names and (missing := [name for name in names if name not in found]):
        raise FileNotFoundError(f"no pictures of the classes {some(missing)} in {folder}")
    return Pictures(folder, paths)


def _say_unread(folder: Path, files: list[str]) -> None:
    if files:
        _say(
            f"{folder} holds pictures that darswin does not read, {_kinds(files)}, e.g. "
            f"{files[0]}: left out"
        )


def _say_loose(folder: Path, files: list[Path]) -> None:
    if loose := [file for file in files if _is_picture(file)]:
        count = f"{len(loose)}, e.g. {loose[0]}"
        _say(f"{folder} holds pictures in no class's folder ({count}): left out")


def _entries(folder: Path) -> tuple[list[Path], list[Path]]:
    """The folders and the files in a folder, sorted, links to them too, no hidden ones."""
    folders: list[Path] = []
    files: list[Path] = []
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            if not _hidden(entry.name):
                (folders if entry.is_dir() else files).append(folder / entry.name)
    return folders, files


def _below(folder: Path, seen: dict[str, str], strict: bool = True) -> Iterator[str]:
    """Files below a folder, through links too, no hidden ones.

    Args:
        seen: real paths of folders that were read. One of them is refused, or left out if not
            `strict`.
    """
    for here, folders, files in os.walk(folder, followlinks=True, onerror=_raise):
        real = os.path.realpath(here)
        if real in seen and strict:
            raise ValueError(
                f"{here} and {seen[real]} are the same folder, by a link: its pictures would count "
                "twice, remove one"
            )
        if real in seen:
            folders.clear()
            continue
        seen[real] = here
        folders[:] = sorted(name for name in folders if not _hidden(name))
        yield from (os.path.join(here, name) for name in sorted(files) if not _hidden(name))


def _raise(error: OSError) -> None:
    raise error


def _has_pictures(folder: Path) -> bool:
    return any(map(_is_picture, _below(folder, {}, strict=False)))


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


def _hidden(name: str) -> bool:
    return name.startswith(".")


# -- lists ------------------------------------------------------------------------------------


def read_split_lists(lists: Path) -> dict[Split, list]:
    """What lists say is in each split: a JSON file, or a folder of text files, one a split. Whether
    it is paths is left to the reader.

    Raises:
        ValueError: what is no such list, or two of one split; it names them. OSError: it cannot be
            read.
    """
    if lists.is_dir():
        content = {
            file.stem: read_list(file)
            for file in sorted(lists.glob("*.txt"))
            if file.stem.lower() in SPLIT_NAMES
        }
    else:
        content = read_json(lists)
    form = f'{lists} must hold {{"train": [paths], "val": [paths], "test": [paths]}}'
    if not isinstance(content, dict):
        raise ValueError(form)
    given: dict[Split, list] = {}
    for name, paths in content.items():
        split = SPLIT_NAMES.get(name.lower())
        if split is None or split in given:
            raise ValueError(f"{form}, got {list(content)}")
        if not isinstance(paths, list):
            raise ValueError(f"{form}, got {paths!r} for {name!r}")
        given[split] = paths
    return given


def _listed(root: Path, lists: Path) -> dict[Split, Pictures]:
    """The pictures of each split that the lists have."""
    given: dict[Split, Pictures] = {}
    for split, paths in read_split_lists(lists).items():
        for path in paths:
            parts = Path(path).parts if isinstance(path, str) else ()
            if len(parts) < 2 or Path(path).is_absolute() or ".." in parts:
                raise ValueError(
                    f"{lists}: {split!r} must hold paths CLASS/… below {root}, got {path!r}"
                )
        given[split] = Pictures(root, [os.path.normpath(path) for path in paths])
    return given
