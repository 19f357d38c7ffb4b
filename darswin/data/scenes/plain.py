"""The plain form of scenes: `images/`, `labels/` or `distance/`, and a lens beside them."""

from functools import partial
from pathlib import Path

from darswin.data.cameras import Calibrations
from darswin.data.scenes.files import (
    CALIBRATIONS,
    Choose,
    Options,
    Pairs,
    calibration_in,
    pair,
    pictures_in,
    refuse_outlines,
    stems,
)
from darswin.data.scenes.scene import NO_CLASSES, Classes, Scenes, read_palette
from darswin.data.scenes.targets import KINDS
from darswin.data.splits import Split, split_folders
from darswin.utils.parameters import naming

FORM = (
    "darswin looks for images/STEM.png (also jpg, bmp, webp, tif, ppm) with labels/STEM.png or "
    "distance/STEM.png or .npy, and for lens.json or lenses/STEM.json, in ROOT, or in ROOT/train, "
    "ROOT/val and ROOT/test"
)


def is_plain(root: Path) -> bool:
    return (root / "images").is_dir() or bool(_split_folders(root))


def open_plain(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    folders = _split_folders(root)
    if (root / "images").is_dir():
        if folders:
            raise ValueError(
                f"{root} has both {root / 'images'} and {next(iter(folders.values()))}: {FORM}"
            )
        return _scenes(root, root, options, partial(options.choose, root=root))
    part, choose = options.choose_part(folders, root)
    return _scenes(root, folders[part], options, choose)


def _scenes(root: Path, folder: Path, options: Options, choose: Choose) -> Scenes:
    """The scenes of a folder with `images/`, of the stems that `choose` takes."""
    target = options.target
    if target == "labels" and not (folder / target).is_dir():
        refuse_outlines(root)
    targets = stems(folder / target, KINDS[target].suffixes)
    pairs = pair(pictures_in(folder / "images"), targets, choose, root=folder, what=target)
    classes, read = NO_CLASSES, KINDS[target].read
    if target == "labels":
        classes, read = options.labels(partial(_classes, folder, root))
    lenses = options.given_lens(root) or _lenses(root, folder, pairs, options)
    files = list(pairs.values())
    return Scenes(folder, files, lenses, target=target, classes=classes, read=read)


def _lenses(root: Path, folder: Path, pairs: Pairs, options: Options) -> Calibrations:
    """The lenses of the pictures, or else the lens of their folder."""
    own = stems(folder / "lenses", CALIBRATIONS) if (folder / "lenses").is_dir() else {}
    files = {folder / pairs[stem][0]: Path(own[stem]) for stem in pairs if stem in own}
    missing = [stem for stem in pairs if stem not in own]
    if not missing:
        return options.own_lenses(files)
    shared = calibration_in(folder, root)
    if shared is None:
        has = f"{folder / 'lenses' / missing[0]}.json" if own else f"lens.json in {folder}"
        text = f"no lens for {folder / pairs[missing[0]][0]}: add {has}, or give `lens`"
        raise naming(FileNotFoundError(text), "lens")
    return Calibrations(shared, shared.parent, options.camera, options.coefficients, files=files)


def _classes(folder: Path, root: Path) -> Classes:
    """The classes of the split's folder, or else of the root."""
    for place in dict.fromkeys((folder, root)):
        if (place / "classes.json").is_file():
            return read_palette(place / "classes.json")
    text = (
        f"no classes.json in {root}: name the classes of the ids 0, 1, … there, for example "
        '{"names": ["road", "car"], "colors": [[128, 64, 128], [0, 0, 142]]}, or give `classes`. '
        'A `label_map` names them too, for example {"0": "background", "255": "car"} for masks'
    )
    raise naming(FileNotFoundError(text), "classes", "label_map")


def _split_folders(root: Path) -> dict[Split, Path]:
    """The folders of the splits, which hold `images/`."""
    return split_folders(sorted(root.iterdir()), lambda folder: (folder / "images").is_dir())
