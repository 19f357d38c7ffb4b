"""What the tasks that say something of each pixel share: their pixels, zones, test and samples."""

from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric

from darswin.lens import Lens
from darswin.lens.pixels import pixel_angles, solid_angles
from darswin.train.dense_data import DenseData
from darswin.train.pixel_metrics import Zones, ZoneSums
from darswin.train.target_check import TargetCheck
from darswin.train.task import Batch, Task, finite_loss

_SHOWN = 4  # samples of a test's picture


class Sample(NamedTuple):
    """Attributes: image: (H, W, C) uint8; lens: its lens; target, prediction: (H, W), ids or m."""

    image: np.ndarray
    lens: Lens
    target: np.ndarray
    prediction: np.ndarray


class Measured(nn.Module):
    """What a test counts of a set: its pixels in each zone, and the mean loss."""

    def __init__(self, sums: ZoneSums):
        super().__init__()
        self.sums, self.loss = sums, MeanMetric()


class DenseTask(Task):
    """Base of the tasks for each pixel. A task defines `_criterion`, `_answer`, `_known`,
    `_missing`, `_sums`, `_row` and `nothing`, what stands for no answer.

    Args:
        name: of a model; None is that of `weights`, or the task's own default.
        options: of the model. With `weights` they are its own.
        learning_rate: its peak.
        warmup_epochs: of linear warm-up; may be a fraction.
        reference_batch: images that the rates are meant for.
        zones: degrees from the axis, between the zones that a test measures one by one; null is
            30, 60, 90.
        solid_angle_weights: pixels count in the loss as their solid angles do, of which the mean is
            1 in each image.
        common: as `Task`.

    Attributes:
        results: after a test a row for each set: `data`, its name; the scores, and again with
            solid angles as weights, named `…_sr`; `pixels`, how many were known; `per_class` and
            `per_zone`. What nothing is known of is None.
        samples: some of what was tested, with what was said of it.
    """

    default_model = "darswin_unet_a_micro"
    nothing: ClassVar[int]

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
        self.samples: list[Sample] = []
        self._seen = Seen()
        self._targets = TargetCheck()

    @property
    def data(self) -> DenseData:
        """The data of the run."""
        return self.trainer.datamodule  # type: ignore[attr-defined]  # Lightning attaches it

    def _make_metrics(self) -> None:
        self.val_loss = MeanMetric()
        self.test_metrics = nn.ModuleList(Measured(self._sums()) for _ in self.data.test_names)

    def _sums(self) -> ZoneSums:
        """What a test counts, in each zone."""
        raise NotImplementedError

    # -- what a task defines ------------------------------------------------------------------

    def _criterion(self, predicted: Tensor, target: Tensor, weights: Tensor | None) -> Tensor:
        """The loss of what the model says, (B, K, H, W)."""
        raise NotImplementedError

    def _answer(self, predicted: Tensor) -> Tensor:
        """What the model says, (B, K, H, W) → ids or metres, (B, H, W)."""
        raise NotImplementedError

    def _known(self, target: Tensor) -> Tensor:
        """Which pixels of (B, H, W) have a target."""
        raise NotImplementedError

    def _missing(self, there: list[bool], images: str, whole: bool) -> None:
        """Stops or warns if something is missing in the training targets.

        Args:
            there: which ids the known pixels have had; of distances, whether any is known.
            images: what has been looked at, in words. whole: whether that is a whole epoch.

        Raises:
            ValueError: targets that nothing can be learned from.
        """
        raise NotImplementedError

    def _row(self, counts: Tensor, areas: Tensor) -> dict[str, Any]:
        """A row of `results`, from what `_sums` counted."""
        raise NotImplementedError

    # -- steps --------------------------------------------------------------------------------

    def _loss(self, batch: Batch, rng: np.random.Generator) -> Tensor:
        images, lens, target = batch
        weights = None
        if self.solid_angle_weights:
            area = solid_angles(lens.merged(), (images.shape[2], images.shape[3]))
            weights = (area / area.mean((1, 2), keepdim=True)).to(images.device)
            weights = weights.expand(len(images), -1, -1)
        return self._criterion(self.net(images, lens).float(), target, weights)

    def _said(self, batch: Batch, loss: MeanMetric) -> tuple[Tensor, Tensor]:
        """What is said of each pixel, and which of them are known; counts the loss of these."""
        images, lens, target = batch
        predicted = self.net(images, lens.merged()).float()
        known = self._known(target)
        if known.any():
            loss.update(self._criterion(predicted, target, None), weight=known.sum())
        return self._answer(predicted), known

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        """Counts the pixels of a batch into the sums of its set."""
        measured = self.test_metrics[dataloader_idx]
        assert isinstance(measured, Measured)
        images, lens, target = batch
        answer, known = self._said(batch, measured.loss)
        theta, area = self._seen.of(lens, images)
        zone = self.zones.of(theta)
        measured.sums.update(answer[known], target[known], zone[known], area[known])
        if batch_idx == 0:
            # What is said where the lens sees nothing has no meaning.
            seen = torch.where(theta.isnan(), self.nothing, answer)
            self._keep(images, lens, target, seen, known)

    def on_train_batch_end(self, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Looks at the targets of the first whole epoch."""
        self._targets.add(self, batch[2], batch_idx)

    def on_train_end(self) -> None:
        """Looks at the targets of a training that was shorter than an epoch."""
        self._targets.end(self)

    def on_test_start(self) -> None:
        """Forgets the samples of a test before."""
        self.samples = []

    def _keep(
        self, images: Tensor, lens: Lens, target: Tensor, answer: Tensor, known: Tensor
    ) -> None:
        """Adds the first images of a set to `samples`."""
        mean, std = (images.new_tensor(v)[:, None, None] for v in (self.data.mean, self.data.std))
        count = max(_SHOWN // len(self.test_metrics), 1)
        for k in range(min(count, len(images), _SHOWN - len(self.samples))):
            if not known[k].any():
                continue  # of a picture that could not be read
            pixels = ((images[k] * std + mean) * 255).round().clamp(0, 255).to(torch.uint8)
            self.samples.append(Sample(
                pixels.permute(1, 2, 0).cpu().numpy(), lens[k if len(lens) > 1 else 0].to("cpu"),
                target[k].cpu().numpy(), answer[k].cpu().numpy(),
            ))  # fmt: skip

    def on_test_epoch_end(self) -> None:
        """Collects `results`: a row for each set."""
        self.results = []
        for name, measured in zip(self.data.test_names, self.test_metrics, strict=True):
            assert isinstance(measured, Measured)
            counts, areas = measured.sums.compute()
            row = {"data": name} | self._row(counts, areas)
            loss = measured.loss.compute().item()
            row["loss"] = finite_loss(loss, name) if row["pixels"] else None
            per_class, per_zone = row.pop("per_class"), row.pop("per_zone")
            self.results.append(row | dict(per_class=per_class, per_zone=per_zone))


class Seen:
    """What lenses see in each pixel; kept for the next batch: a test set often has one lens."""

    def __init__(self) -> None:
        self._lens: Lens | None = None
        self._angles = torch.empty(0)
        self._areas = torch.empty(0)

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
