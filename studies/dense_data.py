"""The pictures of the dense study: worlds through the lenses of training and tests.

All test sets show the same poses, in maps that the training pictures do not show.
"""

import json
import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jobs import run_all
from worlds.dataset import Target, jobs_of, write_map
from worlds.lenses import draw_lens

from darswin.lens import save

FOV = math.radians(165)  # the full field of view of lenses given by ξ
SIZE = 128  # px
PICTURES = 8000, 16, 75  # for training, for validation, and in each test set (5 per map)

# The lenses of training: perspective lenses of 60° to 90°, and one band of ξ.
BANDS = {"wide": "wide", "low": "0.2..0.35"}
TRAINED_ON = "low"  # the band of the baselines that ignore the picture
SWEEP = [f"{k / 10:g}" for k in range(11)]  # ξ = 0, 0.1, …, 1

FILES = Path(__file__).parent.parent / "tests" / "lens" / "files"
# TUM-VI is a real camera. We made up the numbers of the others: see the README of the folder.
CAMERAS = {
    "front": "woodscape.json",
    "second front": "synwoodscape.json",
    "left": "kitti360_02.yaml",
    "right": "kitti360_03.yaml",
    "TUM-VI left": "kalibr_tumvi.yaml:cam0",
    "OCamCalib": "ocamcalib.txt",
}

# The controls: pictures with a lens that did not take them.
TOLD = "0.275"  # the ξ that models are given, in the middle of "low"
WRONG = ("0", "0.5", "1")  # the true ξ of pictures whose lens is given as TOLD
SHUFFLED = "shuffled"  # each picture has the lens of another picture


def xi_set(xi: str) -> str:
    """The name of the test set of one ξ."""
    return f"xi-{xi}"


def camera_set(name: str) -> str:
    """The name of the test set of a camera of a calibration file."""
    return name.lower().replace(" ", "-")


def test_sets() -> list[str]:
    """The folders of all test sets."""
    sets = [xi_set(xi) for xi in SWEEP] + [f"band-{band}" for band in BANDS]
    sets += [camera_set(name) for name in CAMERAS]
    sets += [f"wrong-{xi}" for xi in WRONG] + [f"{SHUFFLED}-band-{band}" for band in BANDS]
    return sets


def make(
    root: Path, processes: int, size: int, counts: tuple[int, int, int], bands: Iterable[str]
) -> None:
    """Renders missing data sets into `root/train` and `root/test`, and makes the controls.

    Args:
        bands: the bands of the training pictures.
    """
    train, val, test = counts
    bands = {TRAINED_ON, *bands}
    to_train = [Target(str(root / "train" / b), BANDS[b], FOV) for b in bands]
    lenses = {xi_set(xi): xi for xi in SWEEP}
    lenses |= {f"band-{band}": name for band, name in BANDS.items()}
    lenses |= {camera_set(name): str(FILES / file) for name, file in CAMERAS.items()}
    to_test = [Target(str(root / "test" / name), lens, FOV) for name, lens in lenses.items()]
    jobs = jobs_of(to_train, "train", train, size, 0) + jobs_of(to_train, "val", val, size, 0)
    jobs += jobs_of(to_test, "test", test, size, 0)
    run_all(write_map, jobs, processes, "map")
    told = draw_lens(TOLD, size, FOV, np.random.default_rng(0))
    for xi in WRONG:
        folder = same_pictures(root / "test" / xi_set(xi), root / "test" / f"wrong-{xi}", "test")
        save(told, folder / "lens.json")
    for band in BANDS:
        name = f"band-{band}"
        shuffle(root / "test" / name, root / "test" / f"{SHUFFLED}-{name}", "test")
    for band in bands:
        shuffled = root / "train" / f"{SHUFFLED}-{band}"
        shuffle(root / "train" / band, shuffled, "train")
        shuffle(root / "train" / band, shuffled, "val")


def shuffle(source: Path, copy: Path, split: str) -> None:
    """The same pictures, each with the lens of another picture."""
    folder = same_pictures(source, copy, split)
    (folder / "lenses").mkdir(exist_ok=True)
    files = sorted((source / split / "lenses").iterdir())
    order = np.random.default_rng(0).permutation(len(files))
    for file, other in zip(files, np.roll(order, 1)[np.argsort(order)], strict=True):
        (folder / "lenses" / file.name).write_text(files[other].read_text())


def same_pictures(source: Path, copy: Path, split: str) -> Path:
    """The folder `copy/split` with links to the pictures and targets in `source/split`."""
    folder = copy / split
    folder.mkdir(parents=True, exist_ok=True)
    for place, target in (
        (copy / "classes.json", source / "classes.json"),
        *((folder / kind, source / split / kind) for kind in ("images", "labels", "distance")),
    ):
        place.unlink(missing_ok=True)
        place.symlink_to(target.resolve())
    return folder


def classes(root: Path) -> list[str]:
    """The names of the classes."""
    return json.loads((root / "train" / "low" / "classes.json").read_text())["names"]
