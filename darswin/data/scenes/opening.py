"""Opening a data set of scenes: which kind a path is, and which part of it a split means."""

from pathlib import Path
from typing import get_args

from darswin.data.scenes import kitti360, plain, synwoodscape, woodscape
from darswin.data.scenes.options import Options
from darswin.data.scenes.parts import ScenesSplit
from darswin.data.scenes.scene import Scenes, Target

# The first that fits a path is taken.
KINDS = (plain, kitti360, synwoodscape, woodscape)


def open_scenes(
    path: str | Path,
    split: ScenesSplit,
    target: Target,
    *,
    channels: int = 3,
    lens: str | Path | None = None,
    camera: str | None = None,
    coefficients: str | None = None,
    classes: str | Path | None = None,
    splits: str | Path | None = None,
    holdout: float = 0.1,
) -> Scenes:
    """The part of a data set of scenes that a split means.

    What `path` may be, told from its folders:

    - the plain form: `images/STEM.png` (also jpg, bmp, webp, tif, ppm), and for each
      `labels/STEM.png`, ids of 8 bits, or `distance/STEM.png`, 16 bits of metres × 256, or
      `distance/STEM.npy`, floating-point metres; 0 is not known. STEM may have folders. All that in
      ROOT, or in `ROOT/train`, `ROOT/val` and `ROOT/test`. The lens is in `lenses/STEM.json`, one
      for a picture, or in `lens.json` beside `images/` or in ROOT: a calibration, or what
      `darswin.data.Calibrations` takes as a lenses.json, with paths relative to its folder.
      `classes.json` beside `images/` or in ROOT names the classes;
    - WoodScape, SynWoodScape or KITTI-360, as `darswin.data.scenes.woodscape`, `synwoodscape` and
      `kitti360` say.

    Without a test set, "val" serves as one. What has neither, or no "val", gets `holdout` of
    "train" for each, chosen by a hash of their names; at least one is left to train on. Pictures
    that are in no split are said as `darswin.data.folders.LeftOut` warnings.

    Args:
        split: "all" is every scene of a folder without splits.
        target: what is known of each pixel: "labels" or "distance", along the ray.
        channels: 3 or 1, of the images that come out.
        lens, camera, coefficients: as `darswin.data.Calibrations`, in place of the data set's own.
        classes: the names of the classes, in place of the data set's own: a text file with one a
            line, a JSON list, or {"names": [...], "colors": [[r, g, b], ...]}.
        splits: a JSON file `{"train": [stems], "val": …, "test": …}`, or a folder of `train.txt`,
            `val.txt`, `test.txt` with one stem a line; with or without the pictures' suffix. A
            split without a list is held out. For WoodScape and SynWoodScape also "heal-swin".
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: a folder, lens, label or list that is missing, or a split without scenes.
        ValueError: what can be read in two ways or does not fit. Both name it.
    """
    if split not in get_args(ScenesSplit):
        raise ValueError(f"split must be one of {get_args(ScenesSplit)}, got {split!r}")
    if target not in get_args(Target):
        raise ValueError(f"target must be one of {get_args(Target)}, got {target!r}")
    if channels not in (1, 3):
        raise ValueError(f"channels must be 1 or 3, got {channels}")
    if not 0 <= holdout < 0.5:
        raise ValueError(f"holdout must be in [0, 0.5), got {holdout}")
    for name, value in (("camera", camera), ("coefficients", coefficients)):
        if value is not None and lens is None:
            raise ValueError(f"{name} {value} is one of a calibration: give the lens too")
    root = Path(path)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    kind = next((kind for kind in KINDS if kind.fits(root)), None)
    if kind is None:
        raise FileNotFoundError(f"no scenes in {root}: {plain.FORM}")
    options = Options(split, target, channels, lens, camera, coefficients, classes, splits, holdout)
    return kind.open_split(root, options)
