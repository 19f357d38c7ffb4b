"""The tasks that a run may have, by their names on the command line."""

from typing import NamedTuple

from darswin.models.saving import Task as TaskName
from darswin.train.classification import Classification
from darswin.train.data import RunData
from darswin.train.task import Task
from darswin.train.wide_angle import WideAngleData


class Kind(NamedTuple):
    """The classes of a task: the module that Lightning trains, and its data."""

    module: type[Task]
    data: type[RunData]


TASKS: dict[TaskName, Kind] = {
    "classification": Kind(Classification, WideAngleData),
}
