"""Labels: boxes, outlines, masks and keypoints, and the files of data sets."""

from pathlib import Path

from darswin.data.labels.coco import coco_files, read_coco, write_coco
from darswin.data.labels.labels import LabelledPictures, Labels, moved
from darswin.data.labels.woodscape import BOXES, has_boxes, read_woodscape_boxes
from darswin.data.labels.yolo import is_yolo, read_yolo, write_yolo
from darswin.utils.parameters import naming
from darswin.utils.text import is_json_file

__all__ = [
    "LabelledPictures",
    "Labels",
    "moved",
    "open_labels",
    "write_coco",
    "write_yolo",
]


def open_labels(path: str | Path, pictures: str | Path | None = None) -> LabelledPictures:
    """The pictures of a data set and their labels.

    Args:
        path: a COCO file or a folder with one, in it or in `annotations/`; a folder in the form of
            YOLO or its data.yaml; or a folder of WoodScape with its boxes.
        pictures: the folder of the pictures of a COCO file, if it is not one of the usual places:
            the folder of the file, `images/` beside it, or where COCO has it.

    Raises:
        FileNotFoundError: another path, or missing files.
        ValueError: wrong files, as the functions that read them say; or a folder with several COCO
            files, which are named.
    """
    root = Path(path)
    is_folder_of = [has_boxes(root), is_yolo(root)]
    files = [root] if is_json_file(root) else [] if any(is_folder_of) else coco_files(root)
    if len(files) > 1:
        listed = ", ".join(map(str, files))
        raise ValueError(f"{root} has {len(files)} files of labels: give one of them, {listed}")
    if files:
        return read_coco(files[0], pictures)
    if pictures is not None:
        text = f"`pictures` goes with a COCO file, but {root} is none"
        raise naming(ValueError(text), "pictures")
    for is_one, read in zip(is_folder_of, (read_woodscape_boxes, read_yolo), strict=True):
        if is_one:
            return read(root)
    raise FileNotFoundError(
        f"no labels in {root}: give a COCO file, instances.json; or a folder with data.yaml, as "
        f"YOLO has; or with rgb_images/ and {BOXES}/, as WoodScape has"
    )
