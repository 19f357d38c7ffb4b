"""Cityscapes, and data sets of the same form.

The reader uses `leftImg8bit/SPLIT/CITY/STEM_leftImg8bit.png` and
`gtFine/SPLIT/CITY/STEM_gtFine_labelIds.png` of the splits "train" and "val", because the labels of
"test" are not public. The ids become the 19 classes of the benchmark; the authors' other ids count
as unlabelled.

Source: Cordts et al., Cityscapes, CVPR 2016, and github.com/mcordts/cityscapesScripts.
"""

import re
from pathlib import Path

from darswin.data.scenes.files import Options, pair, pictures_in, stems
from darswin.data.scenes.scene import Classes, Scenes
from darswin.data.splits import SPLITS, Split, some

# The id, the name and the colour of each class.
CLASSES = (
    (7, "road", [128, 64, 128]),
    (8, "sidewalk", [244, 35, 232]),
    (11, "building", [70, 70, 70]),
    (12, "wall", [102, 102, 156]),
    (13, "fence", [190, 153, 153]),
    (17, "pole", [153, 153, 153]),
    (19, "traffic light", [250, 170, 30]),
    (20, "traffic sign", [220, 220, 0]),
    (21, "vegetation", [107, 142, 35]),
    (22, "terrain", [152, 251, 152]),
    (23, "sky", [70, 130, 180]),
    (24, "person", [220, 20, 60]),
    (25, "rider", [255, 0, 0]),
    (26, "car", [0, 0, 142]),
    (27, "truck", [0, 0, 70]),
    (28, "bus", [0, 60, 100]),
    (31, "train", [0, 80, 100]),
    (32, "motorcycle", [0, 0, 230]),
    (33, "bicycle", [119, 11, 32]),
)
IDS = range(34)  # of all classes, also those that the benchmark leaves out
PICTURE, LABELS = "_leftImg8bit", "_gtFine_labelIds"


def is_cityscapes(root: Path) -> bool:
    return (root / "leftImg8bit").is_dir()


def open_cityscapes(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    folders: dict[Split, Path] = {split: root / "leftImg8bit" / split for split in SPLITS[:2]}
    part, choose = options.choose_part({s: f for s, f in folders.items() if f.is_dir()}, root)
    targets = root / "gtFine" / part
    if not targets.is_dir():
        raise FileNotFoundError(f"no folder {targets}: {folders[part]} needs its labels there")
    pairs = pair(
        _ending_in(PICTURE, pictures_in(folders[part]), folders[part]),
        _ending_in(LABELS, stems(targets, (".png",)), targets),
        choose,
        root=root,
        what="labels",
    )
    classes, read = options.labels(
        lambda: Classes([name for _, name, _ in CLASSES], [color for _, _, color in CLASSES]),
        {id_: k for k, (id_, _, _) in enumerate(CLASSES)},
        IDS,
    )
    files, lenses = list(pairs.values()), options.shared_lens(root)
    return Scenes(root, files, lenses, target="labels", classes=classes, read=read)


def _ending_in(ending: str, files: dict[str, str], folder: Path) -> dict[str, str]:
    """The files whose stems have an ending, by their stems without that ending."""
    found = {stem.removesuffix(ending): f for stem, f in files.items() if stem.endswith(ending)}
    if not found:
        # The names begin with a city, a sequence and a frame.
        others = sorted({re.sub(r".*_\d{6}_\d{6}", "", Path(stem).name) for stem in files})
        raise FileNotFoundError(
            f"{folder} must hold names that end in {ending}, but they end in {some(others)}"
        )
    return found
