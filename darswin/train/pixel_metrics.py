"""Scores of predictions for each pixel, overall and in zones of θ, with and without weights.

The weights are the solid angles of the pixels. Sums are taken in integers and float64, over all
processes.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from darswin.utils.parameters import check

BY_AREA = "_sr"  # the ending of scores that are weighted by solid angle, in steradians
# δ1, δ2, δ3: the larger of two distances is less than this many times the other.
_RATIOS = (1.25, 1.25**2, 1.25**3)
DISTANCE_METRICS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "silog", "delta1", "delta2", "delta3")


class Zones:
    """Zones of θ from the axis to the edge of the view; `borders` between them in degrees."""

    def __init__(self, borders: Sequence[float]):
        inner = [0.0, *map(float, borders), 180.0]
        rising = all(a < b for a, b in pairwise(inner))
        check("zones", list(borders), rising, "increasing angles between 0 and 180 degrees")
        self.borders = inner[1:-1]

    def __len__(self) -> int:
        return len(self.borders) + 1

    def of(self, theta: Tensor) -> Tensor:
        """The number of the zone at each θ (rad), of any shape; NaN is in the last zone."""
        borders = torch.tensor(self.borders, dtype=theta.dtype, device=theta.device)
        return torch.bucketize(theta.rad2deg(), borders, right=True)

    def ranges(self) -> list[dict[str, Any]]:
        """`from_deg` and `to_deg` of each zone; the last zone ends at None."""
        ends: list[float | None] = [*self.borders, None]
        starts = [0.0, *self.borders]
        return [dict(from_deg=a, to_deg=b) for a, b in zip(starts, ends, strict=True)]


class PixelSums(Metric):
    """Base of sums over the pixels of each zone: `counts` and, weighted by solid angle, `areas`."""

    full_state_update = False
    counts: Tensor
    areas: Tensor

    def __init__(self, zones: int, shape: tuple[int, ...], dtype: torch.dtype = torch.float64):
        super().__init__()
        self.add_state("counts", torch.zeros(zones, *shape, dtype=dtype), "sum")
        self.add_state("areas", torch.zeros(zones, *shape, dtype=torch.float64), "sum")

    def compute(self) -> tuple[Tensor, Tensor]:
        """The sums (Z, …), unweighted and weighted by solid angle."""
        return self.counts, self.areas

    def pixels(self, counts: Tensor) -> int:
        """The number of pixels in the sums of a zone."""
        raise NotImplementedError

    def scores(self, sums: Tensor) -> dict[str, float]:
        """The scores of the sums of a zone; NaN without pixels."""
        raise NotImplementedError


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
        accuracy = _ratio(sums.diagonal().double().sum(), sums.double().sum())
        return dict(miou=iou.nanmean().item(), accuracy=accuracy.item())


def iou_and_recall(confusion: Tensor) -> tuple[Tensor, Tensor]:
    """IoU and recall of each class, (K,), from confusion counts (K, K) of truth and prediction; NaN
    for a class that does not occur."""
    confusion = confusion.double()
    right, present = confusion.diagonal(), confusion.sum(1)
    return _ratio(right, present + confusion.sum(0) - right), _ratio(right, present)


class DistanceSums(PixelSums):
    """Sums of the terms of the distance errors, (Z, 9); the first term is the weight."""

    def __init__(self, zones: int):
        super().__init__(zones, (9,))

    def update(self, predicted: Tensor, distance: Tensor, zone: Tensor, area: Tensor) -> None:
        """Adds pixels (P,): two distances above 0 (m), zones and solid angles (sr)."""
        predicted, distance = predicted.double(), distance.double()
        off, log = predicted - distance, predicted.log() - distance.log()
        larger = torch.maximum(predicted / distance, distance / predicted)
        terms = torch.stack((
            torch.ones_like(off), off.abs() / distance, off.square() / distance, off.square(),
            log.square(), log, *((larger < ratio).double() for ratio in _RATIOS),
        ), 1)  # fmt: skip
        for number in range(len(self.counts)):
            inside = zone == number
            self.counts[number] += terms[inside].sum(0)
            self.areas[number] += (terms[inside] * area[inside].double()[:, None]).sum(0)

    def pixels(self, counts: Tensor) -> int:
        return round(counts[0].item())

    def scores(self, sums: Tensor) -> dict[str, float]:
        """`DISTANCE_METRICS`; `silog` is 100 √(mean g² - (mean g)²), g the difference of logs.

        Source: Eigen et al., NeurIPS 2014; SILog as in KITTI's depth benchmark.
        """
        weight = sums[0].item()
        if weight == 0:
            return dict.fromkeys(DISTANCE_METRICS, math.nan)
        abs_rel, sq_rel, square, log_square, log, *deltas = (sums[1:] / weight).tolist()
        silog = 100 * math.sqrt(max(log_square - log**2, 0.0))
        found = (abs_rel, sq_rel, math.sqrt(square), math.sqrt(log_square), silog, *deltas)
        return dict(zip(DISTANCE_METRICS, found, strict=True))


def none_of_nan(value: float) -> float | None:
    """The value, or None for NaN, because JSON has no NaN."""
    return None if math.isnan(value) else value


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, NaN where `whole` is 0."""
    return torch.where(whole > 0, part / torch.where(whole > 0, whole, 1), torch.nan)
