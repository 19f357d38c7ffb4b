"""Which scenes are for training, validation and testing."""

import os
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Literal

from darswin.data.folders import PICTURES, LeftOut, read_split_lists
from darswin.data.splits import Split, hold_out, some

ScenesSplit = Literal["train", "val", "test", "all"]
# Named splits: stems, sorted → those of each part.
Named = Mapping[str, Callable[[list[str]], dict[Split, list[str]]]]


def taken_from(split: Split, given: Collection[Split]) -> tuple[Split, list[Split]]:
    """Which of the given parts a split is taken from, and which parts are held out of it.

    Without a test set of its own, "val" serves as one; what has neither, or no "val", is held out.

    Raises:
        FileNotFoundError: no part to take it from.
    """
    part: Split = split
    missing: list[Split] = [part for part in ("test", "val") if part not in given]
    if missing == ["test"]:
        part, missing = ("val" if split == "test" else split), []
    elif split in missing:
        part = "train"
    elif split != "train":
        missing = []
    if part not in given:
        raise FileNotFoundError(f"there are {sorted(given)} scenes, and none for {split!r}")
    return part, missing


def without_others(
    stems: list[str],
    split: Split,
    held_out: Sequence[Split],
    *,
    where: Path,
    holdout: float,
    group: Callable[[str], str] | None = None,
) -> list[str]:
    """A split's of the stems that `held_out` are taken from.

    Args:
        where: the folder, for errors. group: of a stem: what is held out together.

    Raises:
        FileNotFoundError: the split has none.
    """
    if held_out:
        groups = {stem: group(stem) if group else stem for stem in stems}
        names = sorted(set(groups.values()))
        kept = {names[k] for k in hold_out([0] * len(names), names, holdout, held_out)[split]}
        stems = [stem for stem in stems if groups[stem] in kept]
        if not stems:
            raise FileNotFoundError(
                f"no scenes for the {split!r} split in {where}: a holdout of {holdout:g} of "
                f"{len(names)} {'groups' if group else 'pictures'} leaves none for it; list the "
                "splits, or hold out more"
            )
    return stems


def choose(
    found: Sequence[str],
    split: ScenesSplit,
    *,
    root: Path,
    splits: str | Path | None = None,
    holdout: float = 0.1,
    group: Callable[[str], str] | None = None,
    named: Named | None = None,
) -> list[str]:
    """The stems of a split, of all those found in a folder that says no splits itself.

    Args:
        splits: lists of stems as `darswin.data.open_scenes` takes them, or one of `named`.
        group: as `without_others`.

    Raises:
        ValueError: lists that are wrong, or a stem in two of them. FileNotFoundError: a stem in the
            split's list that is not there; a split that has none.
    """
    if split == "all":
        return list(found)
    given: dict[Split, list[str]] = {"train": list(found)}
    if splits is not None:
        make = (named or {}).get(str(splits))
        given = make(sorted(found)) if make else _listed(Path(splits), found, named)
    part, held_out = taken_from(split, given)
    chosen = given[part]
    if unknown := sorted(set(chosen) - set(found)):
        raise FileNotFoundError(
            f"{splits} lists {len(unknown)} pictures for {part!r} that are not in {root}: "
            f"{some(unknown)}"
        )
    if not chosen:
        raise FileNotFoundError(f"{splits} lists no pictures for {part!r}")
    return without_others(chosen, split, held_out, where=root, holdout=holdout, group=group)


def _listed(path: Path, found: Sequence[str], named: Named | None) -> dict[Split, list[str]]:
    if named and not path.exists():
        raise FileNotFoundError(f"no lists of splits {path}; splits with a name: {sorted(named)}")
    given: dict[Split, list[str]] = {}
    where: dict[str, Split] = {}
    for split, names in read_split_lists(path).items():
        if wrong := [name for name in names if not isinstance(name, str)]:
            raise ValueError(f"{path} must list names for {split!r}, got {wrong[0]!r}")
        given[split] = [_stem(name) for name in names]
        for stem in given[split]:
            if where.setdefault(stem, split) != split and "train" in (where[stem], split):
                raise ValueError(f"{path} lists {stem} for {where[stem]!r} and for {split!r}")
        given[split] = list(dict.fromkeys(given[split]))
    if left := [stem for stem in found if stem not in where]:
        text = f"{path} lists {len(left)} pictures for no split, {some(left)}: left out"
        warnings.warn(text, LeftOut, stacklevel=2)
    return given


def _stem(name: str) -> str:
    """A picture's stem, from its name with or without its suffix."""
    stem, suffix = os.path.splitext(name)
    return os.path.normpath(stem if suffix.lower() in PICTURES else name)
