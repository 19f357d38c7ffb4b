"""Looks through the targets of a training's first epoch for what nothing can be learned from."""

from typing import Protocol

import torch
from lightning.pytorch import Trainer
from torch import Tensor

from darswin.data.scenes.scene import IGNORE

_EARLY = 100  # batches: a training does not go on for longer without any target


class Checked(Protocol):
    """What `TargetCheck` needs of a task."""

    trainer: Trainer

    @property
    def global_rank(self) -> int:
        """The number of this process in the run."""

    def _known(self, target: Tensor) -> Tensor: ...

    def _missing(self, there: list[bool], images: str, whole: bool) -> None: ...


class TargetCheck:
    """Notes which classes occur in the targets of the first whole epoch that a process trains.

    A task's `_missing` is told at the epoch's end; earlier, if the epoch is long or the training
    ends. A device is waited for only then.
    """

    def __init__(self) -> None:
        self._there: Tensor | None = None  # (256,), of each id and of unknown pixels
        self._images = 0

    def add(self, task: Checked, target: Tensor, batch_idx: int) -> None:
        """Looks at a batch's targets, (B, H, W)."""
        if batch_idx == 0 and self._images == 0:
            self._there = torch.zeros(IGNORE + 1, dtype=torch.bool, device=target.device)
        if self._there is None:  # a resumed run is amid an epoch, or the first one is over
            return
        ids = torch.zeros_like(target, dtype=torch.int64) if target.is_floating_point() else target
        self._there.scatter_(0, torch.where(task._known(target), ids, IGNORE).flatten(), True)
        self._images += len(target) * task.trainer.world_size
        whole = task.trainer.is_last_batch
        if whole or batch_idx + 1 == _EARLY:
            self._tell(task, whole)
        if whole:
            self._there = None

    def end(self, task: Checked) -> None:
        """The training is over."""
        if self._there is not None:
            self._tell(task, False)

    def _tell(self, task: Checked, whole: bool) -> None:
        assert self._there is not None
        there = task.trainer.strategy.reduce(self._there.int(), reduce_op="sum")
        assert isinstance(there, Tensor)
        try:
            task._missing(there[:IGNORE].bool().tolist(), f"{self._images} training images", whole)
        except ValueError:
            if task.global_rank:  # the first process says it; Lightning kills it if this one fails
                raise SystemExit from None
            raise
