"""What a dense task does with a batch: which pixels count, and how much."""

from types import SimpleNamespace

import pytest
import torch
from scenes import write_plain

from darswin.data import IGNORE
from darswin.lens import Equidistant, KannalaBrandt, cat
from darswin.lens.pixels import pixel_angles, solid_angles
from darswin.train import pixel_task as dense
from darswin.train.pixel_task import Rays as Seen
from darswin.train.scene_data import DistanceData, LabelData
from darswin.train.segmentation import Distance, Segmentation
from darswin.train.tasks import TASKS


class Says(torch.nn.Module):
    """A network that says the same of all images."""

    def __init__(self, said):
        super().__init__()
        self.said = torch.nn.Parameter(said)

    def forward(self, images, lens):
        return self.said


class OfData:
    """A task's view of its run, without a run."""

    def __init__(self, task, data):
        self.task = task
        task._trainer = SimpleNamespace(
            datamodule=data, training=False, current_epoch=0, global_step=0
        )


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    lens = Equidistant(20.0, 1.0, image_size=(45, 60)).to(torch.float64)
    return write_plain(tmp_path_factory.mktemp("scenes"), 12, lens=lens, size=(45, 60))


def batch_of(data):
    data.setup("fit")
    dataset = data.dataset("train")
    images, lenses, targets = zip(*(dataset[k] for k in range(4)), strict=True)
    return torch.stack(images), cat(lenses), torch.stack(targets)


CASES = [
    (Segmentation, LabelData, dict(loss="ce+dice"), dict()),
    (Segmentation, LabelData, dict(ignore_index=1, solid_angle_weights=True), dict()),
    (Distance, DistanceData, dict(loss="silog"), dict()),
    (Distance, DistanceData, dict(loss="l1", solid_angle_weights=True), dict(max_distance=7.0)),
]


@pytest.mark.parametrize(("kind", "made", "options", "of_data"), CASES)
def test_what_is_said_of_pixels_that_do_not_count_changes_nothing(
    scenes, kind, made, options, of_data
):
    data = made(str(scenes), size=32, **of_data)
    batch = data.on_after_batch_transfer(batch_of(data), 0)
    _, lens, target = batch
    task = kind("darswin_unet_a_nano", **options)
    OfData(task, data)
    task._make_metrics()
    unknown = ~task._known(target)
    beyond = pixel_angles(lens, (32, 32)).isnan()
    assert beyond.any() and unknown[beyond].all() and not unknown.all()
    if options.get("ignore_index"):
        assert (unknown & ~beyond).any()
    if of_data:
        assert (unknown & ~beyond).any()
    shape = (4, 3, 32, 32) if kind is Segmentation else (4, 1, 32, 32)
    said = 1 + 5 * torch.rand(shape)
    other = torch.where(unknown[:, None], 1 + 5 * torch.rand(shape), said)
    found = []
    for values in (said, other):
        task.net = Says(values)
        loss = task._loss(batch, None)
        loss.backward()
        assert not task.net.said.grad[unknown[:, None].expand(shape)].any()
        measured = task.test_metrics[0]
        measured.sums.reset(), measured.loss.reset()
        with torch.no_grad():
            task.test_step(batch, 1)
            task.on_test_epoch_end()
        found.append((loss.item(), task.results))
    assert found[0] == found[1] and found[0][1][0]["pixels"] == (~unknown).sum()


def test_solid_angles_weigh_the_loss(scenes):
    data = DistanceData(str(scenes), size=32)
    _, lens, target = batch = batch_of(data)
    task = Distance("darswin_unet_a_nano", loss="l1", solid_angle_weights=True)
    said = 1 + 5 * torch.rand(4, 1, 32, 32)
    task.net = Says(said)
    area = solid_angles(lens, (32, 32))
    area = area / area.sum((1, 2), keepdim=True)
    known = target > 0
    expected = ((said[:, 0] - target).abs() * area)[known].sum() / area[known].sum()
    torch.testing.assert_close(task._loss(batch, None), expected)
    plain = Distance("darswin_unet_a_nano", loss="l1")
    plain.net = Says(said)
    assert plain._loss(batch, None) != task._loss(batch, None)


def test_lenses_of_a_batch_are_each_their_own():
    images, seen = torch.zeros(3, 1, 20, 24), Seen()
    several = Equidistant([8.0, 9.0, 10.0], 1.2)
    two, one = several[[0, 2, 2]], several[1]
    # Each comes after another, and after itself.
    for lens in (several, several, two, one, one, cat([one] * 3), one.with_theta_max(1.0), two):
        angles, areas = seen.of(lens, images)
        each = lens if len(lens) == 3 else cat([lens] * 3)
        torch.testing.assert_close(angles, pixel_angles(each, (20, 24)), equal_nan=True)
        torch.testing.assert_close(areas, solid_angles(each, (20, 24)))
    assert seen.of(two, torch.zeros(3, 1, 10, 12))[0].shape == (3, 10, 12)


def test_one_lens_is_asked_once_for_all_batches(monkeypatch):
    asked = []
    monkeypatch.setattr(dense, "pixel_angles", lambda *a: asked.append(a) or pixel_angles(*a))
    seen, images = Seen(), torch.zeros(2, 1, 8, 8)
    radial = [KannalaBrandt(8.0, radial=[0.1, 0.0, 0.0, 0.0]) for _ in range(2)]
    for lens in (*radial, cat(radial)):
        seen.of(lens, images)
    assert len(asked) == 1
    seen.of(KannalaBrandt(8.0), images)
    assert len(asked) == 2


def test_far_distances_are_not_known(scenes):
    data = DistanceData(str(scenes), size=32, max_distance=6.0)
    images, lens, distance = batch_of(data)
    kept = data.on_after_batch_transfer((images, lens, distance), 0)[2]
    assert (distance > 6).any() and kept.max() <= 6 and (kept > 0).any()
    near = distance <= 6
    assert torch.equal(kept[near], distance[near]) and not kept[~near].any()


def test_the_order_of_the_data_is_that_of_the_seed(scenes):
    data = LabelData(
        str(scenes), size=32, batch_size=4, workers=0, limit=9, lens_augmentation="0..1"
    )
    batches = [target for _, _, target in data.train_dataloader()]
    assert len(batches) == 2 and batches[0].shape == (4, 32, 32)
    again = LabelData(
        str(scenes), size=32, batch_size=4, workers=0, limit=9, lens_augmentation="0..1"
    )
    for (_, lens, target), before in zip(again.train_dataloader(), batches, strict=True):
        assert torch.equal(target, before) and len(lens) == 4
    assert (batches[0] == IGNORE).any()


def test_every_task_has_its_classes():
    for name, kind in TASKS.items():
        assert kind.module.task == name and kind.module.monitor[0].startswith("val/")
