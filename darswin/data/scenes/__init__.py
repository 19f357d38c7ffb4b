"""Scenes: pictures with a label or a distance for each pixel, and readers of their data sets."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

from darswin.data.scenes.cityscapes import is_cityscapes, open_cityscapes
from darswin.data.scenes.coco import is_coco, open_coco
from darswin.data.scenes.files import Options, ScenesSplit, refuse_outlines
from darswin.data.scenes.kitti360 import is_kitti360, open_kitti360
from darswin.data.scenes.plain import FORM, is_plain, open_plain
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import Target
from darswin.data.scenes.woodscape import (
    is_synwoodscape,
    is_woodscape,
    open_synwoodscape,
    open_woodscape,
)
from darswin.data.splits import check_split
from darswin.utils.parameters import check

# The first reader that recognizes a path opens it. The last words say what a data set lacks.
Reader = tuple[Callable[[Path], bool], Callable[[Path, Options], Scenes], dict[str, str]]
READERS: tuple[Reader, ...] = (
    (is_plain, open_plain, {}),
    (is_kitti360, open_kitti360, {"labels": "KITTI-360, whose fisheye pictures have no labels"}),
    (is_synwoodscape, open_synwoodscape, {}),
    (is_woodscape, open_woodscape, {"distance": "WoodScape, which has labels but no distances"}),
    (is_cityscapes, open_cityscapes, {"distance": "Cityscapes, which has labels but no distances"}),
    (is_coco, open_coco, {"distance": "COCO panoptic, which has labels but no distances"}),
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

    The folders in `path` tell its form:

    - the plain form has `images/STEM.png` (also jpg, bmp, webp, tif, ppm) and, for each picture,
      `labels/STEM.png` (ids of 1 to 8 bits), `distance/STEM.png` (16 bits, metres × 256; 0 is
      unknown) or `distance/STEM.npy` (floating-point metres). STEM may contain folders. All of this
      is in ROOT, or in `ROOT/train`, `ROOT/val` and `ROOT/test`. The lens of a picture is in
      `lenses/STEM.json`, or the lens of all pictures in `lens.json` beside `images/` or in ROOT.
      `lens.json` is a calibration, or a lenses.json for `darswin.data.Calibrations` with paths
      relative to its folder. Calibrations may also end in yaml, yml, xml, txt, bin or npz.
      `classes.json` beside `images/` or in ROOT names the classes;
    - WoodScape, SynWoodScape, KITTI-360, Cityscapes and COCO panoptic have the form in which their
      authors publish them. The last two need a lens, in `lens.json` in ROOT or as `lens`.

    Without a test set, "val" serves as one. Other missing splits get `holdout` of "train", chosen
    by a hash of the names; at least one scene is left to train on. `LeftOut` warnings name pictures
    that are in no split.

    Args:
        split: "all" means all scenes of a folder without splits.
        target: the target of each pixel: "labels", or "distance" along the ray.
        channels: the channels of the images, 3 or 1. None means 1 if all pictures are grey,
            otherwise 3; only the headers of some pictures are checked.
        lens, camera, coefficients: as for `darswin.data.Calibrations`, in place of the data set's
            lens. Without `lens`, `camera` and `coefficients` apply to its `lens.json`.
        classes: the names of the classes, in place of the data set's own: a text file with a name
            per line, a JSON list, or {"names": [...], "colors": [[r, g, b], ...]}.
        splits: a JSON file `{"train": [stems], "val": …, "test": …}`, or a folder of `train.txt`,
            `val.txt`, `test.txt` with one stem per line. The stems may have the pictures' suffix.
            A split without a list is held out. WoodScape and SynWoodScape also take "heal-swin".
        label_map: a JSON object that maps ids in the label files to classes, by name or by id,
            such as {"7": "road", "8": 1, "9": null}; null means unlabelled. The ids that WoodScape,
            SynWoodScape, Cityscapes or a COCO file define count as unlabelled if it leaves them
            out; any other id must be in it. Without `classes`, its names are the classes, in their
            order.
        holdout: a share, in [0, 0.5).

    Raises:
        FileNotFoundError: a missing folder, lens, label or list, or a split without scenes.
        ValueError: ambiguous or inconsistent files, and, also from `scenes[i]`, ids that no list of
            classes, label map or annotation knows. Both errors name the file.
    """
    check_split(split, get_args(ScenesSplit), holdout)
    if target not in get_args(Target):
        raise ValueError(f"target must be one of {get_args(Target)}, got {target!r}")
    check("channels", channels, channels in (1, 3, None), "1, 3 or None")
    root = Path(path)
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    options = Options(
        split, target, lens, camera, coefficients, classes, splits, label_map, holdout
    )
    for recognizes, open_split, lacks in READERS:
        if recognizes(root):
            if target in lacks:
                raise ValueError(f"{root} looks like {lacks[target]}")
            scenes = open_split(root, options)
            scenes.channels = channels or scenes.form().channels
            return scenes
    refuse_outlines(root)
    raise FileNotFoundError(f"no scenes in {root}: {FORM}")
