"""KITTI-360's two fisheye cameras, with distances.

The reader uses `data_2d_raw/DRIVE/image_02/data_rgb/` with `calibration/image_02.yaml`, and the
same for `image_03`. The data set has no distances for each pixel. Put distances along the ray, for
example from projected LiDAR, into `distance/DRIVE/image_02/STEM.png` (16 bits, metres × 256) or
`STEM.npy` (metres). Frames without distances are left out.

A stem is "DRIVE/image_02/NNNNNNNNNN". Whole drives are held out.

Source: Liao et al., KITTI-360, PAMI 2022.
"""

from pathlib import Path

from darswin.data.scenes.files import Options, lenses_beside, pair, stems
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import KINDS


def is_kitti360(root: Path) -> bool:
    return (root / "data_2d_raw").is_dir()


def open_kitti360(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    pictures: dict[str, str] = {}
    for folder in sorted((root / "data_2d_raw").glob("*/image_0[23]/data_rgb")):
        drive, camera = folder.parts[-3:-1]
        for stem, file in stems(folder, (".png",)).items():
            pictures[f"{drive}/{camera}/{stem}"] = file
    if not pictures:
        raise FileNotFoundError(f"no pictures in {root}/data_2d_raw/*/image_0[23]/data_rgb")
    pairs = pair(
        pictures,
        stems(root / "distance", KINDS["distance"].suffixes),
        lambda found: options.choose(found, root, group=lambda stem: stem.split("/")[0]),
        root=root,
        what="distance",
        strict=False,
    )
    views = {stem: stem.split("/")[1] for stem in pairs}
    lenses = options.given_lens(root) or lenses_beside(
        options, root, pairs, lambda stem: root / "calibration" / f"{views[stem]}.yaml"
    )
    files = list(pairs.values())
    return Scenes(root, files, lenses, target="distance", views=list(views.values()))
