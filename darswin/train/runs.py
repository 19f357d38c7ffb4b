"""Runs: their checkpoints, their stop on a signal, and the options that may change on resume."""

import io
import os
import signal
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from darswin.models.saving import ModelCard, save_model
from darswin.utils.files import replace_file
from darswin.utils.parameters import naming
from darswin.utils.unpickle import read_pickle

# -- checkpoints ------------------------------------------------------------------------------


class BestCheckpoint(ModelCheckpoint):
    """The checkpoint with the best score, in the folder of a run, which may be moved."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        folder = Path(self.dirpath or "")

        def here(path: str) -> str:
            return str(folder / Path(path).name) if path else path

        state = dict(state_dict, dirpath=self.dirpath)
        for key in ("best_model_path", "kth_best_model_path", "last_model_path"):
            state[key] = here(state[key])
        state["best_k_models"] = {here(path): k for path, k in state["best_k_models"].items()}
        super().load_state_dict(state)


class LastCheckpoint(Checkpoint):
    """Writes the last checkpoint: every `every` steps, after each epoch, and where a run stops.

    A resumed run goes on from it as an uninterrupted one does. So a run stops only after a whole
    step, because checkpoints do not hold gradients between the batches of an accumulated step. The
    checkpoint comes after the validation that belongs to its step, if there is one, because a
    resumed run does not make up for it. A stop amid an epoch adds no validation, and its checkpoint
    does not count the epoch as done.

    A stop by steps, by a time limit, by a signal or by early stopping is the same here: it ends
    the steps of the run.
    """

    def __init__(self, file: Path, every: int):
        self.file, self.every = file, every
        self._stop = False  # wanted by another callback, after the next whole step

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # If Lightning restores a checkpoint while it knows a limit of steps, it takes the epoch
        # that follows for one that it has trained.
        self._max_steps, trainer.fit_loop.epoch_loop.max_steps = trainer.max_steps, -1

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        trainer.fit_loop.epoch_loop.max_steps = self._max_steps

    def on_train_batch_end(self, trainer: Trainer, *batch: Any) -> None:
        # Lightning would stop amid an accumulated step, and validate before that.
        self._stop, trainer.should_stop = self._stop or trainer.should_stop, False
        loop = trainer.fit_loop
        if not loop.epoch_loop._should_check_val_fx(loop._data_fetcher):  # type: ignore[arg-type]
            self._end_batch(trainer, batch[-1])

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not (trainer.is_last_batch or trainer.sanity_checking):
            self._stop, trainer.should_stop = self._stop or trainer.should_stop, False
            self._end_batch(trainer, trainer.fit_loop.batch_idx)

    def _end_batch(self, trainer: Trainer, batch_idx: int) -> None:
        if ends_step_amid_epoch(trainer, batch_idx):
            if self._stop and _reached_least(trainer):
                stop_after_step(trainer)
            stops = trainer.global_step >= trainer.max_steps > -1
            if stops or trainer.global_step % self.every == 0:
                self._save(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.is_last_batch:  # otherwise the run stops amid the epoch
            trainer.should_stop = trainer.should_stop or self._stop
            self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        if not trainer.fast_dev_run:  # type: ignore[attr-defined]  # Lightning adds it as it runs
            trainer.save_checkpoint(self.file)


def ends_step_amid_epoch(trainer: Trainer, batch_idx: int) -> bool:
    """True if the optimiser stepped on this batch and the epoch goes on."""
    steps = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
    return steps and not trainer.is_last_batch


def stop_after_step(trainer: Trainer) -> None:
    """Makes the step that has just ended the last one of this call."""
    trainer.fit_loop.epoch_loop.max_steps = trainer.global_step


def _reached_least(trainer: Trainer) -> bool:
    """True amid an epoch if `min_steps` and `min_epochs` allow a stop."""
    steps, epochs = trainer.min_steps or 0, trainer.min_epochs or 0
    return trainer.global_step >= steps and trainer.current_epoch >= epochs


class SafeCheckpointIO(TorchCheckpointIO):
    """Replaces checkpoints atomically, writes the weights as safetensors beside them, and reads
    checkpoints without executing code in them."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        replace_file(path, content.getbuffer())
        weights = {
            name.removeprefix("net."): tensor
            for name, tensor in checkpoint["state_dict"].items()
            if name.startswith("net.")
        }
        file = Path(path).with_suffix(".safetensors")
        save_model(file, weights, ModelCard(**checkpoint["darswin"]))

    def remove_checkpoint(self, path: str | Path) -> None:
        super().remove_checkpoint(path)
        Path(path).with_suffix(".safetensors").unlink(missing_ok=True)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> dict[str, Any]:
        if not Path(path).is_file():
            raise FileNotFoundError(f"no checkpoint {path}")
        try:
            checkpoint = read_pickle(path, map_location)
        except ValueError as error:
            others = sorted(set(Path(path).parent.glob("*.ckpt")) - {Path(path)})
            hint = f"; `ckpt_path` {others[0]} starts from the other one" if others else ""
            raise naming(ValueError(f"{error}{hint}"), "ckpt_path") from error
        if not isinstance(checkpoint, dict) or "darswin" not in checkpoint:
            raise ValueError(f"{path} is not a checkpoint of `darswin fit`: it names no model")
        return checkpoint


# -- Ctrl-C and SIGTERM: training stops after a whole step, with a checkpoint -----------------

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopOnSignals(Callback):
    """A context in which Ctrl-C and SIGTERM stop a run.

    While a run trains, the first signal to any process makes all processes stop after the same
    step. A second signal, or a signal at another time, raises KeyboardInterrupt. After the last
    step of an epoch, the run validates before it stops.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._trains = False

    def __enter__(self) -> "StopOnSignals":
        self._before = {number: signal.getsignal(number) for number in _SIGNALS}
        self._handle(dict.fromkeys(_SIGNALS, self._received))
        return self

    def __exit__(self, *error: Any) -> None:
        self._handle(self._before)

    def _handle(self, handlers: Mapping[Any, Any]) -> None:
        for number, handler in handlers.items():
            # Python allows handlers only in this thread.
            if threading.current_thread() is threading.main_thread():
                signal.signal(number, handler)

    def _received(self, number: int, frame: Any) -> None:
        first, self.number = self.number is None, number
        if not (first and self._trains):
            raise KeyboardInterrupt
        # print() fails in a handler that interrupts a print().
        os.write(2, b"\nstopping at the end of this step; a second signal stops at once\n")

    def on_train_start(self, *run: Any) -> None:
        # Lightning has just installed its own handler for SIGTERM.
        self._handle(dict.fromkeys(_SIGNALS, self._received))
        self._trains = True

    def on_train_batch_end(self, trainer: Trainer, *batch: Any) -> None:
        if ends_step_amid_epoch(trainer, batch[-1]) and self._any_signal(trainer):
            stop_after_step(trainer)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._any_signal(trainer):
            stop_after_step(trainer)

    def on_train_end(self, *run: Any) -> None:
        self._trains = False

    def on_exception(self, *run: Any) -> None:
        self._trains = False

    def _any_signal(self, trainer: Trainer) -> bool:
        here = self.number is not None
        if not trainer.strategy.reduce_boolean_decision(here, all=False):
            return False
        self.number = self.number or signal.SIGTERM  # another process got it
        return True


def start_worker(worker: int) -> None:
    """Prepares a worker of a DataLoader. It ignores signals, because the training process ends its
    workers; if that process is killed, it says nothing of the lost connection. It takes only time
    that training leaves, because each of torch's operators waits for its slowest thread."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.excepthook = _say_no_lost_connection
    if hasattr(os, "nice"):
        os.nice(19)


def _say_no_lost_connection(error: Any) -> None:
    if not issubclass(error.exc_type, ConnectionError | EOFError):
        threading.__excepthook__(error)


# -- options that change when a run goes on ---------------------------------------------------

# A change takes effect at the checkpoint, and is said. These options may not change: they decide on
# the network, the groups of its parameters, its images, the size of a step, or which pictures and
# labels count. So that nobody forgets to list an option that matters, a test has a table of all
# options, and fails for an option that is not in it.
FIXED = {
    *("task", "seed_everything", "trainer.accumulate_grad_batches"),
    *("model.name", "model.options", "model.weights", "model.freeze_stages"),
    *("model.decay_position_bias", "model.ignore_index"),
    *("data.size", "data.channels", "data.mean", "data.std", "data.fov_deg"),
    *("data.limit", "data.holdout"),
}


def check_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, str]:
    """Each option that changes on resume, and its change in words; ValueError for options that
    cannot change."""
    before, now = _options(before), _options(now)
    changes = {
        name: f"{now[name]!r} in place of {before.get(name)!r}"
        for name in now
        if now[name] != before.get(name)
    }
    if refused := [name for name in changes if name in FIXED]:
        each = "; ".join(f"`{name}` {changes[name]}" for name in refused)
        text = f"a resumed run cannot change these options: {each}"
        raise naming(ValueError(text), *refused)
    return changes


def _options(config: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a configuration by their qualified names."""
    found: dict[str, Any] = {}
    for group, value in config.items():
        if group in ("model", "data", "trainer"):
            found |= {f"{group}.{name}": own for name, own in value.items()}
        elif group != "run":  # the folder may have moved
            found[group] = value
    return found
