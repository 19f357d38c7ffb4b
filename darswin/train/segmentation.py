"""Segmentation, a class for each pixel: its task, data, loss and scores."""

import math
import warnings
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.data.splits import some
from darswin.ops.checks import tensor_there
from darswin.train.pixel_metrics import BY_AREA, PixelSums, none_of_nan, or_one, ratio
from darswin.train.pixel_task import PixelModule
from darswin.train.scene_data import SceneData
from darswin.utils.parameters import check, naming
from darswin.utils.tasks import IGNORE

LabelLoss = Literal["ce", "dice", "ce+dice"]


def label_loss(
    logits: Tensor,
    labels: Tensor,
    kind: LabelLoss = "ce",
    *,
    class_weights: Tensor | None = None,
    label_smoothing: float = 0.0,
    weights: Tensor | None = None,
) -> Tensor:
    """Cross-entropy, soft Dice, or the sum of both; pixels with the label `IGNORE` do not count.

    Args:
        logits: (B, K, H, W). labels: (B, H, W), ids.
        class_weights: (K,), the weight of each class; None weights all by 1.
        label_smoothing: for the cross-entropy, in [0, 1).
        weights: (B, H, W), the weight of each pixel; None weights all by 1.

    Returns:
        A scalar.
    """
    loss = logits.new_zeros(())
    if kind != "dice":
        each = F.cross_entropy(
            logits, labels, class_weights, ignore_index=IGNORE, reduction="none",
            label_smoothing=label_smoothing,
        )  # fmt: skip
        known = labels != IGNORE
        share = known.to(each.dtype)
        if class_weights is not None:
            share = share * class_weights[torch.where(known, labels, 0)]
        if weights is not None:
            each, share = each * weights, share * weights
        loss = loss + each.sum() / or_one(share.sum())
    if kind != "ce":
        loss = loss + _dice(logits, labels, class_weights, weights)
    return loss


def _dice(
    logits: Tensor, labels: Tensor, class_weights: Tensor | None, weights: Tensor | None
) -> Tensor:
    """1 - Dice over all pixels of the batch, a mean over the classes in the labels.

    Source: V-Net, 3DV 2016, with a sum in place of squares in the denominator.
    """
    known = labels != IGNORE
    share = known.to(logits.dtype) if weights is None else known * weights
    truth = F.one_hot(torch.where(known, labels, 0), logits.shape[1]).permute(0, 3, 1, 2)
    truth = truth * share[:, None]
    predicted = logits.softmax(1) * share[:, None]
    both, either = (predicted * truth.gt(0)).sum((0, 2, 3)), (predicted + truth).sum((0, 2, 3))
    present = truth.sum((0, 2, 3)) > 0
    missed = torch.where(present, 1 - 2 * both / or_one(either), 0.0)
    counts = present.to(logits.dtype) if class_weights is None else present * class_weights
    return (missed * counts).sum() / or_one(counts.sum())


class LabelSums(PixelSums):
    """Confusion counts (Z, K, K): pixels of class i that were predicted as class j. The mean IoU
    leaves out the class `left_out`."""

    # The confusion counts of torchmetrics have no weights.

    def __init__(self, classes: int, zones: int, left_out: int | None = None):
        super().__init__(zones, (classes, classes), torch.int64)
        self.classes, self.left_out = classes, left_out

    def update(self, predicted: Tensor, labels: Tensor, zone: Tensor, area: Tensor) -> None:
        """Adds pixels (P,): predictions, labels, zones and solid angles (sr)."""
        cell = (zone * self.classes + labels) * self.classes + predicted
        cells = self.counts.numel()
        self.counts += torch.bincount(cell, minlength=cells).view_as(self.counts)
        weighted = torch.bincount(cell, area.double(), minlength=cells)
        self.areas += weighted.view_as(self.areas)

    def pixels(self, counts: Tensor) -> int:
        return int(counts.sum())

    def scores(self, sums: Tensor) -> dict[str, float]:
        """`accuracy`, and `miou` over the classes in the truth or the prediction."""
        iou, _ = iou_and_recall(sums)
        if self.left_out is not None:
            iou[self.left_out] = torch.nan
        accuracy = ratio(sums.diagonal().double().sum(), sums.double().sum())
        return dict(miou=iou.nanmean().item(), accuracy=accuracy.item())


def iou_and_recall(confusion: Tensor) -> tuple[Tensor, Tensor]:
    """IoU and recall of each class, (K,), from confusion counts (K, K) of truth and prediction; NaN
    for a class that does not occur."""
    confusion = confusion.double()
    right, present = confusion.diagonal(), confusion.sum(1)
    return ratio(right, present + confusion.sum(0) - right), ratio(right, present)


class Segmentation(PixelModule):
    """Predicts a class for each pixel of wide-angle images; measures mIoU, accuracy and IoU.

    The loss and the scores ignore pixels without a label and pixels beyond θ_max. mIoU is the mean
    over the classes that occur in the truth or in the prediction.

    Args:
        name: the model; null is the model of `weights`, or darswin_unet_a_micro. If `weights` is a
            classifier, it is the dense model with that encoder.
        options: options of the model, e.g. {spacing: tan, jitter: 0}. With `weights`, the model
            keeps its own options; only drop_path_rate and jitter may differ.
        loss: ce (cross-entropy), dice, or ce+dice, their sum.
        class_weights: the weight of each class in the loss, in the order of the classes; null
            weights all by 1.
        ignore_index: the id of a class that loss and scores ignore, in addition to 255.
        label_smoothing: the share of each label that the cross-entropy spreads over all classes,
            in [0, 1).
        common: as `PixelModule`.
    """

    task = "segmentation"
    nothing = IGNORE
    monitor = ("val/miou", "max")
    shown = ("miou", "accuracy")

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
        check("label_smoothing", label_smoothing, 0 <= label_smoothing < 1, "in [0, 1)")
        if class_weights is not None:
            positive = all(0 <= w < math.inf for w in class_weights) and any(class_weights)
            allowed = "finite, at least 0, and not all 0"
            check("class_weights", class_weights, positive, allowed)
        self.loss, self.class_weights = loss, class_weights
        self.ignore_index = None if ignore_index == IGNORE else ignore_index
        self.label_smoothing = label_smoothing

    def _head_options(self) -> dict[str, Any]:
        classes = self._two_classes()
        count = len(classes)
        if self.class_weights is not None and len(self.class_weights) != count:
            text = (
                f"`class_weights` must have one value for each of the {count} classes "
                f"{', '.join(classes)}, got {len(self.class_weights)}"
            )
            raise naming(ValueError(text), "class_weights")
        if (ignored := self.ignore_index) is not None:
            allowed = f"the id of a class, 0 to {count - 1}, or {IGNORE}"
            check("ignore_index", ignored, 0 <= ignored < count, allowed)
        return dict(task="segmentation", num_classes=count)

    def _sums(self, zones: int) -> LabelSums:
        return LabelSums(len(self.data.classes), zones, self.ignore_index)

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

    def _check_targets(self, found: list[bool], images: str, whole: bool) -> None:
        classes = self.data.classes
        if not any(found):
            raise ValueError(
                f"none of the pixels of {images} has a label: labels must hold the ids 0 to "
                f"{len(classes) - 1}; {IGNORE} means unlabelled"
            )
        learned = [k for k in range(len(classes)) if k != self.ignore_index]
        absent = [classes[k] for k in learned if not found[k]]
        if not whole or not absent:
            return
        text = f"no pixel of {images} has a label of {some(absent)}"
        if len(learned) - len(absent) < 2:
            text += (
                f", so only one class is left to learn. {IGNORE} means unlabelled: store a mask of "
                "0 and 255 as the ids 0 and 1, or give a `label_map`"
            )
            raise naming(ValueError(text), "label_map")
        if not self.global_rank:
            warnings.warn(f"{text}, which cannot be learned", stacklevel=2)

    def _per_class(self, counts: Tensor, areas: Tensor) -> dict[str, Any]:
        iou, recall = iou_and_recall(counts)
        iou_by_area, recall_by_area = iou_and_recall(areas)
        columns = {
            "iou": iou, f"iou{BY_AREA}": iou_by_area,
            "recall": recall, f"recall{BY_AREA}": recall_by_area,
        }  # fmt: skip
        return {
            name: dict(pixels=int(counts[k].sum()))
            | {key: none_of_nan(scores[k].item()) for key, scores in columns.items()}
            for k, name in enumerate(self.data.classes)
            if k != self.ignore_index
        }


class LabelData(SceneData):
    """Scenes with a label for each pixel.

    Args:
        path: a folder of scenes: see `darswin.data.open_scenes`.
        label_map: a JSON file that gives ids in the label files their classes, by name or by id,
            such as {"7": "road", "8": 1, "9": null}; null means unlabelled. It must have all ids
            that are not the data set's own.
        common: as `SceneData`.
    """

    target = "labels"

    def __init__(self, path: str, *, label_map: str | None = None, **common: Any):
        super().__init__(path, **common)
        self._opening["label_map"] = label_map
