"""SynWoodScape: WoodScape's four cameras in a simulator, with labels of 25 classes and distances.

Read: `rgb_images/[rgb_images/]`, `semantic_annotations/[semantic_annotations/]gtLabels/`,
`depth_maps/[depth_maps/]raw_data/` and `calibration/[calibration/]`.

The depth maps are taken for metres along the ray; 1000 is the sky, whose distance is not known.

Source: Sekkat et al., SynWoodScape, RA-L 2022.
"""

from pathlib import Path

from darswin.data.scenes.classes import Classes
from darswin.data.scenes.files import stems
from darswin.data.scenes.options import Options
from darswin.data.scenes.scene import Scenes
from darswin.data.scenes.targets import LABEL_SUFFIXES
from darswin.data.scenes.woodscape import classes_of, scenes, unnested

NAMES = [
    "unlabelled", "building", "fence", "other", "pedestrian", "pole", "road line", "road",
    "sidewalk", "vegetation", "four-wheeler", "wall", "traffic sign", "sky", "ground", "bridge",
    "rail track", "guard rail", "traffic light", "water", "terrain", "two-wheeler", "static",
    "dynamic", "ego",
]  # fmt: skip
SKY = 1000.0  # m


def fits(root: Path) -> bool:
    """Whether a folder holds SynWoodScape's pictures: it has depth maps, or they are nested."""
    pictures = root / "rgb_images"
    return pictures.is_dir() and (
        (root / "depth_maps").is_dir() or (pictures / "rgb_images").is_dir()
    )


def open_split(root: Path, options: Options) -> Scenes:
    """A split; options and errors as `darswin.data.open_scenes`."""
    if options.target == "distance":
        distances = stems(unnested(root / "depth_maps") / "raw_data", (".npy",))
        return scenes(root, options, distances, Classes([], []), far=SKY)
    labels = stems(unnested(root / "semantic_annotations") / "gtLabels", LABEL_SUFFIXES)
    return scenes(root, options, labels, classes_of(root, options, NAMES))
