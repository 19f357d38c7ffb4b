"""WoodScape and SynWoodScape, as their authors publish them: four cameras of a car.

WoodScape has labels of ten classes. The reader uses `rgb_images/`,
`semantic_annotations/[semantic_annotations/]gtLabels/`, the classes of `seg_annotation_info.json`
beside it, and `calibration/[calibration/]` or `calibration_data/calibration/`. It does not read
polygons, motion, soiling, previous images and the test set, whose labels are not public.
`darswin.data.labels` reads the boxes.

SynWoodScape has the same four cameras in a simulator, with labels of 25 classes and distances. The
reader uses `rgb_images/[rgb_images/]`, `semantic_annotations/[semantic_annotations/]gtLabels/`,
`depth_maps/[depth_maps/]raw_data/` and `calibration/[calibration/]`. It treats the depth maps as
metres along the ray; 1000 m marks the sky, whose distance is unknown.

Source: Yogamani et al., WoodScape, ICCV 2019, and github.com/valeoai/WoodScape; Sekkat et al.,
SynWoodScape, RA-L 2022.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from darswin.data.scenes.files import Options, lenses_beside, pair, pictures_in, stems
from darswin.data.scenes.scene import NO_CLASSES, Classes, Scenes, as_classes
from darswin.data.scenes.targets import read_distance
from darswin.data.splits import Split
from darswin.utils.parameters import naming
from darswin.utils.text import read_json

NAMES = ["void", "road", "lanemarks", "curb", "person", "rider", "vehicles", "bicycle",
         "motorcycle", "traffic_sign"]  # fmt: skip
SYN_NAMES = [
    "unlabelled", "building", "fence", "other", "pedestrian", "pole", "road line", "road",
    "sidewalk", "vegetation", "four-wheeler", "wall", "traffic sign", "sky", "ground", "bridge",
    "rail track", "guard rail", "traffic light", "water", "terrain", "two-wheeler", "static",
    "dynamic", "ego",
]  # fmt: skip
INFO = "seg_annotation_info.json"
# The number of green rows at the top and at the bottom, and the height of such a picture.
GREEN = (3, 966)
SKY = 1000.0  # m


def is_woodscape(root: Path) -> bool:
    beside = ("semantic_annotations", "calibration", "calibration_data")
    return (root / "rgb_images").is_dir() and any((root / name).is_dir() for name in beside)


def is_synwoodscape(root: Path) -> bool:
    """True for a folder that has depth maps, or nested pictures."""
    pictures = root / "rgb_images"
    return pictures.is_dir() and (
        (root / "depth_maps").is_dir() or (pictures / "rgb_images").is_dir()
    )


def open_woodscape(
    root: Path, options: Options, names: list[str] = NAMES, trim: tuple[int, int] = GREEN
) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    target = options.target
    if target == "labels":
        targets = stems(unnested(root / "semantic_annotations") / "gtLabels", (".png",))
        classes, read = options.labels(partial(_classes, root, names), ids=range(len(names)))
    else:
        targets = stems(unnested(root / "depth_maps") / "raw_data", (".npy",))
        classes, read = NO_CLASSES, partial(read_distance, far=SKY)
    pairs = pair(
        pictures_in(unnested(root / "rgb_images")),
        targets,
        lambda found: options.choose(found, root, named={"heal-swin": heal_swin}),
        root=root,
        what=target,
    )
    lenses = options.given_lens(root) or lenses_beside(
        options, root, pairs, calibration_files(root)
    )
    return Scenes(
        root, list(pairs.values()), lenses, target=target, classes=classes,
        views=[_view_of(stem) for stem in pairs], read=read, trim=trim,
    )  # fmt: skip


open_synwoodscape = partial(open_woodscape, names=SYN_NAMES, trim=(0, 1))


def heal_swin(stems: list[str]) -> dict[Split, list[str]]:
    """The split of HEAL-SWIN: four fifths of the stems for training, the others for "val".

    Source: Carlsson et al., HEAL-SWIN, 2024. Its loader permutes the sorted stems by NumPy's
    RandomState(42) and uses the first ⌊0.8 N⌋ + 1 for training.
    """
    # NumPy keeps the permutations of this generator.
    order = np.random.RandomState(42).permutation(len(stems))
    count = int(0.8 * len(stems)) + 1
    shuffled = [stems[k] for k in order]
    return {"train": shuffled[:count], "val": shuffled[count:]}


def _view_of(stem: str) -> str:
    """The camera in NNNNN_VIEW: FV, RV, MVL or MVR."""
    return stem.rsplit("_", 1)[-1]


def unnested(folder: Path) -> Path:
    """The folder, or a folder of the same name in it, because some archives unpack so."""
    inner = folder / folder.name
    return inner if inner.is_dir() else folder


def _classes(root: Path, published: list[str]) -> Classes:
    """The classes in the data set's file, or as published."""
    folder = root / "semantic_annotations"
    for place in (folder, folder / folder.name, root):
        if (place / INFO).is_file():
            return _info(place / INFO)
    return Classes(published, [])


def _info(file: Path) -> Classes:
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
    step = -1 if str(content.get("color_scheme")).lower() == "bgr" else 1
    colors = [classes.colors[k][::step] for k in order] if classes.colors else []
    return Classes([classes.names[k] for k in order], colors)


def calibration_files(root: Path) -> Callable[[str], str]:
    """A function from the stem of a picture to its calibration, or else that of its camera."""
    places = unnested(root / "calibration"), root / "calibration_data" / "calibration"
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        text = f"no folder {places[0]} or {places[1]}: give `lens`"
        raise naming(FileNotFoundError(text), "lens")
    found = stems(folder, (".json",))

    def calibration_of(stem: str) -> str:
        return found.get(stem) or found.get(_view_of(stem)) or f"{folder / stem}.json"

    return calibration_of
