"""The base of the tasks that predict a label or a distance for each pixel."""

from typing import Any, ClassVar

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor, nn
from torchmetrics import MeanMetric, SumMetric

from darswin.lens import Lens
from darswin.lens.pixels import pixel_angles, solid_angles
from darswin.train.pixel_metrics import BY_AREA, PixelSums, Zones, none_of_nan
from darswin.train.task import Batch, TaskModule, finite_loss
from darswin.utils.tasks import IGNORE
from darswin.viz.pixels import Row, draw_predictions

_SHOWN = 4  # samples in the figure of a test
_EARLY = 100  # batches after which a training without any target stops


class Measured(nn.Module):
    """The metrics of a data set: sums over the pixels of each zone, the mean loss, the number of
    images with a known pixel, and the number of known pixels, also of those without an answer."""

    def __init__(self, sums: PixelSums):
        super().__init__()
        self.sums, self.loss, self.images = sums, MeanMetric(), SumMetric()
        self.asked = SumMetric()


class PixelModule(TaskModule):
    """Base of the tasks that predict each pixel.

    Subclasses define `_criterion`, `_answer`, `_known`, `_check_targets`, `_sums`, `nothing` (the
    value for no answer) and `shown` (the scores that are logged after each epoch).

    Args:
        name: the model; None is the model of `weights`, or the task's default.
        options: options of the model. With `weights`, the model keeps its own options.
        learning_rate: the peak of the learning rate.
        warmup_epochs: epochs of linear warm-up; may be a fraction.
        reference_batch: images per step for which the learning rates are meant.
        zones: degrees from the axis, the borders between the zones that a test measures
            separately; null is 30, 60, 90.
        solid_angle_weights: weights the pixels in the loss by their solid angles, with a mean of 1
            in each image.
        common: as `TaskModule`.

    Attributes:
        results: after a test, a row for each test set: `data`, its name; `n`, the number of images
            with a known pixel; the scores; the scores weighted by solid angle, whose names end in
            `_sr`; `pixels`, the number of known pixels with an answer; `unanswered`, the share of
            known pixels that the model's view does not show, which the scores leave out;
            `per_class` and `per_zone`. A score without any known pixel is None.
        samples: some of the tested images, (H, W, C) uint8, with their targets and predictions,
            (H, W), ids or m.
    """

    default_model = "darswin_unet_a_micro"
    nothing: ClassVar[int]
    shown: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        name: str | None = None,
        options: dict[str, Any] | None = None,
        *,
        learning_rate: float = 1e-3,
        warmup_epochs: float = 1,
        reference_batch: int = 16,
        zones: list[float] | None = None,
        solid_angle_weights: bool = False,
        **common: Any,
    ):
        super().__init__(
            name, options, learning_rate=learning_rate, warmup_epochs=warmup_epochs,
            reference_batch=reference_batch, **common,
        )  # fmt: skip
        self.zones = Zones([30, 60, 90] if zones is None else zones)
        self.solid_angle_weights = solid_angle_weights
        self.samples: list[Row] = []
        self._rays = Rays()
        # The ids in the targets of the first epoch, (256,) bool, and the number of their images.
        self._found: Tensor | None = None
        self._images = 0

    def _make_metrics(self) -> None:
        self.val_metrics = Measured(self._sums(1))
        count = len(self.zones)
        self.test_metrics = nn.ModuleList(Measured(self._sums(count)) for _ in self.data.test_names)

    # -- defined by each task -------------------------------------------------------------------

    def _sums(self, zones: int) -> PixelSums:
        raise NotImplementedError

    def _criterion(self, predicted: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        """The loss of the model's output (B, K, H, W)."""
        raise NotImplementedError

    def _answer(self, predicted: Tensor) -> Tensor:
        """The ids or metres (B, H, W) in the model's output (B, K, H, W)."""
        raise NotImplementedError

    def _known(self, target: Tensor) -> Tensor:
        """True for pixels (B, H, W) that have a target."""
        raise NotImplementedError

    def _check_targets(self, found: list[bool], images: str, whole: bool) -> None:
        """Raises ValueError, or warns, if the training targets lack something. `found` is True for
        the ids that occur, and `whole` is True after a whole epoch."""
        raise NotImplementedError

    def _per_class(self, counts: Tensor, areas: Tensor) -> dict[str, Any]:
        return {}

    # -- training -----------------------------------------------------------------------------

    def _run(self, images: Tensor, lens: Lens) -> tuple[Tensor, Tensor]:
        """The model's output (B, K, H, W), and a mask (B or 1, H, W) of what its view shows: there
        alone it has an answer."""
        prepared = self.net.prepare(lens, (images.shape[2], images.shape[3]))
        predicted = self.net.run(images, prepared).float()
        if prepared.view.shown is None:
            return predicted, predicted.new_ones(1, 1, 1, dtype=torch.bool)
        return predicted, prepared.view.shown.to(predicted.device)

    def _loss(self, batch: Batch, rng: np.random.Generator) -> Tensor:
        images, lens, target = batch
        weights = None
        if self.solid_angle_weights:
            area = solid_angles(lens.merged(), (images.shape[2], images.shape[3]))
            weights = (area / area.mean((1, 2), keepdim=True)).to(images.device)
            weights = weights.expand(len(images), -1, -1)
        predicted, shown = self._run(images, lens)
        return self._criterion(predicted, torch.where(shown, target, self.nothing), weights)

    def on_train_batch_end(self, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Collects the ids in the targets of the first epoch. They are checked after the epoch, or
        earlier if it is long; only the check waits for a GPU."""
        target = batch[2]
        if batch_idx == 0 and self._images == 0:
            self._found = torch.zeros(IGNORE + 1, dtype=torch.bool, device=target.device)
        if self._found is None:  # in the middle of an epoch after a resume, or after the first one
            return
        ids = torch.zeros_like(target, dtype=torch.int64) if target.is_floating_point() else target
        self._found.scatter_(0, torch.where(self._known(target), ids, IGNORE).flatten(), True)
        self._images += len(target) * self.trainer.world_size
        whole = self.trainer.is_last_batch
        if whole or batch_idx + 1 == _EARLY:
            self._check_found(self._found, whole)
        if whole:
            self._found = None

    def on_train_end(self) -> None:
        """Checks the targets of a training that was shorter than an epoch."""
        if self._found is not None:
            self._check_found(self._found, False)

    def _check_found(self, found: Tensor, whole: bool) -> None:
        total: Any = self.trainer.strategy.reduce(found.int(), reduce_op="sum")
        ids = total[:IGNORE].bool().tolist()
        try:
            self._check_targets(ids, f"{self._images} training images", whole)
        except ValueError:
            if self.global_rank:  # an error here would make Lightning kill the first process
                raise SystemExit from None
            raise

    # -- evaluation ---------------------------------------------------------------------------

    def _predict(self, batch: Batch, measured: Measured) -> tuple[Tensor, Tensor]:
        """The answer for each pixel and a mask of the known pixels that have one; adds the loss of
        these."""
        images, lens, target = batch
        measured.asked.update(self._known(target).sum())
        predicted, shown = self._run(images, lens.merged())
        target = torch.where(shown, target, self.nothing)
        known = self._known(target)
        if known.any():
            measured.loss.update(self._criterion(predicted, target, None), weight=known.sum())
        return torch.where(shown, self._answer(predicted), self.nothing), known

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Adds a batch to the loss and scores of the validation."""
        answer, known = self._predict(batch, self.val_metrics)
        answer, truth = answer[known], batch[2][known]
        zone = torch.zeros_like(truth, dtype=torch.int64)
        self.val_metrics.sums.update(answer, truth, zone, torch.ones_like(zone))
        self.log("val/loss", self.val_metrics.loss, prog_bar=True, on_step=False, on_epoch=True)

    def on_validation_epoch_end(self) -> None:
        """Logs the scores; they are the same in all processes."""
        counts, _ = self.val_metrics.sums.compute()
        scores = self.val_metrics.sums.scores(counts[0])
        self.val_metrics.sums.reset()
        for name in self.shown:
            self.log(f"val/{name}", scores[name], prog_bar=True)

    def on_test_start(self) -> None:
        """Removes the samples of an earlier test."""
        self.samples = []

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Adds the pixels of a batch to the sums of its test set."""
        measured: Any = self.test_metrics[dataloader_idx]
        images, lens, target = batch
        answer, known = self._predict(batch, measured)
        theta, area = self._rays.of(lens, images)
        zone = self.zones.of(theta)
        measured.images.update(known.flatten(1).any(1).sum())
        measured.sums.update(answer[known], target[known], zone[known], area[known])
        if batch_idx == 0:
            # Beyond the lens's view an answer has no meaning.
            seen = torch.where(theta.isnan(), self.nothing, answer)
            self._keep_samples(images, target, seen, known)

    def _keep_samples(self, images: Tensor, target: Tensor, answer: Tensor, known: Tensor) -> None:
        """Adds the first images of a test set to `samples`."""
        mean, std = (images.new_tensor(v)[:, None, None] for v in (self.data.mean, self.data.std))
        count = max(_SHOWN // len(self.test_metrics), 1)
        for k in range(min(count, len(images), _SHOWN - len(self.samples))):
            if not known[k].any():
                continue  # a picture that could not be read
            pixels = ((images[k] * std + mean) * 255).round().clamp(0, 255).to(torch.uint8)
            arrays = (pixels.permute(1, 2, 0), target[k], answer[k])
            image, truth, prediction = (array.cpu().numpy() for array in arrays)
            self.samples.append((image, truth, prediction))

    def on_test_epoch_end(self) -> None:
        """Collects `results`: a row for each test set."""
        self.results = []
        measured: Any
        for name, measured in zip(self.data.test_names, self.test_metrics, strict=True):
            counts, areas = measured.sums.compute()
            scores = _scores(measured.sums, counts.sum(0), areas.sum(0))
            loss = measured.loss.compute().item()
            loss = finite_loss(loss, name) if scores["pixels"] else None
            per_zone = [
                zone | _scores(measured.sums, count, area)
                for zone, count, area in zip(self.zones.ranges(), counts, areas, strict=True)
            ]
            per_class = self._per_class(counts.sum(0), areas.sum(0))
            nested = dict(per_class=per_class, per_zone=per_zone)
            row = {"data": name, "n": int(measured.images.compute())}
            asked = measured.asked.compute().item()
            unanswered = 1 - scores["pixels"] / asked if asked else None
            self.results.append(row | scores | dict(unanswered=unanswered, loss=loss) | nested)

    def results_figure(self) -> Figure | None:
        """A figure of the samples: images, targets and predictions."""
        if not self.samples:
            return None
        return draw_predictions(self.samples, self.card.classes, self.card.colors)


def _scores(sums: PixelSums, counts: Tensor, areas: Tensor) -> dict[str, Any]:
    """The scores of sums over pixels, unweighted and weighted by solid angle."""
    found: dict[str, Any] = dict(pixels=sums.pixels(counts))
    for end, summed in (("", counts), (BY_AREA, areas)):
        scores = sums.scores(summed)
        found |= {f"{name}{end}": none_of_nan(value) for name, value in scores.items()}
    return found


class Rays:
    """Angles and solid angles of pixels, kept for the next batch if its lenses are the same."""

    def __init__(self) -> None:
        self._lens: Lens | None = None
        self._angles = self._areas = torch.empty(0)

    def of(self, lens: Lens, images: Tensor) -> tuple[Tensor, Tensor]:
        """`pixel_angles` and `solid_angles` of each image, (B, H, W), on its device."""
        size = (images.shape[2], images.shape[3])
        lens = lens.merged()
        known = self._angles.shape[1:] == size and self._angles.device == images.device
        if not known or not lens.same_as(self._lens):
            self._angles = pixel_angles(lens, size).to(images.device)
            self._areas = solid_angles(lens, size).to(images.device)
            self._lens = lens
        shape = (len(images), *size)
        return self._angles.expand(shape), self._areas.expand(shape)
