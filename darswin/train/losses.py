"""Losses of predictions for each pixel; they are 0 for a batch without any known pixel."""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.data.scenes.targets import IGNORE

__all__ = ["distance_loss", "label_loss"]

LabelLoss = Literal["ce", "dice", "ce+dice"]
DistanceLoss = Literal["silog", "l1", "log_l1"]

_LAMBDA, _SCALE = 0.85, 10.0  # of SILog
_LEAST = 1e-6  # added below the root, whose slope at 0 is infinite; also the least distance, m


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
        loss = loss + each.sum() / _or_one(share.sum())
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
    missed = torch.where(present, 1 - 2 * both / _or_one(either), 0.0)
    counts = present.to(logits.dtype) if class_weights is None else present * class_weights
    return (missed * counts).sum() / _or_one(counts.sum())


def distance_loss(
    predicted: Tensor,
    distance: Tensor,
    kind: DistanceLoss = "silog",
    *,
    weights: Tensor | None = None,
) -> Tensor:
    """SILog, or the mean absolute error of distances or of their logarithms.

    SILog is 10 √(mean g² - 0.85 (mean g)²) over all known pixels of the batch, where g is the
    difference of the logarithms.

    Args:
        predicted: (B, 1, H, W), m. distance: (B, H, W), m, 0 where it is unknown.
        weights: (B, H, W), the weight of each pixel; None weights all by 1.

    Returns:
        A scalar.

    Source: Eigen et al., NeurIPS 2014, with λ and the scale of BTS (Lee et al., 1907.10326).
    """
    predicted = predicted[:, 0]
    known = distance > 0
    share = known.to(predicted.dtype) if weights is None else known * weights
    whole = _or_one(share.sum())

    def mean(values: Tensor) -> Tensor:
        return (values * share).sum() / whole

    truth = torch.where(known, distance, 1.0)
    if kind == "l1":
        return mean((predicted - truth).abs())
    difference = predicted.clamp(min=_LEAST).log() - truth.log()
    if kind == "log_l1":
        return mean(difference.abs())
    spread = mean(difference.square()) - _LAMBDA * mean(difference).square()
    return _SCALE * ((spread.clamp(min=0) + _LEAST).sqrt() - _LEAST**0.5)


def _or_one(whole: Tensor) -> Tensor:
    """The divisor, with 1 in place of 0."""
    return torch.where(whole > 0, whole, 1.0)
