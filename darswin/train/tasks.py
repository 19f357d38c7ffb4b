"""The tasks that a run may have, by their names on the command line."""

from typing import NamedTuple

from darswin.models.saving import Task as TaskName
from darswin.train.classification import Classification
from darswin.train.data import RunData
from darswin.train.dense_data import DistanceData, LabelData
from darswin.train.dense_results import WriteDenseResults
from darswin.train.distance import Distance
from darswin.train.results import WriteResults
from darswin.train.segmentation import Segmentation
from darswin.train.task import Task
from darswin.train.wide_angle import WideAngleData


class Kind(NamedTuple):
    """The classes of a task: the module that Lightning trains, its data, and what writes down the
    results of a test."""

    module: type[Task]
    data: type[RunData]
    write: type[WriteResults] | type[WriteDenseResults]


TASKS: dict[TaskName, Kind] = {
    "classification": Kind(Classification, WideAngleData, WriteResults),
    "segmentation": Kind(Segmentation, LabelData, WriteDenseResults),
    "distance": Kind(Distance, DistanceData, WriteDenseResults),
}
