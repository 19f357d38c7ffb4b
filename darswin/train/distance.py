"""Distance, metres along the ray for each pixel: its task, data, loss and scores."""

import math
from typing import Any, Literal

import torch
from torch import Tensor

from darswin.train.pixel_metrics import PixelSums, or_one
from darswin.train.pixel_task import PixelModule
from darswin.train.scene_data import SceneData
from darswin.train.task import Batch
from darswin.utils.parameters import check, naming

DistanceLoss = Literal["silog", "l1", "log_l1"]
METRICS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "silog", "delta1", "delta2", "delta3")

_LAMBDA, _SCALE = 0.85, 10.0  # of SILog
_LEAST = 1e-6  # added below the root, whose slope at 0 is infinite; also the least distance, m
# δ1, δ2, δ3: the larger of two distances is less than this many times the other.
_RATIOS = (1.25, 1.25**2, 1.25**3)


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
    whole = or_one(share.sum())

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
        """`METRICS`; `silog` is 100 √(mean g² - (mean g)²), g the difference of logs.

        Source: Eigen et al., NeurIPS 2014; SILog as in KITTI's depth benchmark.
        """
        weight = sums[0].item()
        if weight == 0:
            return dict.fromkeys(METRICS, math.nan)
        abs_rel, sq_rel, square, log_square, log, *deltas = (sums[1:] / weight).tolist()
        silog = 100 * math.sqrt(max(log_square - log**2, 0.0))
        found = (abs_rel, sq_rel, math.sqrt(square), math.sqrt(log_square), silog, *deltas)
        return dict(zip(METRICS, found, strict=True))


class Distance(PixelModule):
    """Predicts the distance along the ray for each pixel of wide-angle images.

    The loss and the scores ignore pixels of unknown distance and pixels beyond θ_max.

    Args:
        name: the model; null is the model of `weights`, or darswin_unet_a_micro. If `weights` is a
            classifier, it is the dense model with that encoder.
        options: options of the model, e.g. {typical_distance: 3}. With `weights`, the model keeps
            its own options; only drop_path_rate and jitter may differ.
        loss: silog (the scale-invariant logarithmic error with λ = 0.85), l1 (the mean absolute
            error in metres) or log_l1 (the mean absolute error of the logarithms).
        common: as `PixelModule`.
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


class DistanceData(SceneData):
    """Scenes with a distance for each pixel.

    Args:
        path: a folder of scenes: see `darswin.data.open_scenes`.
        max_distance: m; larger distances count as unknown. null has no limit.
        common: as `SceneData`.
    """

    target = "distance"

    def __init__(self, path: str, *, max_distance: float | None = None, **common: Any):
        super().__init__(path, **common)
        if max_distance is not None:
            check("max_distance", max_distance, 0 < max_distance < math.inf, "above 0")
        self.max_distance = max_distance

    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """The batch, with distances above `max_distance` as unknown."""
        if self.max_distance is None:
            return batch
        images, lens, distance = batch
        return images, lens, torch.where(distance > self.max_distance, 0.0, distance)
