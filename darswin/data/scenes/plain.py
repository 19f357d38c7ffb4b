"""The plain form: `images/`, `labels/` or `distance/`, and a lens beside them."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from darswin.data.calibrations import Calibrations, PictureLenses
from darswin.data.folders import SPLIT_NAMES
from darswin.data.scenes.classes import Classes, read_palette
from darswin.data.scenes.files import Pairs, pair, pictures_in, stems
from darswin.data.scenes.lenses import OwnLenses
from darswin.data.scenes.options import Options
from darswin.data.scenes.parts import taken_from, without_others
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import DISTANCE_SUFFIXES, LABEL_SUFFIXES
from darswin.data.splits import Split

FORM = (
    "darswin looks for images/STEM.png (or jpg, bmp, webp, tif, ppm) with labels/STEM.png or "
    "distance/STEM.png or .npy, and for lens.json or lenses/STEM.json, in ROOT, or in ROOT/train, "
    "ROOT/val and ROOT/test"
)
SUFFIXES = {"labels": LABEL_SUFFIXES, "distance": DISTANCE_SUFFIXES}


def fits(root: Path) -> bool:
    """Whether a folder, or one of a split in it, holds `images/`."""
    return (root / "images").is_dir() or bool(_split_folders(root))


def open_split(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    folders = _split_folders(root)
    if (root / "images").is_dir():
        if folders:
            raise ValueError(
                f"{root / 'images'} and {next(iter(folders.values()))} may both be meant: {FORM}"
            )
        return _scenes(root, root, options, options.choice(root))
    if options.splits is not None:
        raise ValueError(f"{options.splits} lists splits, and {root} has a folder for each")
    if options.split == "all":
        raise ValueError(f"{root} has a folder for each split: 'all' is of a folder without splits")
    part, held_out = taken_from(options.split, folders)
    choice = partial(
        without_others,
        split=options.split,
        held_out=held_out,
        where=folders[part],
        holdout=options.holdout,
    )
    return _scenes(root, folders[part], options, choice)


def _scenes(
    root: Path, folder: Path, options: Options, choice: Callable[[list[str]], list[str]]
) -> Scenes:
    """The scenes of a folder with `images/`, of the stems that `choice` takes."""
    target = options.target
    targets = stems(folder / target, SUFFIXES[target])
    pairs = pair(pictures_in(folder / "images"), targets, choice, root=folder, what=target)
    classes = Classes([], [])
    if target == "labels":
        classes = read_palette(options.classes or _beside("classes.json", folder, root))
    return Scenes(
        folder,
        list(pairs.values()),
        _lenses(root, folder, pairs, options),
        target=target,
        channels=options.channels,
        classes=classes.names,
        colors=classes.colors,
    )


def _lenses(root: Path, folder: Path, pairs: Pairs, options: Options) -> PictureLenses:
    """The lens that was given; else those of the pictures themselves, else the folder's."""
    if options.lens is not None:
        return Calibrations(options.lens, root, options.camera, options.coefficients)
    own: dict[str, str] = {}
    if (folder / "lenses").is_dir():
        own = stems(folder / "lenses", (".json",))
    missing = [stem for stem in pairs if stem not in own]
    shared = None
    if missing:
        try:
            file = _beside("lens.json", folder, root)
        except FileNotFoundError as error:
            has = f"{folder / 'lenses' / missing[0]}.json" if own else f"lens.json in {folder}"
            raise FileNotFoundError(
                f"no lens for {folder / pairs[missing[0]][0]}: add {has}, or give the lens"
            ) from error
        shared = Calibrations(file, file.parent, options.camera)
    if not own:
        assert shared is not None  # as all pictures miss one of their own
        return shared
    files = {folder / pairs[stem][0]: Path(own[stem]) for stem in pairs if stem in own}
    return OwnLenses(files, shared)


def _beside(name: str, folder: Path, root: Path) -> Path:
    """A file in the split's folder, or else in the root."""
    for place in (folder / name, root / name):
        if place.is_file():
            return place
    raise FileNotFoundError(f"no {name} in {folder}" + (f" or {root}" if folder != root else ""))


def _split_folders(root: Path) -> dict[Split, Path]:
    """The folders of the splits, which hold `images/`."""
    named: dict[Split, Path] = {}
    if not root.is_dir():
        return named
    for entry in sorted(os.scandir(root), key=lambda entry: entry.name):
        split, folder = SPLIT_NAMES.get(entry.name.lower()), root / entry.name
        if split is None or not (folder / "images").is_dir():
            continue
        if split in named:
            raise ValueError(
                f"{named[split]} and {folder} both have a name of the {split!r} split: keep one"
            )
        named[split] = folder
    return named
