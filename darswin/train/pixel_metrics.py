"""What predictions for each pixel are measured by: in all, and in zones of θ; as pixels count, and
as their solid angles do.

Sums are taken over all pixels of a test set, in integers and float64, and over all processes.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

BY_AREA = "_sr"  # ends the names of what is weighted by solid angle, in steradians
# δ1, δ2, δ3: the larger of two distances is less than so many times the other.
_RATIOS = (1.25, 1.25**2, 1.25**3)
DISTANCE_METRICS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "silog", "delta1", "delta2", "delta3")


class Zones:
    """Zones of θ between the axis and whatever a lens sees.

    Args:
        borders: degrees, rising, between zones; none makes one zone.

    Raises:
        ValueError: borders that do not rise, or are not within 0 and 180.
    """

    def __init__(self, borders: Sequence[float]):
        inner = [0.0, *map(float, borders), 180.0]
        if any(not a < b for a, b in pairwise(inner)):
            raise ValueError(
                f"--model.zones must rise, between 0 and 180 degrees, got {list(borders)}"
            )
        self.borders = inner[1:-1]

    def __len__(self) -> int:
        return len(self.borders) + 1

    def of(self, theta: Tensor) -> Tensor:
        """The number of the zone at θ (rad), of any shape; the last one's for NaN."""
        borders = torch.tensor(self.borders, dtype=theta.dtype, device=theta.device)
        return torch.bucketize(theta.rad2deg(), borders, right=True)

    def ranges(self) -> list[dict[str, Any]]:
        """Of each zone `from_deg` and `to_deg`; the last one has no end, None."""
        ends: list[float | None] = [*self.borders, None]
        starts = [0.0, *self.borders]
        return [dict(from_deg=a, to_deg=b) for a, b in zip(starts, ends, strict=True)]


class ZoneSums(Metric):
    """Base of sums over the pixels of each zone: `counts` and, weighted by solid angle, `areas`.

    Args:
        zones: how many. shape: of what is summed in each.
    """

    full_state_update = False
    counts: Tensor
    areas: Tensor

    def __init__(self, zones: int, shape: tuple[int, ...], dtype: torch.dtype = torch.float64):
        super().__init__()
        self.add_state("counts", torch.zeros(zones, *shape, dtype=dtype), "sum")
        self.add_state("areas", torch.zeros(zones, *shape, dtype=torch.float64), "sum")

    def compute(self) -> tuple[Tensor, Tensor]:
        """The sums (Z, …): as pixels count, and as solid angles do."""
        return self.counts, self.areas


class LabelSums(ZoneSums):
    """How often a pixel of class i was taken for one of class j: (Z, K, K)."""

    def __init__(self, classes: int, zones: int):
        super().__init__(zones, (classes, classes), torch.int64)
        self.classes = classes

    def update(self, predicted: Tensor, labels: Tensor, zone: Tensor, area: Tensor) -> None:
        """Counts pixels (P,): what they were taken for, what they are, their zone, their sr."""
        cell = (zone * self.classes + labels) * self.classes + predicted
        cells = self.counts.numel()
        self.counts += torch.bincount(cell, minlength=cells).view_as(self.counts)
        weighted = torch.bincount(cell, area.double(), minlength=cells)
        self.areas += weighted.view_as(self.areas)


def label_scores(confusion: Tensor, left_out: int | None = None) -> tuple[dict, Tensor, Tensor]:
    """The scores of a confusion (K, K), from truth to prediction.

    A class that neither the truth nor the prediction has does not count.

    Args:
        left_out: a class that has no part in the mean.

    Returns:
        `miou` and `accuracy`, NaN where there are no pixels; IoU and recall of each class, (K,),
        NaN where it does not occur.
    """
    confusion = confusion.double()
    right, there = confusion.diagonal(), confusion.sum(1)
    iou = _ratio(right, there + confusion.sum(0) - right)
    counted = iou.clone()
    if left_out is not None:
        counted[left_out] = torch.nan
    overall = dict(
        miou=counted.nanmean().item(), accuracy=_ratio(right.sum(), confusion.sum()).item()
    )
    return overall, iou, _ratio(right, there)


class DistanceSums(ZoneSums):
    """What the mean errors of distances are made of: (Z, 9), the first of which is the weight."""

    def __init__(self, zones: int):
        super().__init__(zones, (9,))

    def update(self, predicted: Tensor, distance: Tensor, zone: Tensor, area: Tensor) -> None:
        """Counts pixels (P,): two distances above 0 (m), their zone, their solid angle (sr)."""
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


def distance_scores(sums: Tensor) -> dict[str, float]:
    """`DISTANCE_METRICS` of sums (9,); NaN where there are no pixels.

    `silog` is 100 √(mean g² - (mean g)²), g the difference of the logarithms, over all pixels.

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
    """The value; None, which JSON has, in place of NaN, which it has not."""
    return None if math.isnan(value) else value


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, NaN where there is nothing."""
    return torch.where(whole > 0, part / torch.where(whole > 0, whole, 1), torch.nan)
