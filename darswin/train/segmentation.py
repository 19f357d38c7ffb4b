"""Segmentation: a class for each pixel."""

import math
import warnings
from typing import Any

import torch
from torch import Tensor, nn
from torchmetrics.classification import MulticlassAccuracy, MulticlassJaccardIndex

from darswin.data.scenes.scene import IGNORE
from darswin.data.splits import some
from darswin.ops.checks import tensor_there
from darswin.train.dense import DenseTask
from darswin.train.losses import LabelLoss, label_loss
from darswin.train.pixel_metrics import BY_AREA, LabelSums, label_scores, none_of_nan
from darswin.train.task import Batch, named_metrics


class AbsentClass(UserWarning):
    """A class does not occur in the labels that a model is trained on."""


class Segmentation(DenseTask):
    """A class for each pixel of wide-angle images: mIoU, accuracy, and IoU of each class.

    Pixels without a label, and those beyond θ_max, have no part in loss and scores. mIoU is the
    mean over the classes that occur in the truth or in the prediction.

    Args:
        name: of a model; null is that of `weights`, or darswin_unet_a_micro. From the weights of a
            classifier it is the model with that encoder.
        options: of the model, e.g. {spacing: tan, jitter: 0}. With `weights` they are its own, and
            only drop_path_rate and jitter may differ.
        loss: ce, the cross-entropy, dice, or the sum of both.
        class_weights: how much each class counts in the loss, in the order of the classes; null
            is 1 each.
        ignore_index: the id of a class that is left out of loss and scores, besides 255, which
            always is.
        label_smoothing: of the cross-entropy, in [0, 1).
        common: as `DenseTask`.
    """

    task = "segmentation"
    nothing = IGNORE
    monitor = ("val/miou", "max")

    def __init__(
        self,
        name: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        loss: LabelLoss = "ce",
        class_weights: list[float] | None = None,
        ignore_index: int | None = None,
        label_smoothing: float = 0.0,
        **common: Any,
    ):
        super().__init__(name, options, **common)
        if not 0 <= label_smoothing < 1:
            raise ValueError(f"--model.label_smoothing must be in [0, 1), got {label_smoothing}")
        if class_weights is not None and not (
            all(0 <= weight < math.inf for weight in class_weights) and any(class_weights)
        ):
            raise ValueError(
                "--model.class_weights must be finite, at least 0, and not all 0, got "
                f"{class_weights}"
            )
        self.loss, self.class_weights = loss, class_weights
        self.ignore_index = None if ignore_index == IGNORE else ignore_index
        self.label_smoothing = label_smoothing

    def _head_options(self) -> dict[str, Any]:
        classes = self.data.classes
        count = len(classes)
        if count < 2:
            raise ValueError(f"segmentation needs two classes, the data has only {classes}")
        if self.class_weights is not None and len(self.class_weights) != count:
            raise ValueError(
                f"--model.class_weights must be one for each of the {count} classes "
                f"{', '.join(classes)}, got {len(self.class_weights)}"
            )
        if self.ignore_index is not None and not 0 <= self.ignore_index < count:
            raise ValueError(
                f"--model.ignore_index must be a class, 0 to {count - 1}, or {IGNORE}, got "
                f"{self.ignore_index}"
            )
        return dict(task="segmentation", num_classes=count)

    def _make_metrics(self) -> None:
        super()._make_metrics()
        count = len(self.data.classes)
        left_out: dict[str, Any] = dict(ignore_index=self.ignore_index, validate_args=False)
        self.val_metrics = nn.ModuleDict(dict(
            miou=MulticlassJaccardIndex(count, **left_out),
            accuracy=MulticlassAccuracy(count, average="micro", **left_out),
        ))  # fmt: skip

    def _sums(self) -> LabelSums:
        return LabelSums(len(self.data.classes), len(self.zones))

    def _criterion(self, predicted: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        class_weights = None
        if self.class_weights is not None:
            class_weights = tensor_there(self.class_weights, predicted)
        target = torch.where(self._known(target), target, IGNORE)
        return label_loss(
            predicted, target, self.loss, class_weights=class_weights,
            label_smoothing=self.label_smoothing, weights=weights,
        )  # fmt: skip

    def _answer(self, predicted: Tensor) -> Tensor:
        return predicted.argmax(1)

    def _known(self, target: Tensor) -> Tensor:
        known = target != IGNORE
        return known if self.ignore_index is None else known & (target != self.ignore_index)

    def _missing(self, there: list[bool], images: str, whole: bool) -> None:
        classes = self.data.classes
        if not any(there):
            raise ValueError(
                f"none of the pixels of {images} has a label: labels must hold the ids 0 to "
                f"{len(classes) - 1}, and {IGNORE} means that a pixel is not labelled"
            )
        learned = [k for k in range(len(classes)) if k != self.ignore_index]
        absent = [classes[k] for k in learned if not there[k]]
        if not whole or not absent:
            return
        text = f"no pixel of {images} has a label of {some(absent)}"
        if len(learned) - len(absent) < 2:
            raise ValueError(
                f"{text}, so that a single class is left to learn; {IGNORE} means that a pixel is "
                "not labelled: a mask of 0 and 255 must be stored as the ids 0 and 1"
            )
        if not self.global_rank:
            warnings.warn(f"{text}, which cannot be learned", AbsentClass, stacklevel=2)

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Counts a batch into the validation's loss and scores."""
        answer, known = self._said(batch, self.val_loss)
        for name, metric in named_metrics(self.val_metrics):
            if known.any():
                metric.update(answer[known], batch[2][known])
            self.log(f"val/{name}", metric, prog_bar=True, on_step=False, on_epoch=True)
        self.log("val/loss", self.val_loss, prog_bar=True, on_step=False, on_epoch=True)

    def _row(self, counts: Tensor, areas: Tensor) -> dict[str, Any]:
        overall, iou, recall = self._scores(counts.sum(0), areas.sum(0))
        pixels = counts.sum((0, 2)).tolist()
        per_class = {
            name: dict(pixels=pixels[k]) | {key: value[k] for key, value in (iou | recall).items()}
            for k, name in enumerate(self.data.classes)
            if k != self.ignore_index
        }
        per_zone = [
            zone | dict(pixels=int(count.sum())) | self._scores(count, area)[0]
            for zone, count, area in zip(self.zones.ranges(), counts, areas, strict=True)
        ]
        return dict(pixels=sum(pixels)) | overall | dict(per_class=per_class, per_zone=per_zone)

    def _scores(self, counts: Tensor, areas: Tensor) -> tuple[dict, dict, dict]:
        """Overall scores, IoU and recall of each class: as pixels and as solid angles count."""
        overall: dict[str, float | None] = {}
        iou: dict[str, list] = {}
        recall: dict[str, list] = {}
        for end, confusion in (("", counts), (BY_AREA, areas)):
            of_all, of_class, found = label_scores(confusion, self.ignore_index)
            overall |= {f"{name}{end}": none_of_nan(value) for name, value in of_all.items()}
            iou[f"iou{end}"] = [none_of_nan(value) for value in of_class.tolist()]
            recall[f"recall{end}"] = [none_of_nan(value) for value in found.tolist()]
        return overall, iou, recall
