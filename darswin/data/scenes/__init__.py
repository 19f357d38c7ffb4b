"""Scenes: pictures with a label or a distance for each pixel, and readers of data sets of them."""

from pathlib import Path
from typing import get_args

from darswin.data.scenes.cityscapes import is_cityscapes, open_cityscapes
from darswin.data.scenes.coco import is_coco, open_coco
from darswin.data.scenes.files import Options, ScenesSplit
from darswin.data.scenes.kitti360 import is_kitti360, open_kitti360
from darswin.data.scenes.plain import FORM, is_plain, open_plain
from darswin.data.scenes.scene import Scenes, Target
from darswin.data.scenes.woodscape import (
    is_synwoodscape,
    is_woodscape,
    open_synwoodscape,
    open_woodscape,
)
from darswin.data.splits import check_split

# The first that recognizes a path opens it.
READERS = (
    (is_plain, open_plain),
    (is_kitti360, open_kitti360),
    (is_synwoodscape, open_synwoodscape),
    (is_woodscape, open_woodscape),
    (is_cityscapes, open_cityscapes),
    (is_coco, open_coco),
)


def open_scenes(
    path: str | Path,
    split: ScenesSplit,
    target: Target,
    *,
    channels: int | None = 3,
    lens: str | Path | None = None,
    camera: str | None = None,
    coefficients: str | None = None,
    classes: str | Path | None = None,
    splits: str | Path | None = None,
    label_map: str | Path | None = None,
    holdout: float = 0.1,
) -> Scenes:
    """The scenes of one split of a data set.

    What `path` may be, told from its folders:

    - the plain form: `images/STEM.png` (also jpg, bmp, webp, tif, ppm), and for each
      `labels/STEM.png`, ids of 8 bits, or `distance/STEM.png`, 16 bits of metres × 256, or
      `distance/STEM.npy`, floating-point metres; 0 is not known. STEM may have folders. All that in
      ROOT, or in `ROOT/train`, `ROOT/val` and `ROOT/test`. The lens is in `lenses/STEM.json`, one
      for a picture, or in `lens.json` beside `images/` or in ROOT: a calibration, or what
      `darswin.data.Calibrations` takes as a lenses.json, with paths relative to its folder. Both
      may also end in yaml, yml, xml, txt, bin or npz. `classes.json` beside `images/` or in ROOT
      names the classes;
    - WoodScape, SynWoodScape, KITTI-360, Cityscapes or COCO panoptic, as their authors publish
      them; the last two need a lens, in `lens.json` in ROOT or as `lens`.

    Without a test set, "val" serves as one. What has neither, or no "val", gets `holdout` of
    "train" for each, chosen by a hash of their names; at least one is left to train on. Pictures
    that are in no split are named in `LeftOut` warnings.

    Args:
        split: "all" is every scene of a folder without splits.
        target: what is known of each pixel: "labels" or "distance", along the ray.
        channels: 3 or 1, of the images that come out. None means 1 if all pictures are grey, else
            3; the headers of some of the pictures tell.
        lens, camera, coefficients: as `darswin.data.Calibrations`, in place of the data set's own.
            Without `lens`, `camera` and `coefficients` are those of its `lens.json`.
        classes: the names of the classes, in place of the data set's own: a text file with one a
            line, a JSON list, or {"names": [...], "colors": [[r, g, b], ...]}.
        splits: a JSON file `{"train": [stems], "val": …, "test": …}`, or a folder of `train.txt`,
            `val.txt`, `test.txt` with one stem a line; with or without the pictures' suffix. A
            split without a list is held out. For WoodScape and SynWoodScape also "heal-swin".
        label_map: a JSON object that gives ids in the label files their classes, by name or by
            id, such as {"7": "road", "8": 1, "9": null}. Ids that it leaves out, or maps to null,
            count as unlabelled. Without `classes`, its names are the classes, in their order.
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: a folder, lens, label or list that is missing, or a split without scenes.
        ValueError: what can be read in two ways or does not fit. Both name it.
    """
    check_split(split, get_args(ScenesSplit), holdout)
    if target not in get_args(Target):
        raise ValueError(f"target must be one of {get_args(Target)}, got {target!r}")
    if channels not in (1, 3, None):
        raise ValueError(f"`channels` must be 1, 3 or None, got {channels}")
    root = Path(path)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    options = Options(
        split,
        target,
        channels or 3,
        lens,
        camera,
        coefficients,
        classes,
        splits,
        label_map,
        holdout,
    )
    for recognizes, open_split in READERS:
        if recognizes(root):
            scenes = open_split(root, options)
            if channels is None:
                scenes.channels = scenes.form().channels
            return scenes
    raise FileNotFoundError(f"no scenes in {root}: {FORM}")
