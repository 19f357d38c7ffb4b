"""Distance: metres along the ray for each pixel."""

from typing import Any

import torch
from torch import Tensor

from darswin.train.dense import DenseTask
from darswin.train.dense_data import DistanceData
from darswin.train.losses import DistanceLoss, distance_loss
from darswin.train.pixel_metrics import (
    BY_AREA,
    DistanceSums,
    distance_scores,
    none_of_nan,
)
from darswin.train.task import Batch

_SHOWN = ("abs_rel", "rmse", "delta1")  # after each epoch


class Distance(DenseTask):
    """The distance along the ray of each pixel of wide-angle images, and its errors.

    Pixels whose distance is not known, and those beyond θ_max, have no part in loss and scores.

    Args:
        name: of a model; null is that of `weights`, or darswin_unet_a_micro. From the weights of a
            classifier it is the model with that encoder.
        options: of the model, e.g. {typical_distance: 3}. With `weights` they are its own, and
            only drop_path_rate and jitter may differ.
        loss: silog, the scale-invariant error of logarithms with λ 0.85; l1, of metres; or log_l1,
            of their logarithms.
        common: as `DenseTask`.
    """

    task = "distance"
    nothing = 0
    monitor = ("val/abs_rel", "min")

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

    def _make_metrics(self) -> None:
        super()._make_metrics()
        self.val_sums = DistanceSums(1)

    def _sums(self) -> DistanceSums:
        return DistanceSums(len(self.zones))

    def _criterion(self, predicted: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        return distance_loss(predicted, target, self.loss, weights=weights)

    def _answer(self, predicted: Tensor) -> Tensor:
        return predicted[:, 0]

    def _known(self, target: Tensor) -> Tensor:
        return target > 0

    def _missing(self, there: list[bool], images: str, whole: bool) -> None:
        if not any(there):
            data = self.data
            most = data.max_distance if isinstance(data, DistanceData) else None
            raise ValueError(
                f"none of the pixels of {images} has a known distance: all are 0 or not finite"
                + (f", or above --data.max_distance {most:g} m" if most is not None else "")
                + "; a PNG must hold metres × 256 in 16 bits, an NPY file metres"
            )

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Counts a batch into the validation's loss and errors."""
        answer, known = self._said(batch, self.val_loss)
        said, truth = answer[known], batch[2][known]
        zone = torch.zeros_like(truth, dtype=torch.int64)
        self.val_sums.update(said, truth, zone, torch.ones_like(truth))
        self.log("val/loss", self.val_loss, prog_bar=True, on_step=False, on_epoch=True)

    def on_validation_epoch_end(self) -> None:
        """Logs the errors, which are the same in all processes."""
        scores = distance_scores(self.val_sums.compute()[0][0])
        self.val_sums.reset()
        for name in _SHOWN:
            self.log(f"val/{name}", scores[name], prog_bar=True)

    def _row(self, counts: Tensor, areas: Tensor) -> dict[str, Any]:
        per_zone = [
            zone | _scores(count, area)
            for zone, count, area in zip(self.zones.ranges(), counts, areas, strict=True)
        ]
        overall = _scores(counts.sum(0), areas.sum(0))
        return overall | dict(per_class={}, per_zone=per_zone)


def _scores(counts: Tensor, areas: Tensor) -> dict[str, Any]:
    """The errors of sums (9,), as pixels and as solid angles count."""
    found: dict[str, Any] = dict(pixels=round(counts[0].item()))
    for end, sums in (("", counts), (BY_AREA, areas)):
        scores = distance_scores(sums)
        found |= {f"{name}{end}": none_of_nan(value) for name, value in scores.items()}
    return found
