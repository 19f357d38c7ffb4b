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


def none_of_nan(value: float) -> float | None:
    """The value, or None for NaN, because JSON has no NaN."""
    return None if math.isnan(value) else value


def ratio(part: Tensor, whole: Tensor) -> Tensor:
    """part / whole, NaN where `whole` is 0."""
    return torch.where(whole > 0, part / torch.where(whole > 0, whole, 1), torch.nan)


def or_one(whole: Tensor) -> Tensor:
    """The divisor, with 1 in place of 0."""
    return torch.where(whole > 0, whole, 1.0)
