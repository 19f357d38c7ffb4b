"""The base of the tasks: the model, its weights, its optimiser and the training steps."""

import math
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.plugins import MixedPrecision
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from matplotlib.figure import Figure
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from darswin.lens import Lens
from darswin.models.encoder import Encoder
from darswin.models.pixel import PixelModel
from darswin.models.registry import has_image_size
from darswin.models.saving import ModelCard, read_card
from darswin.ops.checks import readable
from darswin.train.finetuning import (
    check_name,
    frozen_parts,
    name_from,
    own_options,
    start_from,
    weights_file,
)
from darswin.utils.parameters import check, naming
from darswin.utils.tasks import Task

Batch = tuple[Tensor, Lens, Tensor]


class TaskModule(LightningModule):
    """Base of the tasks: a model of wide-angle images, its optimiser and its steps.

    Subclasses define `_head_options`, `_make_metrics`, `_loss`, `results_figure` and the steps of
    validation and test. After a test, `results` has a row for each test set.

    The learning rates are for `reference_batch` images per step. They grow in proportion to the
    batch.

    Args:
        name: the model; None is the model of `weights`, or the task's default.
        options: options of the model. With `weights`, the model keeps its own options.
        weights: a trained model to start from: the folder of a run, whose best model is taken, or a
            safetensors file. The new run takes its name, options, channels, mean and std from it,
            and its size unless data.size gives another one that the model accepts. The head is
            kept for the same classes in the same order; otherwise a new one is made. A resumed run
            does not read the file again.
        freeze_stages: keeps the patch embedding and this number of first stages of `weights` as
            they are, without drop path and jitter. If all stages are frozen, only the head is
            trained.
        learning_rate: the peak of the learning rate.
        warmup_rate: the learning rate at the start.
        final_rate: the learning rate at the end.
        warmup_epochs: epochs of linear warm-up; may be a fraction.
        weight_decay: the weight decay of AdamW.
        decay_position_bias: decays position biases too, as the authors' code does.
        reference_batch: images per step for which the learning rates are meant.
        grad_checkpointing: saves a third of the memory for activations and costs a few percent of
            the time.
        seed: seeds the weights, the jitter, drop path and mixing.
    """

    task: ClassVar[Task]
    default_model: ClassVar[str]
    monitor: ClassVar[tuple[str, Literal["min", "max"]]]  # the score of the best checkpoint
    results: list[dict[str, Any]]
    net: Encoder | PixelModel  # made by `configure_model`, like `card`
    steps: int  # of the whole training, made by `configure_optimizers`
    card: ModelCard
    trained: ModelCard  # the card of the checkpoint that was read, or else `card`

    def __init__(
        self,
        name: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        weights: str | None = None,
        freeze_stages: int = 0,
        learning_rate: float = 5e-4,
        warmup_rate: float = 5e-7,
        final_rate: float = 5e-6,
        warmup_epochs: float = 20,
        weight_decay: float = 0.05,
        decay_position_bias: bool = False,
        reference_batch: int = 512,
        grad_checkpointing: bool = False,
        seed: int = 0,
    ):
        super().__init__()
        if freeze_stages and weights is None:
            text = f"`freeze_stages` {freeze_stages} needs a trained model: give `weights`"
            raise naming(ValueError(text), "freeze_stages", "weights")
        if name is None and weights is not None:
            card = read_card(weights_file(weights))
            name = name_from(card, self.task)
            options = own_options(card, name) | (options or {})
        self.name, self.options = name or self.default_model, options or {}
        check_name(self.name, self.task)
        self.weights, self.freeze_stages = weights, freeze_stages
        self._frozen: list[nn.Module] = []
        positive = dict(learning_rate=learning_rate, reference_batch=reference_batch)
        others = dict(
            warmup_rate=warmup_rate, final_rate=final_rate, weight_decay=weight_decay,
            warmup_epochs=warmup_epochs,
        )  # fmt: skip
        for option, value in (positive | others).items():
            if option in positive:
                check(option, value, 0 < value < math.inf, "above 0")
            else:
                check(option, value, 0 <= value < math.inf, "at least 0")
        self.rates = dict(peak=learning_rate, warmup=warmup_rate, final=final_rate)
        self.warmup_epochs, self.reference_batch = warmup_epochs, reference_batch
        self.weight_decay, self.decay_position_bias = weight_decay, decay_position_bias
        self.seed, self.grad_checkpointing = seed, grad_checkpointing
        self._steps_there: int | None = None  # steps per epoch of the run in the checkpoint

    # -- building -----------------------------------------------------------------------------

    def configure_model(self) -> None:
        """Builds the network for the classes and channels of the data."""
        # Lightning calls this with a GPU as the default device. The data must stay on the CPU for
        # the worker processes, and weights are drawn there so that they are the same everywhere.
        with torch.device("cpu"):
            if not hasattr(self, "net"):
                self._build()

    def _build(self) -> None:
        data = self.data
        options: dict[str, Any] = self._head_options() | dict(in_chans=data.channels)
        options |= dict(mean=data.mean, std=data.std)
        if has_image_size(self.name):
            options["image_size"] = data.size
        if taken := sorted(options.keys() & self.options.keys()):
            text = f"`options` cannot set {', '.join(taken)}: the data set it"
            raise naming(ValueError(text), "options")
        options |= self.options
        self.card = ModelCard(
            self.name, options, data.classes, data.size, data.fov, data.card_fit,
            task=self.task, colors=data.colors,
        )  # fmt: skip
        self.trained = self.card
        torch.manual_seed(self.seed)
        try:
            self.net = self.card.create()
        except (TypeError, ValueError) as error:
            if isinstance(error, TypeError) and not self.options:
                raise
            given = f"`size` {data.size}"
            if self.options:
                given += f" and `options` {self.options}"
            text = f"cannot make {self.name} with {given}: {error}"
            raise naming(ValueError(text), "size", "options") from error
        if self.weights is not None and self.trainer.training:
            start_from(self.net, data.classes, self.weights)
        self._freeze()
        self.net.set_grad_checkpointing(self.grad_checkpointing)
        self._make_metrics()

    def _head_options(self) -> dict[str, Any]:
        """The options of the model that follow from the task and the classes."""
        raise NotImplementedError

    def _two_classes(self) -> list[str]:
        if len(self.data.classes) < 2:
            raise ValueError(
                f"{self.task} needs at least two classes, but the data has {self.data.classes}"
            )
        return self.data.classes

    def _make_metrics(self) -> None:
        """Makes the metrics for validation and tests."""
        raise NotImplementedError

    def results_figure(self) -> Figure | None:
        """A figure of `results`, or None."""
        raise NotImplementedError

    def _freeze(self) -> None:
        self._frozen = frozen_parts(self.net, self.freeze_stages)
        for module in self._frozen:
            module.requires_grad_(False)
        self.train(self.training)

    def train(self, mode: bool = True) -> Self:
        """`torch.nn.Module.train`, but frozen stages stay in evaluation mode."""
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self

    @property
    def data(self) -> Any:
        """The `RunData` of the run."""
        return self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning attaches it

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """AdamW and the schedule of its learning rate."""
        trainer = self.trainer
        batch = self.data.batch_size * trainer.world_size * trainer.accumulate_grad_batches
        scale = batch / self.reference_batch
        trainer.fit_loop.setup_data()  # with max_steps alone, Lightning has not yet
        steps = trainer.estimated_stepping_batches
        if not math.isfinite(steps):
            text = "the learning rate's cosine needs an end: set `max_epochs` or `max_steps`"
            raise naming(ValueError(text), "max_epochs", "max_steps")
        if self._steps_there not in (None, self.steps_per_epoch):
            text = (
                f"this run began with {self._steps_there} steps per epoch and cannot go on with "
                f"{self.steps_per_epoch}: keep the number of pictures, `batch_size`, `devices` and "
                "`limit_train_batches`"
            )
            raise naming(ValueError(text), "batch_size", "devices", "limit_train_batches")
        self.steps = int(steps)
        rates = {name: rate * scale for name, rate in self.rates.items()}
        warmup_steps = self.warmup_epochs * self.steps_per_epoch
        undecayed = () if self.decay_position_bias else self.net.no_weight_decay()
        optimizer = torch.optim.AdamW(
            parameter_groups(self.net, self.weight_decay, undecayed), lr=rates["peak"],
            # It visits each parameter once. With autocast, Lightning cannot clip its gradients.
            fused=not isinstance(trainer.precision_plugin, MixedPrecision),
        )  # fmt: skip
        schedule = Schedule(optimizer, warmup_steps=warmup_steps, steps=self.steps, **rates)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    @property
    def steps_per_epoch(self) -> int:
        """Steps of the optimiser in an epoch; the last step may have fewer batches."""
        trainer = self.trainer
        return math.ceil(trainer.num_training_batches / trainer.accumulate_grad_batches)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Adds the model's card; FloatingPointError if weights or moments are not finite."""
        optimizers = checkpoint.get("optimizer_states", ())
        moments = (state for one in optimizers for state in one["state"].values())
        for tensors in (checkpoint["state_dict"], *moments):
            if not all(tensor.isfinite().all() for tensor in tensors.values()):
                step = self.trainer.global_step
                raise self._diverged(f"the weights are not finite after step {step}")
        checkpoint["darswin"] = asdict(self.card)
        checkpoint["steps_per_epoch"] = self.steps_per_epoch

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """ValueError if the checkpoint belongs to another model."""
        self._steps_there = checkpoint.get("steps_per_epoch")
        self.trained = ModelCard(**checkpoint["darswin"])
        theirs, ours = (
            {**card, **card.pop("options")} for card in (asdict(self.trained), asdict(self.card))
        )
        # A model may be tested on pictures of another `fit`.
        ignored = {"fit", "colors"} | (set() if theirs["fov"] and ours["fov"] else {"fov"})
        other = [
            f"{key} {theirs.get(key)!r} there, {ours.get(key)!r} here"
            for key in sorted((theirs.keys() | ours.keys()) - ignored)
            if theirs.get(key) != ours.get(key)
        ]
        if other:
            raise ValueError(f"the checkpoint belongs to another model: {'; '.join(other)}")

    # -- training -----------------------------------------------------------------------------

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a batch."""
        # The random numbers of a step depend only on its place, so a resumed run repeats them.
        step = (self.seed, self.current_epoch, batch_idx)
        rng = np.random.default_rng(step)  # the same in all processes
        torch.manual_seed(int(np.random.default_rng((*step, self.global_rank)).integers(2**63)))
        loss = self._loss(batch, rng)
        # Reading the loss waits for a GPU. So a GPU's loss is checked only when Lightning logs and
        # waits anyway: once the loss is not finite, it stays so.
        every = self.trainer.log_every_n_steps  # type: ignore[attr-defined]  # Lightning adds it
        checked = readable(loss) or (self.trainer.global_step + 1) % max(every, 1) == 0
        if checked and not torch.isfinite(loss):
            raise self._diverged(
                f"the loss is {loss.item()} in epoch {self.current_epoch}, batch {batch_idx}"
            )
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch[0]), sync_dist=True)
        # A tensor on the device, because Lightning would copy a number there.
        self.log("train/rate", loss.new_full((), self.trainer.optimizers[0].param_groups[0]["lr"]))
        return loss

    def _loss(self, batch: Batch, rng: np.random.Generator) -> Tensor:
        """The loss of a batch; `rng` is the same in all processes."""
        raise NotImplementedError

    def _diverged(self, what: str) -> FloatingPointError:
        text = (
            f"{what}: go on with `resume` and a `learning_rate` below {self.rates['peak']:g}; if "
            "the last checkpoint has diverged too, add `ckpt_path` with best.ckpt, or start again"
        )
        return naming(FloatingPointError(text), "resume", "learning_rate", "ckpt_path")


def finite_loss(loss: float, name: str) -> float:
    """The loss of a test set; FloatingPointError if it is not finite."""
    if not math.isfinite(loss):
        text = (
            f"the loss on {name} is {loss}: the weights are not finite, or training diverged; "
            "try another checkpoint with `ckpt_path`"
        )
        raise naming(FloatingPointError(text), "ckpt_path")
    return loss


# -- optimiser --------------------------------------------------------------------------------


def parameter_groups(model: nn.Module, weight_decay: float, undecayed: Iterable[str]) -> list[dict]:
    """Two groups for an optimiser: matrices with weight decay; vectors, biases and the parameters
    named in `undecayed` without."""
    undecayed = set(undecayed)
    groups: dict[bool, list[nn.Parameter]] = {True: [], False: []}
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            decays = parameter.dim() > 1 and not name.endswith(".bias") and name not in undecayed
            groups[decays].append(parameter)
    return [
        {"params": groups[True], "weight_decay": weight_decay},
        {"params": groups[False], "weight_decay": 0.0},
    ]


def learning_rate(
    step: int, *, peak: float, warmup: float, final: float, warmup_steps: float, steps: int
) -> float:
    """Linear from `warmup` to `peak` over `warmup_steps`, then a cosine down to `final` at `steps`.

    The cosine starts at step 0, so the rate drops a little at the end of the warm-up, as in the
    recipe of Swin and DarSwin.
    """
    if step < warmup_steps:
        return warmup + (peak - warmup) * step / warmup_steps
    return final + (peak - final) * (1 + math.cos(math.pi * min(step / max(steps, 1), 1))) / 2


class Schedule(LambdaLR):
    """The `learning_rate` of AdamW for each step.

    A checkpoint restores only the step. The rates and the weight decay stay those with which the
    optimiser and the schedule were made. Restore the schedule after the optimiser.
    """

    def __init__(self, optimizer: Optimizer, **rates: Any):
        super().__init__(optimizer, lambda step: learning_rate(step, **rates) / rates["peak"])
        optimizer.register_load_state_dict_pre_hook(_with_own_options)

    def state_dict(self) -> dict[str, Any]:
        return {"last_epoch": self.last_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.last_epoch = state_dict["last_epoch"] - 1
        self._step_count = 0  # otherwise torch warns of a step before the optimiser's first one
        self.step()


def _with_own_options(optimizer: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    theirs, own = state["param_groups"], optimizer.param_groups
    groups = [mine | {"params": group["params"]} for group, mine in zip(theirs, own, strict=True)]
    return state | {"param_groups": groups}
