"""Segmentation (a class for each pixel) and distance (metres along the ray for each pixel)."""

import math
import warnings
from typing import Any

import torch
from torch import Tensor

from darswin.data.scenes.targets import IGNORE
from darswin.data.splits import some
from darswin.ops.checks import tensor_there
from darswin.train.losses import DistanceLoss, LabelLoss, distance_loss, label_loss
from darswin.train.pixel_metrics import (
    BY_AREA,
    DistanceSums,
    LabelSums,
    iou_and_recall,
    none_of_nan,
)
from darswin.train.pixel_task import PixelTask
from darswin.utils.parameters import check, naming

__all__ = ["Distance", "Segmentation"]


class AbsentClass(UserWarning):
    """A class does not occur in the labels that a model is trained on."""


class Segmentation(PixelTask):
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
        common: as `PixelTask`.
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
            warnings.warn(f"{text}, which cannot be learned", AbsentClass, stacklevel=2)

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


class Distance(PixelTask):
    """Predicts the distance along the ray for each pixel of wide-angle images.

    The loss and the scores ignore pixels of unknown distance and pixels beyond θ_max.

    Args:
        name: the model; null is the model of `weights`, or darswin_unet_a_micro. If `weights` is a
            classifier, it is the dense model with that encoder.
        options: options of the model, e.g. {typical_distance: 3}. With `weights`, the model keeps
            its own options; only drop_path_rate and jitter may differ.
        loss: silog (the scale-invariant logarithmic error with λ = 0.85), l1 (the mean absolute
            error in metres) or log_l1 (the mean absolute error of the logarithms).
        common: as `PixelTask`.
    """

    task = "distance"
    nothing = 0
    monitor = ("val/abs_rel", "min")
    shown = ("abs_rel", "rmse", "delta1")

    def __init__(
        self,
        name: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        loss: DistanceLoss = "silog",
        **common: Any,
    ):
        super().__init__(name, options, **common)
        self.loss = loss

    def _head_options(self) -> dict[str, Any]:
        return dict(task="distance")

    def _sums(self, zones: int) -> DistanceSums:
        return DistanceSums(zones)

    def _criterion(self, predicted: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        return distance_loss(predicted, target, self.loss, weights=weights)

    def _answer(self, predicted: Tensor) -> Tensor:
        return predicted[:, 0]

    def _known(self, target: Tensor) -> Tensor:
        return target > 0

    def _check_targets(self, found: list[bool], images: str, whole: bool) -> None:
        if not any(found):
            most = self.data.max_distance
            text = (
                f"none of the pixels of {images} has a known distance: all are 0 or not finite"
                + (f", or above `max_distance` {most:g} m" if most is not None else "")
                + "; a PNG must hold metres × 256 in 16 bits, a .npy file metres"
            )
            raise naming(ValueError(text), "max_distance")
