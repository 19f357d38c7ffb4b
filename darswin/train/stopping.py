"""Ctrl-C and SIGTERM: training stops after a whole step, with a checkpoint to resume from."""

import os
import signal
import threading
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from darswin.train.checkpoints import ends_step

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Within it, Ctrl-C and SIGTERM raise KeyboardInterrupt; while `patient`, only the second does.

    Attributes:
        number: of the last signal, None before the first.
        patient: whether the program itself looks at `number`, and stops when it can.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.patient = False

    def __enter__(self) -> "StopSignals":
        self._before = {number: signal.getsignal(number) for number in _SIGNALS}
        self.listen()
        return self

    def __exit__(self, *error: Any) -> None:
        for number, handler in self._before.items():
            _handle(number, handler)

    def listen(self) -> None:
        """Installs the handlers, in place of any that were installed since."""
        for number in _SIGNALS:
            _handle(number, self._received)

    def _received(self, number: int, frame: Any) -> None:
        first, self.number = self.number is None, number
        if not (first and self.patient):
            raise KeyboardInterrupt
        # print() fails in a handler that interrupts a print().
        os.write(2, b"\nstopping at the end of this step; a second signal stops at once\n")


def _handle(number: int, handler: Any) -> None:
    if threading.current_thread() is threading.main_thread():  # Python allows it in no other thread
        signal.signal(number, handler)


def ignore_signals(worker: int) -> None:
    """Called in the worker processes of a DataLoader: the training process ends them itself."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


class StopWhenTold(Callback):
    """Once any process of a run is told to stop, all stop after the same step, with a checkpoint.

    After an epoch's last step they validate first; the checkpoint is then the epoch's own.
    """

    def __init__(self, signals: StopSignals, checkpoint: Path):
        self.signals, self.checkpoint = signals, checkpoint

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """From here on the run stops by itself: the first signal only tells it to."""
        self.signals.listen()  # Lightning has just installed its own for SIGTERM
        self.signals.patient = True

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Saves a checkpoint and ends the process after a step in which it was told to stop."""
        if ends_step(trainer, batch_idx) and not trainer.is_last_batch and self._told(trainer):
            trainer.save_checkpoint(self.checkpoint)
            raise SystemExit

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Ends the process where an epoch's last step was the one; its checkpoint is there."""
        if trainer.global_step > 0 and self._told(trainer):
            raise SystemExit

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """A signal stops at once again."""
        self.signals.patient = False

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """A signal stops at once again."""
        self.signals.patient = False

    def _told(self, trainer: Trainer) -> bool:
        told = self.signals.number is not None
        if not trainer.strategy.reduce_boolean_decision(told, all=False):
            return False
        self.signals.number = self.signals.number or signal.SIGTERM  # another process got it
        return True
