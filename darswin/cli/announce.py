"""What `fit` says before and after a training: its size, its end, and what is next."""

import shlex
import sys
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.utilities import rank_zero_only

from darswin.train.runs import BestCheckpoint
from darswin.train.task import TaskModule
from darswin.utils.words import counted

# Fewer steps do not teach a new model anything: AdamW moves a weight by about the learning rate in
# each, so weights of about 0.02 need some tens of steps of 1e-3, and the cosine shrinks the last.
FEW_STEPS = 100


@rank_zero_only
def say(text: str) -> None:
    """Prints a line on stderr, in the first process alone."""
    print(text, file=sys.stderr)


class Announce(Callback):
    """Says how large a training is once it begins, and warns if its schedule has too few steps."""

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert isinstance(pl_module, TaskModule)
        if not trainer.is_global_zero:
            return  # only the first process has checked the files
        parameters = sum(p.numel() for p in pl_module.net.parameters())
        name, loaders = pl_module.card.model, trainer.val_dataloaders
        left_out = pl_module.data.left_out
        pictures: Any = trainer.train_dataloader
        count = len(pictures.dataset) - left_out["train"]
        held = f" and {len(loaders.dataset) - left_out['val']} validation" if loaders else ""
        say(
            f"{name} with {parameters:,} parameters; {count:,} training{held} pictures; "
            f"{counted(pl_module.steps_per_epoch, 'step')} an epoch, {pl_module.steps:,} in all"
        )
        if pl_module.weights is None and trainer.global_step == 0:
            for line in shortfalls(pl_module):
                say(f"darswin: {line}")


class EpochLines(Callback):
    """Prints a line with the scores of each epoch, for logs, where a progress bar fills pages."""

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        scores = trainer.progress_bar_metrics.items()
        shown = ", ".join(f"{name} {value:.4g}" for name, value in scores)
        say(f"epoch {trainer.current_epoch + 1}, step {trainer.global_step}: {shown}")


def shortfalls(task: TaskModule) -> list[str]:
    """What is wrong with the number of steps: fewer than `FEW_STEPS`, or half of them warm-up."""
    steps, found = task.steps, []
    if steps < FEW_STEPS:
        found.append(
            f"{counted(steps, 'step')} cannot teach a new model, which takes {FEW_STEPS} at least: "
            "take a smaller --data.batch_size, more --trainer.max_epochs, or --model.weights of a "
            "trained model; for classification, --config few has small batches and 40 epochs"
        )
    warmup = task.warmup_epochs * task.steps_per_epoch
    if 2 * warmup > steps:
        found.append(
            f"the learning rate rises during {min(warmup, steps):g} of {counted(steps, 'step')}: "
            "take a smaller --model.warmup_epochs"
        )
    return found


def how_to_resume(folder: Path) -> str:
    """The command that continues a run."""
    return f"darswin fit --run {shlex.quote(str(folder))} --resume"


def say_stopped(trainer: Trainer, folder: Path) -> None:
    """Says where a training stopped, and how it goes on."""
    timers = [callback for callback in trainer.callbacks if isinstance(callback, Timer)]  # type: ignore[attr-defined]
    used_up = any((left := timer.time_remaining()) is not None and left <= 0 for timer in timers)
    more = " with a longer --trainer.max_time" if used_up else ""
    again = f"`{how_to_resume(folder)}`{more}"
    say(f"stopped at step {trainer.global_step}: {again} goes on from the last checkpoint")


def say_the_end(trainer: Trainer, folder: Path) -> None:
    """Says that a training has ended, its best score, and what to type next."""
    (best,) = (c for c in trainer.callbacks if isinstance(c, BestCheckpoint))  # type: ignore[attr-defined]
    score = best.best_model_score
    found = "no validation" if score is None else f"best {best.monitor} {score.item():.4g}"
    say(
        f"finished at step {trainer.global_step}, {found}; next: `darswin test --run "
        f"{shlex.quote(str(folder))}`, or `{how_to_resume(folder)}` with more --trainer.max_epochs "
        "or --trainer.max_steps"
    )
