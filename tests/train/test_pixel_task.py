"""Tasks for each pixel without a run: which pixels count, how much, and which data are refused."""

import json
from types import SimpleNamespace

import pytest
import torch
from helpers import refused
from lens_pictures import WOODSCAPE
from scenes import write_plain

from darswin.data import IGNORE
from darswin.lens import Equidistant, cat
from darswin.lens.pixels import pixel_angles, solid_angles
from darswin.models.prepared import Prepared
from darswin.train import pixel_task
from darswin.train.distance import Distance, DistanceData
from darswin.train.pixel_task import Rays
from darswin.train.results import tables
from darswin.train.segmentation import LabelData, Segmentation
from darswin.views.base import PreparedPixels

NAME = "darswin_unet_a_nano"


class Constant(torch.nn.Module):
    """A network with the same output for all images, behind a view that shows a part of them."""

    def __init__(self, output, shown=None):
        super().__init__()
        self.output, self.shown = torch.nn.Parameter(output), shown

    def prepare(self, lens, size):
        return Prepared(PreparedPixels(size, None, shown=self.shown))

    def run(self, images, prepared):
        return self.output


def attached(task, data):
    """A task with a trainer's view of its data, without a run."""
    strategy = SimpleNamespace(reduce=lambda tensor, reduce_op: tensor)
    task._trainer = SimpleNamespace(
        datamodule=data, training=False, current_epoch=0, global_step=0, world_size=1,
        global_rank=0, strategy=strategy,
    )  # fmt: skip
    return task


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    lens = Equidistant(20.0, 1.0, image_size=(45, 60)).to(torch.float64)
    return write_plain(tmp_path_factory.mktemp("scenes"), 12, lens=lens, size=(45, 60))


def batch_of(data):
    data.setup("fit")
    dataset = data.dataset("train")
    images, lenses, targets = zip(*(dataset[k] for k in range(4)), strict=True)
    return torch.stack(images), cat(lenses), torch.stack(targets)


CASES = [
    (Segmentation, dict(loss="ce+dice"), dict()),
    (Segmentation, dict(ignore_index=1, solid_angle_weights=True), dict()),
    (Distance, dict(loss="silog"), dict()),
    (Distance, dict(loss="l1", solid_angle_weights=True), dict(max_distance=7.0)),
]


def prepared(kind, folder, options, of_data=None):
    """A task with its metrics, a batch of its data, and the shape of a network's output for it."""
    data = (LabelData if kind is Segmentation else DistanceData)(
        str(folder), size=32, **of_data or {}
    )
    task = attached(kind(NAME, **options), data)
    task._make_metrics()
    batch = data.on_after_batch_transfer(batch_of(data), 0)
    return task, batch, (4, 3 if kind is Segmentation else 1, 32, 32)


@pytest.mark.parametrize(("kind", "options", "of_data"), CASES)
def test_answers_for_pixels_that_do_not_count_change_nothing(folder, kind, options, of_data):
    task, batch, shape = prepared(kind, folder, options, of_data)
    _, lens, target = batch
    shown = torch.arange(32).expand(1, 32, 32) >= 9
    asked = task._known(target)
    unknown = ~(asked & shown)
    beyond = pixel_angles(lens, (32, 32)).isnan()
    assert beyond.any() and unknown[beyond].all() and not unknown.all()
    if options.get("ignore_index") or of_data:
        assert (unknown & ~beyond).any()
    output = 1 + 5 * torch.rand(shape)
    other = torch.where(unknown[:, None], 1 + 5 * torch.rand(shape), output)
    found = []
    for values in (output, other):
        task.net = Constant(values, shown)
        loss = task._loss(batch, None)
        loss.backward()
        assert not task.net.output.grad[unknown[:, None].expand(shape)].any()
        measured = task.test_metrics[0]
        for metric in (measured.sums, measured.loss, measured.images, measured.asked):
            metric.reset()
        with torch.no_grad():
            task.test_step(batch, 1)
            task.on_test_epoch_end()
        found.append((loss.item(), task.results))
    assert found[0] == found[1]
    (row,) = task.results
    assert row["n"] == 4
    assert row["pixels"] == (~unknown).sum() == sum(zone["pixels"] for zone in row["per_zone"])
    assert row["unanswered"] == pytest.approx(((asked & ~shown).sum() / asked.sum()).item())
    assert row["unanswered"] > 0.1
    if kind is Segmentation:
        left = {"sky", "ground", "wall"} - ({"ground"} if options.get("ignore_index") else set())
        assert set(row["per_class"]) == left
        ious = [scores["iou"] for scores in row["per_class"].values()]
        assert row["miou"] == pytest.approx(sum(ious) / len(ious))


@pytest.mark.parametrize("kind", [Segmentation, Distance])
def test_validation_has_the_scores_of_a_test(folder, monkeypatch, kind):
    task, batch, shape = prepared(kind, folder, {})
    logged = {}
    monkeypatch.setattr(task, "log", lambda name, value, **_: logged.update({name: value}))
    task.net = Constant(1 + 5 * torch.rand(shape))
    with torch.no_grad():
        task.validation_step(batch, 0)
        task.test_step(batch, 1)
    task.on_validation_epoch_end()
    task.on_test_epoch_end()
    (row,) = task.results
    assert logged.pop("val/loss").compute() == pytest.approx(row["loss"])
    assert logged == {f"val/{name}": pytest.approx(row[name]) for name in task.shown}
    assert not task.val_metrics.sums.counts.any()  # the next epoch's begin anew


def test_a_set_without_targets_has_no_scores(folder):
    task, (images, lens, target), shape = prepared(Segmentation, folder, {})
    task.net = Constant(torch.rand(shape))
    task.test_step((images, lens, torch.full_like(target, IGNORE)), 0)
    with pytest.warns(UserWarning, match="compute"):
        task.on_test_epoch_end()
    (row,) = task.results
    assert row["loss"] is row["miou"] is None and row["pixels"] == 0 and task.samples == []
    assert "NaN" not in json.dumps(task.results)
    assert list(tables(task.results)) == ["test.csv", "test_classes.csv", "test_zones.csv"]


def test_solid_angles_weigh_the_loss(folder):
    options = dict(loss="l1", solid_angle_weights=True)
    task, batch, shape = prepared(Distance, folder, options)
    (_, lens, target), output = batch, 1 + 5 * torch.rand(shape)
    task.net = Constant(output)
    area = solid_angles(lens, (32, 32))
    area = area / area.sum((1, 2), keepdim=True)
    known = target > 0
    expected = ((output[:, 0] - target).abs() * area)[known].sum() / area[known].sum()
    torch.testing.assert_close(task._loss(batch, None), expected)
    plain = Distance(NAME, loss="l1")
    plain.net = Constant(output)
    assert plain._loss(batch, None) != task._loss(batch, None)


def test_lenses_of_a_batch_are_each_their_own_and_one_lens_is_computed_once(monkeypatch):
    calls = []
    monkeypatch.setattr(pixel_task, "pixel_angles", lambda *a: calls.append(a) or pixel_angles(*a))
    images, rays = torch.zeros(3, 1, 20, 24), Rays()
    several = Equidistant([8.0, 9.0, 10.0], 1.2)
    two, one = several[[0, 2, 2]], several[1]
    # Each comes after another, and after itself.
    for lens in (several, several, two, one, one, cat([one] * 3), one.with_theta_max(1.0), two):
        angles, areas = rays.of(lens, images)
        each = lens if len(lens) == 3 else cat([lens] * 3)
        torch.testing.assert_close(angles, pixel_angles(each, (20, 24)), equal_nan=True)
        torch.testing.assert_close(areas, solid_angles(each, (20, 24)))
    assert len(calls) == 5
    assert rays.of(two, torch.zeros(3, 1, 10, 12))[0].shape == (3, 10, 12)


# -- targets of a training --------------------------------------------------------------------


def trained_on(task, epochs, first=0):
    """A task's looks at the targets of epochs, which are lists of batches."""
    for epoch in epochs:
        for k, target in enumerate(epoch):
            task._trainer.is_last_batch = k == len(epoch) - 1
            task.on_train_batch_end(None, (None, None, target), first + k)
    task.on_train_end()


def labels(*ids):
    """A batch of two images with these ids, and pixels without a label."""
    return torch.tensor([[[*ids, IGNORE]]] * 2)


def of_labels(**options):
    return attached(
        Segmentation(NAME, **options), SimpleNamespace(classes=["sky", "ground", "wall"])
    )


def test_targets_without_labels_are_refused(monkeypatch):
    none = "none of the pixels of {} training images has a label"
    refused(none.format(4), trained_on, of_labels(), [[labels(), labels()]])
    monkeypatch.setattr(pixel_task, "_EARLY", 3)  # a long epoch is not waited for
    refused(none.format(6), trained_on, of_labels(), [[labels()] * 5])
    short = of_labels()  # a training shorter than an epoch
    short._trainer.is_last_batch = False
    short.on_train_batch_end(None, (None, None, labels()), 0)
    refused(none.format(2), short.on_train_end)
    other = of_labels()
    other._trainer.global_rank = 1  # the first process says it
    with pytest.raises(SystemExit):
        trained_on(other, [[labels()]])
    trained_on(of_labels(), [[labels()]], first=3)  # a resumed run


def test_absent_classes_are_named_once(recwarn):
    said = r"no pixel of 4 training images has a label of \['ground'\], which cannot be learned"
    with pytest.warns(UserWarning, match=said) as warned:
        trained_on(of_labels(), [[labels(0), labels(2)], [labels(0), labels(0)]])
    assert len(warned) == 1
    said = r"\['ground', 'wall'\], so only one class is left"
    refused(said, trained_on, of_labels(), [[labels(0)]])
    trained_on(of_labels(ignore_index=1), [[labels(0), labels(2)]])
    said = r"has a label of .*'wall'.*, so only one class"
    refused(said, trained_on, of_labels(ignore_index=0), [[labels(0, 1)]])
    assert not recwarn.list


def test_distances_that_are_not_known_are_refused():
    for most, said in ((None, "not finite; a PNG must hold"), (3.0, "above `max_distance` 3 m; ")):
        data = SimpleNamespace(max_distance=most)
        refused(said, trained_on, attached(Distance(NAME), data), [[torch.zeros(2, 4, 4)]])
        trained_on(attached(Distance(NAME), data), [[torch.ones(2, 4, 4)]])


# -- data -------------------------------------------------------------------------------------


def test_far_distances_are_not_known(folder):
    data = DistanceData(str(folder), size=32, max_distance=6.0)
    images, lens, distance = batch_of(data)
    kept = data.on_after_batch_transfer((images, lens, distance), 0)[2]
    assert (distance > 6).any() and kept.max() <= 6 and (kept > 0).any()
    near = distance <= 6
    assert torch.equal(kept[near], distance[near]) and not kept[~near].any()


def test_the_order_of_the_data_is_that_of_the_seed(folder):
    options = dict(size=32, batch_size=4, workers=0, limit=9, lens_augmentation="0..1")
    one, again = (list(LabelData(str(folder), **options).train_dataloader()) for _ in range(2))
    assert len(one) == 2 and one[0][2].shape == (4, 32, 32) and len(one[0][1]) == 4
    assert all(torch.equal(a[2], b[2]) for a, b in zip(one, again, strict=True))


def test_test_sets_have_the_classes_of_the_training(folder, tmp_path):
    other = write_plain(tmp_path / "other", 2, size=(45, 60), classes=["a", "b", "c"])
    data = LabelData(str(folder), test_paths=[str(other)])
    with pytest.raises(ValueError, match="test a model on the classes that it was trained on"):
        data.dataset("test", data.test_names[0])
    assert LabelData(str(folder), lens=str(WOODSCAPE), fit="stretch").card_fit == "stretch"
    label_map = tmp_path / "map.json"
    label_map.write_text('{"0": "above", "1": "below", "2": "below"}')
    assert LabelData(str(folder), label_map=str(label_map)).classes == ["above", "below"]


@pytest.mark.parametrize("names", [["ground", "sky", "wall"], ["sky", "ground", "wall", "car"]])
def test_a_validation_set_has_the_classes_of_the_training(tmp_path, names):
    """In their order, because labels are ids: each folder may have its own classes.json."""
    for split in ("train", "val"):
        write_plain(tmp_path, 2, size=(45, 60), split=split)
    data = LabelData(str(tmp_path))
    assert data.source("val").classes == data.classes
    (tmp_path / "val" / "classes.json").write_text(json.dumps(names))
    for split in ("val", "test"):
        said = f"its '{split}' split has the classes .*{names[0]}"
        refused(said, LabelData(str(tmp_path)).source, split)


def of_task(path, name=NAME, size=None, **options):
    return attached(Segmentation(name, **options), LabelData(path, size=size))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: LabelData(path, lens_augmentation="odd"), "lenses must be one of"),
        (lambda path: DistanceData(path, max_distance=-1), "`max_distance` must be above 0, got"),
        (lambda path: DistanceData(path, max_distance=0), "`max_distance` must be above 0, got"),
        (lambda _: Segmentation("swin_nano"), "`name` swin_nano is no model for `task` segm"),
        (lambda _: Segmentation(NAME, class_weights=[0.0, 0.0]), "and not all 0"),
        (lambda _: Segmentation(NAME, class_weights=[1.0, -1.0]), "at least 0, and not all 0"),
        (lambda _: Segmentation(NAME, label_smoothing=1), r"`label_smoothing` must be in \[0, 1\)"),
        (lambda path: of_task(path, class_weights=[1.0, 2.0])._head_options(),
         "one value for each of the 3 classes sky, ground, wall, got 2"),
        (lambda path: of_task(path, ignore_index=3)._head_options(),
         "`ignore_index` must be the id of a class, 0 to 2, or 255"),
        (lambda path: of_task(path, options=dict(num_classes=3)).configure_model(),
         "`options` cannot set num_classes"),
        (lambda path: of_task(path, "swin_unet_nano", 33).configure_model(),
         "cannot make swin_unet_nano with `size` 33: "),
    ],
)  # fmt: skip
def test_wrong_options_are_named(folder, make, message):
    refused(message, make, str(folder))
