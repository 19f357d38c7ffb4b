"""Image classification: what is trained and what is measured."""

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchmetrics import Metric

from darswin.data.augment import Mixing, partners_share
from darswin.train.task import Batch, Task, finite_loss, named_metrics
from darswin.train.wide_angle import WideAngleData


class Classification(Task):
    """A classifier of wide-angle images, its loss, its optimiser and its accuracy.

    Args:
        name: of a model, one that `darswin models` lists; null is that of `weights`, or
            darswin_a_micro.
        options: of the model, e.g. {spacing: tan, jitter: 0}. With `weights` they are its own, and
            only drop_path_rate and jitter may differ.
        label_smoothing: in [0, 1).
        mixup: α of Beta(α, α) that the shares of two images are drawn from; 0 is off.
        cutmix: α of the share that a box of another image leaves; 0 is off.
        mix_p: the share of batches that are mixed.
        common: as `Task`.

    Source: the recipe of DarSwin, ICCV 2023, sec. 5.2, and of its released code.
    """

    task = "classification"
    default_model = "darswin_a_micro"
    monitor = ("val/top1", "max")

    def __init__(
        self,
        name: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        label_smoothing: float = 0.1,
        mixup: float = 0.8,
        cutmix: float = 1.0,
        mix_p: float = 1.0,
        **common: Any,
    ):
        super().__init__(name, options, **common)
        if not 0 <= label_smoothing < 1:
            raise ValueError(f"--model.label_smoothing must be in [0, 1), got {label_smoothing}")
        self.label_smoothing = label_smoothing
        self.mixing = Mixing(mixup, cutmix, mix_p)

    @property
    def data(self) -> WideAngleData:
        """The data of the run."""
        return self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning attaches it

    def _head_options(self) -> dict[str, Any]:
        classes = self.data.classes
        if len(classes) < 2:
            raise ValueError(f"a classifier needs two classes, the data has only {classes}")
        return dict(num_classes=len(classes))

    def _make_metrics(self) -> None:
        count = len(self.data.classes)
        self.val_metrics = metrics(count)
        self.test_metrics = nn.ModuleList(metrics(count) for _ in self.data.test_names)

    # -- training -----------------------------------------------------------------------------

    def _loss(self, batch: Batch, rng: np.random.Generator) -> Tensor:
        """Of the batch, mixed if mixing is on."""
        images, lens, labels = batch
        targets = self._targets(labels, len(self.card.classes))
        shared = partners_share(lens) if self.data.calibrations and self.data.pair_lenses else None
        images, targets = self.mixing(images, targets, rng, shared)
        return F.cross_entropy(self.net(images, lens).float(), targets)

    def _targets(self, labels: Tensor, classes: int) -> Tensor:
        """Labels (B,) → probabilities (B, K); all 0 for label -1, which then weighs nothing."""
        names = torch.arange(classes, device=labels.device)
        hot = (labels[:, None] == names).float()
        smooth = hot * (1 - self.label_smoothing) + self.label_smoothing / classes
        return smooth * (labels >= 0)[:, None]

    # -- evaluation ---------------------------------------------------------------------------

    def _measure(self, batch: Batch, measured: nn.Module) -> None:
        images, lens, labels = batch
        logits = self.net(images, lens).float()
        for _, metric in named_metrics(measured):
            metric.update(logits, labels)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Counts a batch into the validation's loss and accuracy."""
        self._measure(batch, self.val_metrics)
        for name, metric in named_metrics(self.val_metrics):
            self.log(f"val/{name}", metric, prog_bar=name != "top5", on_step=False, on_epoch=True)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Counts a batch into the loss and accuracy of its lenses."""
        self._measure(batch, self.test_metrics[dataloader_idx])

    def on_test_epoch_end(self) -> None:
        """Collects `results`: a row for each distribution of lenses."""
        self.results = []
        for name, measured in zip(self.data.test_names, self.test_metrics, strict=True):
            row = {key: metric.compute().item() for key, metric in named_metrics(measured)}
            (mean,) = (metric for metric in measured.children() if isinstance(metric, MeanLoss))
            loss = finite_loss(row["loss"], name) if mean.count > 0 else None
            self.results.append({"lenses": name} | row | {"loss": loss})


class ImageMean(Metric):
    """Base of means over the images whose label is known; -1 is none.

    No device is waited for before `compute`, as it is by torchmetrics' own.
    """

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), "sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), "sum")

    def update(self, logits: Tensor, labels: Tensor) -> None:
        """Counts images: their logits (B, K) and their labels (B,)."""
        known = labels >= 0
        self.total += torch.where(known, self._values(logits, labels), 0).double().sum()
        self.count += known.sum()

    def _values(self, logits: Tensor, labels: Tensor) -> Tensor:
        raise NotImplementedError

    def compute(self) -> Tensor:
        """The mean; NaN where there are no images."""
        return (self.total / self.count).float()


class MeanLoss(ImageMean):
    """The mean cross-entropy."""

    def _values(self, logits: Tensor, labels: Tensor) -> Tensor:
        return F.cross_entropy(logits, labels, ignore_index=-1, reduction="none")


class TopK(ImageMean):
    """The share of images whose label is among the `top_k` likeliest."""

    def __init__(self, top_k: int):
        super().__init__()
        self.top_k = top_k

    def _values(self, logits: Tensor, labels: Tensor) -> Tensor:
        # Of classes that are as likely as each other the first is taken.
        one = self.top_k == 1
        said = logits.argmax(1, keepdim=True) if one else logits.topk(self.top_k).indices
        return (said == labels[:, None]).any(1).double()

    def compute(self) -> Tensor:
        """The share; 0 where there are no images."""
        return super().compute().nan_to_num(0.0)


def metrics(classes: int) -> nn.ModuleDict:
    """What an evaluation measures: mean loss, and the shares that top-1 and top-5 get right."""
    return nn.ModuleDict(
        dict(top1=TopK(min(1, classes)), top5=TopK(min(5, classes)), loss=MeanLoss())
    )
