"""KITTI-360's two fisheye cameras, with distances.

Read: `data_2d_raw/DRIVE/image_02/data_rgb/` and `image_03`, `calibration/image_02.yaml` and
`image_03.yaml`. The data set itself has no distances for each pixel: they are looked for in
`distance/DRIVE/image_02/STEM.png` (16 bits, metres × 256) or `STEM.npy` (metres) and `image_03`, as
projected LiDAR gives them, along the ray. Frames without are left out.

A stem is "DRIVE/image_02/NNNNNNNNNN". Whole drives are held out.

Source: Liao et al., KITTI-360, PAMI 2022.
"""

from pathlib import Path

from darswin.data.calibrations import Calibrations, PictureLenses
from darswin.data.scenes.files import Pairs, pair, stems
from darswin.data.scenes.lenses import OwnLenses
from darswin.data.scenes.options import Options
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import DISTANCE_SUFFIXES

CAMERAS = ("image_02", "image_03")


def fits(root: Path) -> bool:
    """Whether a folder holds KITTI-360's pictures."""
    return (root / "data_2d_raw").is_dir()


def open_split(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    if options.target != "distance":
        raise ValueError(f"{root} is of KITTI-360's form, whose fisheye pictures have no labels")
    pictures: dict[str, str] = {}
    for folder in sorted((root / "data_2d_raw").glob("*/image_0[23]/data_rgb")):
        drive, camera = folder.parts[-3:-1]
        for stem, file in stems(folder, (".png",)).items():
            pictures[f"{drive}/{camera}/{stem}"] = file
    if not pictures:
        raise FileNotFoundError(f"no pictures in {root}/data_2d_raw/*/image_0[23]/data_rgb")
    choice = options.choice(root, group=drive_of)
    distances = stems(root / "distance", DISTANCE_SUFFIXES)
    pairs = pair(pictures, distances, choice, root=root, what="distance", strict=False)
    return Scenes(
        root,
        list(pairs.values()),
        _lenses(root, pairs, options),
        target="distance",
        channels=options.channels,
        views=[camera_of(stem) for stem in pairs],
    )


def drive_of(stem: str) -> str:
    """The drive of a stem."""
    return stem.split("/")[0]


def camera_of(stem: str) -> str:
    """The camera of a stem."""
    return stem.split("/")[1]


def _lenses(root: Path, pairs: Pairs, options: Options) -> PictureLenses:
    if options.lens is not None:
        return Calibrations(options.lens, root, options.camera, options.coefficients)
    files = {
        root / picture: root / "calibration" / f"{camera_of(stem)}.yaml"
        for stem, (picture, _) in pairs.items()
    }
    if missing := sorted({str(file) for file in files.values() if not file.is_file()}):
        raise FileNotFoundError(f"no {missing[0]}: add it, or give the lens")
    return OwnLenses(files)
