"""The tasks of runs, by their names on the command line."""

from typing import NamedTuple

from darswin.train.classification import Classification
from darswin.train.data import RunData, WideAngleData
from darswin.train.scene_data import DistanceData, LabelData
from darswin.train.segmentation import Distance, Segmentation
from darswin.train.task import Task
from darswin.utils.tasks import Task as TaskName

__all__ = ["TASKS"]


class Kind(NamedTuple):
    """The Lightning module of a task, and its data."""

    module: type[Task]
    data: type[RunData]


TASKS: dict[TaskName, Kind] = {
    "classification": Kind(Classification, WideAngleData),
    "segmentation": Kind(Segmentation, LabelData),
    "distance": Kind(Distance, DistanceData),
}
