"""WoodScape, as its authors publish it: labels of ten classes, four cameras of a car.

Read: `rgb_images/`, `semantic_annotations/[semantic_annotations/]gtLabels/`, the classes of
`seg_annotation_info.json` beside it, and `calibration/[calibration/]` or
`calibration_data/calibration/`. All else is left alone: boxes, polygons, motion, soiling, previous
images, and the test set, whose labels are withheld.

Source: Yogamani et al., WoodScape, ICCV 2019, and github.com/valeoai/WoodScape.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from darswin.data.calibrations import Calibrations, PictureLenses
from darswin.data.scenes.classes import Classes, as_classes, read_palette
from darswin.data.scenes.files import Pairs, pair, pictures_in, stems
from darswin.data.scenes.lenses import OwnLenses
from darswin.data.scenes.options import Options
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import LABEL_SUFFIXES
from darswin.data.splits import Split, read_json

NAMES = ["void", "road", "lanemarks", "curb", "person", "rider", "vehicles", "bicycle",
         "motorcycle", "traffic_sign"]  # fmt: skip
INFO = "seg_annotation_info.json"
# Rows at the top and at the bottom that are green, of a picture so high.
GREEN = (3, 966)


def fits(root: Path) -> bool:
    """Whether a folder holds WoodScape's pictures and labels, or calibrations."""
    beside = ("semantic_annotations", "calibration", "calibration_data")
    return (root / "rgb_images").is_dir() and any((root / name).is_dir() for name in beside)


def open_split(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    if options.target != "labels":
        raise ValueError(f"{root} is of WoodScape's form, which has labels, no distances")
    annotations = unnested(root / "semantic_annotations")
    targets = stems(annotations / "gtLabels", LABEL_SUFFIXES)
    classes = classes_of(root, options, NAMES)
    return scenes(root, options, targets, classes, trim=GREEN)


def scenes(
    root: Path,
    options: Options,
    targets: dict[str, str],
    classes: Classes,
    *,
    trim: tuple[int, int] = (0, 1),
    far: float | None = None,
) -> Scenes:
    """Scenes in `rgb_images/` with these targets and calibrations named after them."""
    choice = options.choice(root, named={"heal-swin": heal_swin})
    pictures = pictures_in(unnested(root / "rgb_images"))
    pairs = pair(pictures, targets, choice, root=root, what=options.target)
    return Scenes(
        root,
        list(pairs.values()),
        _lenses(root, pairs, options),
        target=options.target,
        channels=options.channels,
        classes=classes.names,
        colors=classes.colors,
        views=[view_of(stem) for stem in pairs],
        trim=trim,
        far=far,
    )


def heal_swin(stems: list[str]) -> dict[Split, list[str]]:
    """HEAL-SWIN's split, of all stems: four fifths to train on, the others for "val".

    Source: Carlsson et al., HEAL-SWIN, 2024: its loader takes the sorted stems in the order of a
    permutation by NumPy's RandomState(42), the first ⌊0.8 N⌋ + 1 for training.
    """
    # The generator of the source, whose permutations NumPy keeps.
    order = np.random.RandomState(42).permutation(len(stems))
    count = int(0.8 * len(stems)) + 1
    shuffled = [stems[k] for k in order]
    return {"train": shuffled[:count], "val": shuffled[count:]}


def view_of(stem: str) -> str:
    """The camera of NNNNN_VIEW: FV, RV, MVL or MVR."""
    return stem.rsplit("_", 1)[-1]


def unnested(folder: Path) -> Path:
    """A folder; or the one of its name in it, as some archives unpack."""
    inner = folder / folder.name
    return inner if inner.is_dir() else folder


def classes_of(root: Path, options: Options, published: list[str]) -> Classes:
    """Those given, of the data set's own file, or as published."""
    if options.classes is not None:
        return read_palette(options.classes)
    folder = root / "semantic_annotations"
    for place in (folder, folder / folder.name, root):
        if (place / INFO).is_file():
            return _info(place / INFO)
    return Classes(published, [])


def _info(file: Path) -> Classes:
    """Names and colours in the order of their ids."""
    content = read_json(file)
    if not isinstance(content, Mapping):
        raise ValueError(f"{file} must be a JSON object with class_names")
    classes = as_classes(content.get("class_names"), content.get("class_colors", []), file)
    ids = content.get("class_indexes", list(range(len(classes.names))))
    if not isinstance(ids, list) or sorted(ids) != list(range(len(classes.names))):
        raise ValueError(
            f"{file}: class_indexes must be the ids 0 to {len(classes.names) - 1}, got {ids!r}"
        )
    order = sorted(range(len(ids)), key=ids.__getitem__)
    turn = -1 if str(content.get("color_scheme")).lower() == "bgr" else 1
    colors = [classes.colors[k][::turn] for k in order] if classes.colors else []
    return Classes([classes.names[k] for k in order], colors)


def _lenses(root: Path, pairs: Pairs, options: Options) -> PictureLenses:
    """The calibrations of the pictures, by their names, or else by their cameras'."""
    if options.lens is not None:
        return Calibrations(options.lens, root, options.camera, options.coefficients)
    places = unnested(root / "calibration"), root / "calibration_data" / "calibration"
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        raise FileNotFoundError(f"no folder {places[0]} or {places[1]}: give the lens")
    found = stems(folder, (".json",))
    files = {}
    for stem, (picture, _) in pairs.items():
        file = found.get(stem) or found.get(view_of(stem))
        if file is None:
            raise FileNotFoundError(
                f"no lens for {root / picture}: add {folder / stem}.json, or give the lens"
            )
        files[root / picture] = Path(file)
    return OwnLenses(files)
