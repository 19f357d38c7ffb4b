"""The labels of a picture, which move with it, and the pictures of a data set."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from darswin.boxes import Instances
from darswin.data.cameras import Calibrations
from darswin.utils.image import read_header
from darswin.views import Remap

Size = tuple[int, int]

# An instance of which a smaller share is visible in the new picture is left out. The share counts
# from the picture that people labelled, so it adds up over several moves.
LEAST_VISIBLE = 0.2
_FAR = 3.0  # times a side of the picture: nothing reaches that far


class Labels(NamedTuple):
    """What is labelled in one picture: a target of `darswin.data.Sample`, moved by its `through`.

    Attributes: instances; size: (H, W) of the picture; lost: the number of instances that have left
    the picture, because less than `LEAST_VISIBLE` of them, a fifth, is visible.

    The instances of files of labels have these columns in `more`: "crowd" (K,), whether it is a
    group; "visible" (K,); "mirror", K lists: of each keypoint the one that becomes it in a mirrored
    picture, none if that is not known; and "entry", K dicts: what else the file says of them.
    """

    instances: Instances
    size: Size
    lost: int = 0


def labelled(
    label: Any, box: np.ndarray, size: Size | None = None, unit: str = "pixels", *,
    outline: Sequence[np.ndarray] = (), mask: Mapping[str, Any] | None = None,
    keypoints: np.ndarray | None = None, crowd: bool = False, visible: float = 1.0,
    mirror: Sequence[int] = (), entry: Mapping[str, Any] | None = None,
) -> Instances:  # fmt: skip
    """One instance of a file of labels, K = 1; box: (4 or 5,); keypoints: (P, 3), with COCO's v.

    ValueError for another v; or, with the size of its picture, if it lies outside, or far from it:
    then its numbers are not of the unit.
    """
    if keypoints is not None:
        if not ((keypoints[:, 2] >= 0) & (keypoints[:, 2] <= 2)).all():
            raise ValueError("has keypoints whose third number, v, is not 0, 1 or 2")
        keypoints = keypoints.copy()[None]
        keypoints[keypoints[..., 2] == 0, :2] = np.nan
    is_int = isinstance(label, int) and abs(label) < 2**63
    instances = Instances(
        box[None], labels=np.array([label], int if is_int else object),
        keypoints=keypoints, masks=[mask], outlines=[outline],
        more={
            "crowd": np.array([crowd]), "visible": np.array([visible], float), "mirror": [mirror],
            "entry": [entry or {}],
        },
    )  # fmt: skip
    if size is not None:
        points = () if keypoints is None else keypoints[..., :2]
        places = np.concatenate((instances.upright.reshape(2, 2), *outline, *points)) / size[::-1]
        if not ((places[0] < 1) & (places[1] > 0)).all() or (np.abs(places) > _FAR).any():
            raise ValueError(f"must lie in its picture, with numbers that are {unit}")
    return instances


def known_keypoints(instances: Instances, row: int) -> np.ndarray:
    """The keypoints of an instance as files have them, (P, 3): 0, 0, 0 if they are unknown or not
    shown, without the rows that fill up the column."""
    if instances.keypoints is None:
        return np.zeros((0, 3))
    points = instances.keypoints[row]
    points = np.column_stack((points, np.ones(len(points))))[:, :3]
    points = points[: np.flatnonzero(~np.isnan(points[:, 2])).max(initial=-1) + 1]
    return np.where(np.isfinite(points).all(1, keepdims=True), points, 0.0)


def check_labels(instances: Instances, known: Collection[Any]) -> list[Any]:
    """The labels. ValueError for what a file cannot hold: none, one that is not `known`, NaN."""
    labels = [] if instances.labels is None else instances.labels.tolist()
    if len(labels) != len(instances):
        raise ValueError("instances need labels to be written")
    if unknown := [label for label in labels if label not in known]:
        raise ValueError(f"the label {unknown[0]!r} is that of no category")
    if np.isnan(instances.boxes).any():
        raise ValueError("a box is NaN: leave out instances that the picture does not show")
    return labels


def moved(labels: Labels, remap: Remap) -> Labels:
    """The labels of the picture that a view shows; see `Instances.through`. Those of which less
    than `LEAST_VISIBLE` is visible are left out, and counted in `lost`."""
    instances = move_instances(labels.instances, remap)
    stays = instances.more["visible"] >= LEAST_VISIBLE
    return Labels(instances[stays], remap.view_size, labels.lost + int((~stays).sum()))


def move_instances(instances: Instances, remap: Remap) -> Instances:
    """Each of the instances in the picture of a view, with what is visible of it, also if it is
    nothing. Among turned boxes, those with the angle 0 are upright, and stay so."""
    if instances.boxes.shape[1] == 5:
        is_turned = instances.boxes[:, 4] != 0
        others = instances[~is_turned]
        parts = [instances[is_turned], replace(others, boxes=others.upright)]
        new = [_move(part, remap) for part in parts]
        return Instances.joined(new)[np.argsort(np.argsort(~is_turned, kind="stable"))]
    return _move(instances, remap)


def _move(instances: Instances, remap: Remap) -> Instances:
    instances = instances.through(
        remap.to_view, remap.view_size,
        masks=lambda mask: remap.target(mask.astype(np.uint8)) == 1,
    )  # fmt: skip
    if remap.mirrored and instances.keypoints is not None:
        orders = instances.more.get("mirror", [()] * len(instances))
        for points, order in zip(instances.keypoints, orders, strict=True):
            if len(order) <= len(points):  # or the instance has no keypoints
                points[: len(order)] = points[list(order)]
    return instances


# -- data sets ----------------------------------------------------------------------------------


@dataclass
class LabelledPictures:
    """The pictures of a data set and their labels.

    Attributes:
        folder: of the pictures. files: relative to it.
        raw: of each picture, what `read(raw, size)` makes `Labels` of, and a list of what is wrong
            with the instances that it leaves out, one text each.
        categories: as COCO has them: {"id": 1, "name": "person"}, and more.
        entries: of each picture, what COCO says of it; lenses: its own, if it has any.
        wrong: what is wrong with pictures and instances that are left out, one text each.
    """

    folder: Path
    files: Sequence[str]
    raw: Sequence[Any]
    read: Callable[[Any, Size], tuple[Labels, list[str]]]
    categories: Sequence[Mapping[str, Any]]
    entries: Sequence[Mapping[str, Any]] = ()
    lenses: Calibrations | None = None
    wrong: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.files)

    def labels(self, index: int, size: Size | None = None) -> Labels:
        """The labels of a picture; size: (H, W) of the upright picture, if it is known.

        Raises:
            ValueError: an instance cannot be read.
        """
        size = size or read_header(self.folder / self.files[index]).upright
        labels, wrong = self.read(self.raw[index], size)
        if wrong:
            raise ValueError(wrong[0])
        return labels
