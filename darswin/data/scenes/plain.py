"""The plain form: `images/`, `labels/` or `distance/`, and a lens beside them."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from darswin.data.cameras import Calibrations
from darswin.data.scenes.files import Options, Pairs, pair, pictures_in, stems
from darswin.data.scenes.scene import NO_CLASSES, SUFFIXES, Scenes, read_palette
from darswin.data.splits import Split, part_of_split, split_folders, taken_from

FORM = (
    "darswin looks for images/STEM.png (or jpg, bmp, webp, tif, ppm) with labels/STEM.png or "
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
                f"{root / 'images'} and {next(iter(folders.values()))} may both be meant: {FORM}"
            )
        return _scenes(root, root, options, partial(options.choose, root=root))
    if options.splits is not None:
        raise ValueError(f"{options.splits} lists splits, and {root} has a folder for each")
    split = options.split
    if split == "all":
        raise ValueError(f"{root} has a folder for each split: 'all' is of a folder without splits")
    part, held_out = taken_from(split, folders)
    folder = folders[part]

    def choose(found: list[str]) -> list[str]:
        return part_of_split(found, split, held_out, options.holdout, folder)

    return _scenes(root, folder, options, choose)


def _scenes(
    root: Path, folder: Path, options: Options, choose: Callable[[list[str]], list[str]]
) -> Scenes:
    """The scenes of a folder with `images/`, of the stems that `choose` takes."""
    target = options.target
    targets = stems(folder / target, SUFFIXES[target])
    pairs = pair(pictures_in(folder / "images"), targets, choose, root=folder, what=target)
    classes = NO_CLASSES
    if target == "labels":
        classes = read_palette(options.classes or _beside("classes.json", folder, root))
    lenses = options.given_lens(root) or _lenses(root, folder, pairs)
    files = list(pairs.values())
    return Scenes(folder, files, lenses, target=target, channels=options.channels, classes=classes)


def _lenses(root: Path, folder: Path, pairs: Pairs) -> Calibrations:
    """The lenses of the pictures themselves, else the folder's."""
    own = stems(folder / "lenses", (".json",)) if (folder / "lenses").is_dir() else {}
    files = {folder / pairs[stem][0]: Path(own[stem]) for stem in pairs if stem in own}
    missing = [stem for stem in pairs if stem not in own]
    if not missing:
        return Calibrations(None, files=files)
    try:
        shared = _beside("lens.json", folder, root)
    except FileNotFoundError as error:
        has = f"{folder / 'lenses' / missing[0]}.json" if own else f"lens.json in {folder}"
        raise FileNotFoundError(
            f"no lens for {folder / pairs[missing[0]][0]}: add {has}, or give `lens`"
        ) from error
    return Calibrations(shared, shared.parent, files=files)


def _beside(name: str, folder: Path, root: Path) -> Path:
    """A file in the split's folder, or else in the root."""
    for place in (folder / name, root / name):
        if place.is_file():
            return place
    raise FileNotFoundError(f"no {name} in {folder}" + (f" or {root}" if folder != root else ""))


def _split_folders(root: Path) -> dict[Split, Path]:
    """The folders of the splits, which hold `images/`."""
    return split_folders(sorted(root.iterdir()), lambda folder: (folder / "images").is_dir())
