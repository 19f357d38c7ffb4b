"""Image classification: what is trained and what is measured."""

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Self

import numpy as np
import torch
import torch.nn.functional as F
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric
from torchmetrics.classification import MulticlassAccuracy

from darswin.data.mixing import Mixing, partners_share
from darswin.layers.linear import MatmulBackend
from darswin.lens import Lens
from darswin.models.encoder import Encoder
from darswin.models.registry import model_class
from darswin.models.saving import ModelCard, read_card
from darswin.train.data import WideAngleData
from darswin.train.finetuning import frozen_parts, own_options, start_from, weights_file
from darswin.train.recipe import Schedule, parameter_groups

DEFAULT_MODEL = "darswin_a_micro"
Batch = tuple[Tensor, Lens, Tensor]


class Classification(LightningModule):
    """A classifier of wide-angle images, its loss, its optimiser and its accuracy.

    Learning rates are those of `reference_batch` images a step and grow in proportion to the batch.

    Args:
        name: of a model, one that `darswin models` lists; null is that of `weights`, or
            darswin_a_micro.
        options: of the model, e.g. {spacing: tan, jitter: 0}. With `weights` they are its own, and
            only drop_path_rate and jitter may differ.
        weights: a trained model to start from: the folder of a run, whose best model is taken, or a
            safetensors file. Its name, options, channels, mean and std are the run's; so is its
            size, unless data.size says another and the model takes it. Its head is kept for the
            same classes in the same order, else a new one is made. A resumed run does not read it.
        freeze_stages: keeps the patch embedding and so many first stages of `weights` as they are,
            without drop path and jitter; all stages leave the head alone to be trained.
        learning_rate: its peak.
        warmup_rate: what it starts from.
        final_rate: what it ends at.
        warmup_epochs: of linear warm-up; may be a fraction.
        weight_decay: AdamW's.
        decay_position_bias: decays position biases too, as the authors' code does.
        label_smoothing: in [0, 1).
        mixup: α of Beta(α, α) that the shares of two images are drawn from; 0 is off.
        cutmix: α of the share that a box of another image leaves; 0 is off.
        mix_p: the share of batches that are mixed.
        reference_batch: images that the rates are meant for.
        matmul_backend: of float32 products: torch, onednn, or autotune, which measures as it runs.
            On AMD's CPUs onednn is twice as fast; which one it is decides how results are rounded.
        grad_checkpointing: saves a third of the activations' memory for a few percent of the time.
        seed: of the weights, jitter, drop path and mixing.

    Source: the recipe of DarSwin, ICCV 2023, sec. 5.2, and of its released code.
    """

    net: Encoder  # of `configure_model`, as is what describes it
    card: ModelCard
    trained: ModelCard  # of the checkpoint that was read; else `card`

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
        label_smoothing: float = 0.1,
        mixup: float = 0.8,
        cutmix: float = 1.0,
        mix_p: float = 1.0,
        reference_batch: int = 512,
        matmul_backend: MatmulBackend = "torch",
        grad_checkpointing: bool = False,
        seed: int = 0,
    ):
        super().__init__()
        if freeze_stages and weights is None:
            raise ValueError(
                f"--model.freeze_stages {freeze_stages} keeps trained stages: give --model.weights"
            )
        if name is None and weights is not None:
            card = read_card(weights_file(weights))
            name, options = card.model, own_options(card) | (options or {})
        self.name, self.options = name or DEFAULT_MODEL, options or {}
        model_class(self.name)
        self.weights, self.freeze_stages = weights, freeze_stages
        self._frozen: list[nn.Module] = []
        if not 0 <= label_smoothing < 1:
            raise ValueError(f"--model.label_smoothing must be in [0, 1), got {label_smoothing}")
        for option, value in dict(
            learning_rate=learning_rate, reference_batch=reference_batch
        ).items():
            if not 0 < value < math.inf:
                raise ValueError(f"--model.{option} must be above 0, got {value}")
        rates = dict(warmup_rate=warmup_rate, final_rate=final_rate, weight_decay=weight_decay)
        for option, value in (rates | dict(warmup_epochs=warmup_epochs)).items():
            if not 0 <= value < math.inf:
                raise ValueError(f"--model.{option} must be at least 0, got {value}")
        self.rates = dict(peak=learning_rate, warmup=warmup_rate, final=final_rate)
        self.warmup_epochs, self.reference_batch = warmup_epochs, reference_batch
        self.weight_decay, self.decay_position_bias = weight_decay, decay_position_bias
        self.label_smoothing, self.seed = label_smoothing, seed
        self.matmul_backend, self.grad_checkpointing = matmul_backend, grad_checkpointing
        self.mixing = Mixing(mixup, cutmix, mix_p)
        self._steps_there: int | None = None  # in an epoch of the run that a checkpoint is of

    # -- building -----------------------------------------------------------------------------

    def configure_model(self) -> None:
        """Builds the network for the classes and channels of the data."""
        if hasattr(self, "net"):
            return
        data = self.data
        if len(data.classes) < 2:
            raise ValueError(f"a classifier needs two classes, the data has only {data.classes}")
        options: dict[str, Any] = dict(num_classes=len(data.classes), in_chans=data.channels)
        options |= dict(mean=data.mean, std=data.std)
        if model_class(self.name).image_size is not None:
            options["image_size"] = data.size
        if taken := sorted(options.keys() & self.options.keys()):
            raise ValueError(
                f"--model.options cannot set {', '.join(taken)}: the data decides on it"
            )
        options |= self.options
        self.card = ModelCard(self.name, options, data.classes, data.size, data.fov, data.frame_fit)
        self.trained = self.card
        torch.manual_seed(self.seed)
        try:
            self.net = self.card.create()
        except (TypeError, ValueError) as error:
            if not self.options:
                raise
            raise ValueError(
                f"no {self.name} with --model.options {self.options}: {error}"
            ) from error
        if self.weights is not None and self.trainer.training:
            start_from(self.net, data.classes, self.weights)
        self._freeze()
        self.net.set_matmul_backend(self.matmul_backend)
        self.net.set_grad_checkpointing(self.grad_checkpointing)
        count = len(data.classes)
        self.val_metrics = metrics(count)
        self.test_metrics = nn.ModuleList(metrics(count) for _ in data.test_names)

    def _freeze(self) -> None:
        self._frozen = frozen_parts(self.net, self.freeze_stages)
        for module in self._frozen:
            module.requires_grad_(False)
        self.train(self.training)

    def train(self, mode: bool = True) -> Self:
        """As torch's; frozen stages stay as in evaluation, without drop path and jitter."""
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self

    @property
    def data(self) -> WideAngleData:
        """The data of the run."""
        return self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning attaches it

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """AdamW, and its learning rate over the run's steps."""
        trainer = self.trainer
        batch = self.data.batch_size * trainer.world_size * trainer.accumulate_grad_batches
        scale = batch / self.reference_batch
        trainer.fit_loop.setup_data()  # with max_steps alone, Lightning has not yet
        steps = trainer.estimated_stepping_batches
        if not math.isfinite(steps):
            raise ValueError("the cosine needs an end: set --trainer.max_epochs or max_steps")
        if self._steps_there not in (None, self.steps_per_epoch):
            raise ValueError(
                f"an epoch of this run has {self._steps_there} steps, and would now have "
                f"{self.steps_per_epoch}, which its schedule cannot follow; the number of "
                "pictures, --data.batch_size, --devices and --trainer.limit_train_batches decide it"
            )
        rates = {name: rate * scale for name, rate in self.rates.items()}
        warmup_steps = self.warmup_epochs * self.steps_per_epoch
        undecayed = () if self.decay_position_bias else self.net.no_weight_decay()
        optimizer = torch.optim.AdamW(
            parameter_groups(self.net, self.weight_decay, undecayed), lr=rates["peak"]
        )
        schedule = Schedule(optimizer, warmup_steps=warmup_steps, steps=steps, **rates)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    @property
    def steps_per_epoch(self) -> int:
        """Steps of the optimizer, the last of which may be on fewer batches than the others."""
        trainer = self.trainer
        return math.ceil(trainer.num_training_batches / trainer.accumulate_grad_batches)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """FloatingPointError where the weights, or their moments, are no longer finite."""
        optimizers = checkpoint.get("optimizer_states", ())
        moments = (state for one in optimizers for state in one["state"].values())
        for tensors in (checkpoint["state_dict"], *moments):
            if not all(tensor.isfinite().all() for tensor in tensors.values()):
                step = self.trainer.global_step
                raise FloatingPointError(
                    f"the weights are not finite after step {step}: {self._advice()}"
                )
        checkpoint["darswin"] = asdict(self.card)
        checkpoint["steps_per_epoch"] = self.steps_per_epoch

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """ValueError where the checkpoint is not one of this model."""
        self._steps_there = checkpoint.get("steps_per_epoch")
        self.trained = ModelCard(**checkpoint["darswin"])
        theirs, ours = (
            {**card, **card.pop("options")} for card in (asdict(self.trained), asdict(self.card))
        )
        # A model may be measured on pictures that come to it in another way.
        ignored = {"fit"} if theirs["fov"] and ours["fov"] else {"fit", "fov"}
        other = [
            f"{key} {theirs.get(key)!r} there, {ours.get(key)!r} here"
            for key in sorted((theirs.keys() | ours.keys()) - ignored)
            if theirs.get(key) != ours.get(key)
        ]
        if other:
            raise ValueError(f"the checkpoint is one of another model: {'; '.join(other)}")

    # -- training -----------------------------------------------------------------------------

    def forward(self, images: Tensor, lens: Lens) -> Tensor:
        """Images (B, C, H, W) and their lenses → logits (B, K)."""
        return self.net(images, lens)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a batch, mixed if mixing is on."""
        images, lens, labels = batch
        # A step's random numbers depend on its place alone, so that a resumed run repeats them.
        step = (self.seed, self.current_epoch, batch_idx)
        rng = np.random.default_rng(step)  # the same in all processes
        torch.manual_seed(int(np.random.default_rng((*step, self.global_rank)).integers(2**63)))
        targets = self._targets(labels, len(self.card.classes))
        shared = partners_share(lens) if self.data.calibrations and self.data.pair_lenses else None
        images, targets = self.mixing(images, targets, rng, shared)
        loss = F.cross_entropy(self.net(images, lens).float(), targets)
        if not torch.isfinite(loss):
            raise FloatingPointError(
                f"the loss is {loss.item()} in epoch {self.current_epoch}, batch {batch_idx}: "
                f"{self._advice()}"
            )
        self.log("train/loss", loss, prog_bar=True, batch_size=len(images), sync_dist=True)
        self.log("train/rate", self.trainer.optimizers[0].param_groups[0]["lr"])
        return loss

    def _advice(self) -> str:
        return (
            f"go on with --resume and a --model.learning_rate below {self.rates['peak']:g}; if the "
            "last checkpoint has diverged too, add --ckpt_path for best.ckpt, or begin anew"
        )

    def _targets(self, labels: Tensor, classes: int) -> Tensor:
        """Labels (B,) → probabilities (B, K); all 0 for label -1, which then weighs nothing."""
        names = torch.arange(classes, device=labels.device)
        hot = (labels[:, None] == names).float()
        smooth = hot * (1 - self.label_smoothing) + self.label_smoothing / classes
        return smooth * (labels >= 0)[:, None]

    # -- evaluation ---------------------------------------------------------------------------

    def _measure(self, batch: Batch, measured: nn.Module) -> None:
        images, lens, labels = batch
        known = labels >= 0
        logits = self.net(images, lens).float()[known]
        for name, metric in _named(measured):
            if not known.any():
                continue
            if name == "loss":
                metric.update(F.cross_entropy(logits, labels[known]), weight=known.sum())
            else:
                metric.update(logits, labels[known])

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Counts a batch into the validation's loss and accuracy."""
        self._measure(batch, self.val_metrics)
        for name, metric in _named(self.val_metrics):
            self.log(f"val/{name}", metric, prog_bar=name != "top5", on_step=False, on_epoch=True)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Counts a batch into the loss and accuracy of its lenses."""
        self._measure(batch, self.test_metrics[dataloader_idx])

    def on_test_epoch_end(self) -> None:
        """Collects `results`: a row for each distribution of lenses."""
        names = self.data.test_names
        self.results = [
            {"lenses": name} | {key: metric.compute().item() for key, metric in _named(measured)}
            for name, measured in zip(names, self.test_metrics, strict=True)
        ]


def metrics(classes: int) -> nn.ModuleDict:
    """What an evaluation measures: mean loss, and the shares that top-1 and top-5 get right."""

    def accuracy(k: int) -> Metric:
        top_k = min(k, classes)
        return MulticlassAccuracy(classes, average="micro", top_k=top_k)

    return nn.ModuleDict(dict(top1=accuracy(1), top5=accuracy(5), loss=MeanMetric()))


def _named(measured: nn.Module) -> Iterator[tuple[str, Metric]]:
    """The metrics of `metrics`, and their names."""
    for name, metric in measured.named_children():
        assert isinstance(metric, Metric)
        yield name, metric
