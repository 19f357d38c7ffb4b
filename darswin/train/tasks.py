"""The tasks of runs, by their names on the command line."""

from typing import NamedTuple

from darswin.train.classification import Classification
from darswin.train.data import RunData, WideAngleData
from darswin.train.distance import Distance, DistanceData
from darswin.train.segmentation import LabelData, Segmentation
from darswin.train.task import TaskModule
from darswin.utils.tasks import Task


class Kind(NamedTuple):
    """The Lightning module of a task, and its data."""

    module: type[TaskModule]
    data: type[RunData]


TASKS: dict[Task, Kind] = {
    "classification": Kind(Classification, WideAngleData),
    "segmentation": Kind(Segmentation, LabelData),
    "distance": Kind(Distance, DistanceData),
}
