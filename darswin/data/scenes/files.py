"""Which files are scenes: pictures and the files of the same names beside them."""

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from darswin.data.folders import OTHER_SUFFIXES, SUFFIXES, LeftOut, files_below
from darswin.data.splits import some

Pairs = dict[str, tuple[str, str]]  # by their stems: (picture, target), relative to a folder


def stems(folder: Path, suffixes: Sequence[str] | frozenset[str]) -> dict[str, str]:
    """The files below a folder by their paths in it without a suffix, sorted.

    Raises:
        FileNotFoundError: no such folder. ValueError: two files of one stem.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}")
    found: dict[str, str] = {}
    for file in sorted(files_below(folder)):
        stem, suffix = os.path.splitext(os.path.relpath(file, folder))
        if suffix.lower() not in suffixes:
            continue
        if stem in found:
            raise ValueError(f"{found[stem]} and {file} have one stem: keep one of them")
        found[stem] = file
    return found


def pictures_in(folder: Path) -> dict[str, str]:
    """The pictures below a folder, as `stems`.

    Raises:
        FileNotFoundError: none.
    """
    found = stems(folder, SUFFIXES)
    others = stems(folder, OTHER_SUFFIXES)
    if not found:
        raise FileNotFoundError(f"no pictures in {folder}")
    if others:
        _say(f"{folder} holds pictures that darswin does not read, {some(list(others))}: left out")
    return found


def pair(
    pictures: dict[str, str],
    targets: dict[str, str],
    choice: Callable[[list[str]], list[str]],
    *,
    root: Path,
    what: str,
    strict: bool = True,
) -> Pairs:
    """The pictures that `choice` takes, and the targets of the same stems.

    Args:
        root: what the paths become relative to. what: the targets, as errors call them.
        strict: pictures without a target are an error if they are chosen, else left out.

    Raises:
        FileNotFoundError: pictures without a target, by name.
    """
    stems = list(pictures)
    if not strict:
        stems = [stem for stem in pictures if stem in targets]
        if without := len(pictures) - len(stems):
            _say(f"{without} of {len(pictures)} pictures in {root} have no {what}: left out")
    if alone := [targets[stem] for stem in targets if stem not in pictures]:
        _say(f"{len(alone)} files of {what} have no picture, {some(alone)}: left out")
    chosen = choice(stems)
    if missing := [pictures[stem] for stem in chosen if stem not in targets]:
        raise FileNotFoundError(
            f"no {what} for {len(missing)} of {len(chosen)} pictures, {some(missing)}: add them, "
            "move the pictures away, or list those to take as splits"
        )
    return {
        stem: (os.path.relpath(pictures[stem], root), os.path.relpath(targets[stem], root))
        for stem in chosen
    }


def _say(text: str) -> None:
    warnings.warn(text, LeftOut, stacklevel=2)
