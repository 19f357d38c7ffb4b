"""Image classification."""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from torch import Tensor, nn
from torchmetrics import Metric
from torchmetrics.classification import MulticlassAccuracy

from darswin.data.augment import Mixing, partners_share
from darswin.data.lens_distributions import SphericalLenses, parse_lenses
from darswin.train.task import Batch, TaskModule, finite_loss
from darswin.utils.parameters import check
from darswin.viz.plot import draw_accuracy, page_figure


class Classification(TaskModule):
    """A classifier of wide-angle images, with its loss, its optimiser and its accuracy.

    After a test, a row of `results` has `lenses`, the name of the test set; `n`, its number of
    pictures; `top1` and `top5`, the accuracy in [0, 1]; `top1_low` and `top1_high`, its interval
    (see `wilson`); `most_frequent`, the accuracy of always answering the most frequent class; and
    `loss`. A value that needs pictures is None if there are none.

    Args:
        name: the model, one of those that `darswin models` lists; null is the model of `weights`,
            or darswin_a_micro.
        options: options of the model, e.g. {spacing: tan, jitter: 0}. With `weights`, the model
            keeps its own options; only drop_path_rate and jitter may differ.
        label_smoothing: the share of each label that is spread over all classes, in [0, 1).
        mixup: α of Beta(α, α), the distribution of the share of each image in a mixture; 0 is off.
        cutmix: α for mixtures that replace a box of the image; 0 is off.
        mix_p: the share of batches that are mixed.
        common: as `TaskModule`.

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
        check("label_smoothing", label_smoothing, 0 <= label_smoothing < 1, "in [0, 1)")
        self.label_smoothing = label_smoothing
        self.mixing = Mixing(mixup, cutmix, mix_p)

    def _head_options(self) -> dict[str, Any]:
        return dict(num_classes=len(self._two_classes()))

    def _make_metrics(self) -> None:
        count = len(self.data.classes)
        self.val_metrics = ClassMetrics(count)
        self.test_metrics = nn.ModuleList(ClassMetrics(count) for _ in self.data.test_names)

    # -- training -----------------------------------------------------------------------------

    def _loss(self, batch: Batch, rng: np.random.Generator) -> Tensor:
        images, lens, labels = batch
        targets = self._targets(labels, len(self.card.classes))
        shared = partners_share(lens) if self.data.calibrations and self.data.pair_lenses else None
        images, targets = self.mixing(images, targets, rng, shared)
        return F.cross_entropy(self.net(images, lens).float(), targets)

    def _targets(self, labels: Tensor, classes: int) -> Tensor:
        """Labels (B,) → probabilities (B, K), all 0 for label -1, which does not count then."""
        names = torch.arange(classes, device=labels.device)
        hot = (labels[:, None] == names).float()
        smooth = hot * (1 - self.label_smoothing) + self.label_smoothing / classes
        return smooth * (labels >= 0)[:, None]

    # -- evaluation ---------------------------------------------------------------------------

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Adds a batch to the loss and accuracy of the validation."""
        images, lens, labels = batch
        self.val_metrics.update(self.net(images, lens).float(), labels)
        for name, metric in self.val_metrics.all().items():
            self.log(f"val/{name}", metric, prog_bar=name != "top5", on_step=False, on_epoch=True)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Adds a batch to the loss and accuracy of its test set."""
        images, lens, labels = batch
        metrics: Any = self.test_metrics[dataloader_idx]
        metrics.update(self.net(images, lens).float(), labels)

    def on_test_epoch_end(self) -> None:
        """Collects `results`: a row for each test set."""
        self.results = []
        metrics: Any
        for name, metrics in zip(self.data.test_names, self.test_metrics, strict=True):
            counts = metrics.labels.compute()
            n = int(counts.sum())
            row = {"lenses": name, "n": n} | dict.fromkeys(("top1", "top1_low", "top1_high"))
            row |= {key: metric.compute().item() for key, metric in metrics.all().items()}
            row |= {"loss": None, "most_frequent": None}
            if n:
                row["top1_low"], row["top1_high"] = wilson(row["top1"], n)
                row["loss"] = finite_loss(metrics.loss.compute().item(), name)
                row["most_frequent"] = counts.max().item() / n
            self.results.append(row)

    def results_figure(self) -> Figure:
        """Accuracy against ξ if each test set has a single ξ, otherwise bars; with the intervals
        and the accuracy of always answering the most frequent class."""
        figure = page_figure(4)
        axes = figure.subplots()
        name, rows = self.card.model, self.results
        accuracy, low, high = (
            np.array([100 * (row[key] or 0) for row in rows])
            for key in ("top1", "top1_low", "top1_high")
        )
        lenses = [_distribution(row["lenses"]) for row in rows]
        xi = [lens.low for lens in lenses if lens is not None and lens.low == lens.high]
        is_line = len(xi) == len(rows)
        if is_line:
            trained_on, warped = self.data.train_lenses, self.trained.fit == "whole"
            is_range = warped and isinstance(trained_on, SphericalLenses)
            band = (trained_on.low, trained_on.high) if is_range else None
            draw_accuracy(xi, {name: accuracy.tolist()}, band, axes=axes)
        else:
            axes.bar([row["lenses"] for row in rows], accuracy, label=name)
            axes.set(ylabel="accuracy (%)")
            axes.tick_params(axis="x", rotation=90)
        axes.errorbar(
            xi if is_line else np.arange(len(rows)), accuracy, fmt="none", ecolor="0.4", capsize=3,
            yerr=np.clip((accuracy - low, high - accuracy), 0, None), label="95 % interval",
            clip_on=False,
        )  # fmt: skip
        if most := [row["most_frequent"] for row in rows if row["n"]]:
            axes.axhline(100 * max(most), ls="--", color="0.5", label="most frequent class")
        counts = sorted({row["n"] for row in rows})
        ends = counts if len(counts) == 1 else (counts[0], counts[-1])
        axes.set(ylim=(0, 100), title=f"n = {'–'.join(map(str, ends))}")
        axes.legend()
        return figure


def wilson(share: float, n: int) -> tuple[float, float]:
    """The 95 % interval of a share in [0, 1] that was measured on n > 0 independent cases.

    Source: Wilson, Journal of the American Statistical Association 22, 1927. Unlike ± 1.96 standard
    errors, it is right for few cases and for shares near 0 and 1.
    """
    z = 1.959963984540054
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(share * (1 - share) / n + (z / (2 * n)) ** 2)
    return max(middle - half, 0.0), min(middle + half, 1.0)


class ClassMetrics(nn.Module):
    """The top-1 accuracy, the mean loss and, for more than five classes, the top-5 accuracy."""

    def __init__(self, classes: int):
        super().__init__()
        self.accuracies = nn.ModuleDict({
            f"top{k}": MulticlassAccuracy(classes, top_k=k, average="micro", validate_args=False)
            for k in (1, 5)
            if k < classes
        })  # fmt: skip
        self.loss = MeanLoss()
        self.labels = LabelCounts(classes)

    def update(self, logits: Tensor, labels: Tensor) -> None:
        """Adds images: their logits (B, K) and their labels (B,), -1 for unknown."""
        known = labels >= 0
        logits, labels = logits[known], labels[known]
        if len(labels) == 0:  # an error in torchmetrics
            return
        metric: Any
        for metric in self.accuracies.values():
            metric.update(logits, labels)
        self.loss.update(F.cross_entropy(logits, labels, reduction="none"))
        self.labels.update(labels)

    def all(self) -> dict[str, Any]:
        return dict(self.accuracies) | dict(loss=self.loss)


class MeanLoss(Metric):
    """A mean in float64 that keeps NaN; the one of torchmetrics drops NaN."""

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), "sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), "sum")

    def update(self, values: Tensor) -> None:
        self.total += values.double().sum()
        self.count += values.numel()

    def compute(self) -> Tensor:
        return (self.total / self.count).float()


class LabelCounts(Metric):
    """The number of pictures of each class, (K,)."""

    full_state_update = False
    counts: Tensor

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.add_state("counts", torch.zeros(classes, dtype=torch.int64), "sum")

    def update(self, labels: Tensor) -> None:
        self.counts += torch.bincount(labels, minlength=len(self.counts))

    def compute(self) -> Tensor:
        return self.counts


def _distribution(name: str) -> SphericalLenses | None:
    """The spherical lenses that a row names, or None."""
    try:
        lenses = parse_lenses(name)
    except ValueError:
        return None
    return lenses if isinstance(lenses, SphericalLenses) else None
