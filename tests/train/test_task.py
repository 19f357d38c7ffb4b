"""Parts of tasks and runs that need no run: optimiser, metrics, results, data, devices, checkpoints
and options."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import yaml
from helpers import refused
from lens_pictures import WOODSCAPE, write_frames
from runs import DIGITS, error
from scenes import write, write_plain
from scipy.stats import binomtest
from torch import nn
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR
from torchmetrics.classification import MulticlassAccuracy

from darswin import create_model, lens
from darswin.cli.options import PRESETS
from darswin.models.saving import ModelCard
from darswin.train.classification import Classification, ClassMetrics, wilson
from darswin.train.data import WideAngleData
from darswin.train.distance import DistanceData
from darswin.train.results import WriteResults
from darswin.train.runs import BestCheckpoint
from darswin.train.segmentation import LabelData, Segmentation
from darswin.train.task import Schedule, parameter_groups

# -- optimiser --------------------------------------------------------------------------------


def rates(schedule_of, steps):
    """The learning rate of each step, of AdamW with a peak of 1e-3."""
    optimizer = torch.optim.AdamW([nn.Parameter(torch.zeros(1))], lr=1e-3)
    schedule = schedule_of(optimizer)
    found = []
    for _ in range(steps):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return found


def test_a_line_up_then_torch_s_cosine_from_step_0():
    steps, warmup = 200, 20
    ours = dict(peak=1e-3, warmup=1e-6, final=1e-5, warmup_steps=warmup, steps=steps)
    found = rates(lambda optimizer: Schedule(optimizer, **ours), steps + 10)
    line = rates(lambda optimizer: LinearLR(optimizer, 1e-3, total_iters=warmup), warmup)
    cosine = rates(lambda optimizer: CosineAnnealingLR(optimizer, steps, 1e-5), steps)
    torch.testing.assert_close(found[:warmup], line)
    torch.testing.assert_close(found[warmup:steps], cosine[warmup:])
    torch.testing.assert_close(found[steps:], [1e-5] * 10)  # the end stays
    without = rates(lambda optimizer: Schedule(optimizer, **ours | dict(warmup_steps=0)), steps)
    torch.testing.assert_close(without, cosine)


def test_matrices_decay_and_nothing_else():
    model = create_model("darswin_a_nano", num_classes=4)
    decayed, others = parameter_groups(model, 0.05, model.no_weight_decay())
    assert decayed["weight_decay"] == 0.05 and others["weight_decay"] == 0
    matrices = {id(m.weight) for m in model.modules() if isinstance(m, nn.Linear | nn.Conv2d)}
    assert {id(p) for p in decayed["params"]} == matrices
    assert len(decayed["params"]) + len(others["params"]) == len(list(model.parameters()))
    with_biases, _ = parameter_groups(model, 0.05, ())
    assert len(with_biases["params"]) > len(decayed["params"])
    layer = nn.Linear(2, 2)
    layer.weight.requires_grad_(False)  # frozen parameters are left out
    assert [len(g["params"]) for g in parameter_groups(layer, 0.1, ())] == [0, 1]


# -- classification ---------------------------------------------------------------------------


def test_targets_smooth_as_torch_does_and_a_broken_picture_weighs_nothing():
    logits, labels = torch.randn(6, 4, requires_grad=True), torch.tensor([0, 1, 2, 3, 1, 1])
    task = Classification("darswin_a_nano", label_smoothing=0.1)
    expected = F.cross_entropy(logits, labels, label_smoothing=0.1)
    torch.testing.assert_close(F.cross_entropy(logits, task._targets(labels, 4)), expected)
    labels[1] = -1
    F.cross_entropy(logits, task._targets(labels, 4)).backward()
    assert (logits.grad[1] == 0).all() and (logits.grad[0] != 0).all()


def test_metrics_are_those_of_torchmetrics_and_leave_broken_pictures_out():
    measured, logits = ClassMetrics(8), torch.randn(60, 8)
    labels = torch.randint(-1, 8, (60,))
    for part in (slice(0, 40), slice(40, 60), slice(60, 60)):
        measured.update(logits[part], labels[part])
    logits, labels = logits[labels >= 0], labels[labels >= 0]
    for name, k in (("top1", 1), ("top5", 5)):
        expected = MulticlassAccuracy(8, average="micro", top_k=k)(logits, labels)
        torch.testing.assert_close(measured.all()[name].compute(), expected)
    torch.testing.assert_close(measured.loss.compute(), F.cross_entropy(logits, labels))
    assert measured.loss.count == len(labels) < 60
    # With up to five classes all answers are among the first five.
    assert {*ClassMetrics(5).all()} == {"top1", "loss"} and "top5" in ClassMetrics(6).all()


# -- results of tests -------------------------------------------------------------------------


@pytest.mark.parametrize(("right", "n"), [(0, 1), (1, 1), (7, 12), (96, 96), (0, 40), (500, 1000)])
def test_the_interval_is_wilson_s(right, n):
    expected = binomtest(right, n).proportion_ci(0.95, "wilson")
    assert wilson(right / n, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.fixture
def tested(tmp_path, capsys, monkeypatch):
    """A function: labels and the share of right answers of each test set → the task, and what is
    printed of its results."""

    def make(sets):
        task = Classification("darswin_a_nano")
        task.card = task.trained = ModelCard("darswin_a_nano", {}, list("abc"), 32, 2.8)
        data = SimpleNamespace(test_names=list(sets), train_lenses=None)
        monkeypatch.setattr(Classification, "data", data)
        task.test_metrics = torch.nn.ModuleList(ClassMetrics(3) for _ in sets)
        for metrics, (labels, right) in zip(task.test_metrics, sets.values(), strict=True):
            truth = torch.tensor(labels, dtype=torch.int64)
            answers = (truth + (torch.arange(len(truth)) >= right)) % 3
            metrics.update(torch.nn.functional.one_hot(answers, 3).float(), truth)
        task.on_test_epoch_end()
        WriteResults(tmp_path).on_test_end(None, task)
        return task.results, capsys.readouterr().out, task.results_figure()

    return make


def test_a_test_says_how_many_pictures_and_how_sure_it_is(tested):
    labels = [0] * 14 + [1] * 6 + [2] * 4
    rows, said, figure = tested({"0": (labels, 20), "0.5": (labels, 14)})
    assert [row["n"] for row in rows] == [24, 24]
    assert rows[0]["most_frequent"] == pytest.approx(14 / 24)
    assert (rows[0]["top1_low"], rows[0]["top1_high"]) == pytest.approx(wilson(20 / 24, 24))
    heads, first, second = said.strip().splitlines()[:3]
    for word in ("n", "top1 (%)", "95 % interval", "most frequent class (%)"):
        assert word in heads
    assert "64.1–93.3" in first and "58.33" in second and "24" in first
    assert "On 0.5, the accuracy is not certainly above that of always" in said
    axes = figure.axes[0]
    assert axes.get_title() == "n = 24"
    names = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"95 % interval", "most frequent class"} <= {*names}


def test_other_test_sets_are_bars_and_may_be_empty(tested):
    rows, said, figure = tested({"polynomial": ([0, 1, 2] * 20, 60), "low": ([], 0)})
    assert rows[1]["n"] == 0 and rows[1]["loss"] is rows[1]["top1_low"] is None
    assert "certainly" not in said
    assert figure.axes[0].get_title() == "n = 0–60"


# -- data -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("side", "options", "size"),
    [(200, {}, 64), (50, {}, 50), (20, {}, 32), (200, dict(size=96), 96), (50, dict(size=20), 20)],
)
def test_pictures_decide_on_size_and_channels(tmp_path, side, options, size):
    for channels, split, others in ((3, "train", "val"), (1, "val", "train")):
        picture = np.zeros((side, 300, channels), np.uint8)
        for k in range(4):
            write(tmp_path / "colour" / split / "ab"[k % 2] / f"{k}.png", picture)
            write(tmp_path / "grey" / others / "ab"[k % 2] / f"{k}.png", picture)
    for name, channels in (("colour", 3), ("grey", 1)):  # as the training pictures are
        data = WideAngleData(str(tmp_path / name), **options)
        assert (data.size, data.channels, len(data.mean)) == (size, channels, len(data.std))
        assert data.dataset("val")[0][0].shape == (channels, size, size)
    grey = WideAngleData(str(tmp_path / "colour"), channels=1, **options)
    assert grey.mean == [0.449] and grey.dataset("val")[0][0].shape == (1, size, size)


def test_lens_augmentation_is_for_training():
    options = dict(train_lenses="0", lens_augmentation="0.5..1", workers=0, limit=32)
    data = WideAngleData("digits", batch_size=32, render=32, **options)
    _, lenses, _ = next(iter(data.train_dataloader()))
    assert lenses.xi.min() >= 0.5 and lenses.xi.max() - lenses.xi.min() > 0.3
    assert data.dataset("val")[0][1].xi == 0


def test_a_crop_is_told_once(tmp_path, recwarn):
    """For pictures of a camera if it is asked for, and for others by default."""
    write_plain(tmp_path / "scenes", 6)
    write_frames(tmp_path / "frames", count=40, classes="01")
    scenes, frames = str(tmp_path / "scenes"), str(tmp_path / "frames")
    for kind, path, own, fit in (
        (LabelData, scenes, {}, "stretch"),
        (DistanceData, scenes, {}, "stretch"),
        (WideAngleData, frames, {"lens": str(WOODSCAPE)}, "stretch"),
        (WideAngleData, frames, {"test_lenses": "0"}, "crop"),
    ):
        for options in ({}, {"fit": "crop"}, {"fit": "stretch"}):
            data = kind(path, workers=0, batch_size=1, **own, **options)
            assert data.fit == options.get("fit", fit)
            recwarn.clear()
            for loader in (data.train_dataloader(), data.val_dataloader(), *data.test_dataloader()):
                next(iter(loader))
            said = [str(warning.message) for warning in recwarn if "cuts" in str(warning.message)]
            assert len(said) == (data.fit == "crop")
            for text in said:
                assert text.startswith("`fit` crop cuts off 19 px at the left and 20 px at the rig")
                assert text.endswith("; `fit` stretch keeps it")


def test_presets_leave_size_and_channels_to_the_pictures():
    data = yaml.safe_load((PRESETS / "minutes.yaml").read_text())["data"]
    assert not {"size", "channels", "mean", "std"} & data.keys()
    digits = WideAngleData("digits", **data)
    assert (digits.size, digits.channels) == (32, 1)


# -- devices ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["cuda", "cpu"])
def test_memory_is_pinned_for_a_gpu_alone(kind):
    data = WideAngleData("digits", workers=0)
    strategy = SimpleNamespace(root_device=torch.device(kind))
    data.trainer = SimpleNamespace(strategy=strategy, global_rank=0, world_size=1)
    for loader in (data.train_dataloader(), data.val_dataloader()):
        assert loader.pin_memory == (kind == "cuda")


def test_a_batch_moves_with_its_lenses():
    batch = [torch.randn(2, 3, 8, 8), lens.Equidistant([20.0, 21.0], 1.2), torch.tensor([1, 2])]
    moved = WideAngleData("digits").transfer_batch_to_device(batch, torch.device("meta"), 0)
    images, lenses, labels = moved
    assert images.device.type == labels.device.type == lenses.theta_max.device.type == "meta"
    assert isinstance(lenses, lens.Equidistant) and len(lenses) == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_one_line(tmp_path, capsys):
    said = error(capsys, "fit", "--run", tmp_path, *DIGITS, "--trainer.accelerator", "gpu")
    assert "darswin: No supported gpu backend found!" in said and "Traceback" not in said


# -- checkpoints ------------------------------------------------------------------------------


def test_a_moved_run_keeps_its_best(tmp_path):
    before, after = tmp_path / "before", tmp_path / "after"
    first = BestCheckpoint(before, filename="best", monitor="val/top1", mode="max")
    first.best_model_score = first.current_score = torch.tensor(0.9)
    first.best_model_path = first.kth_best_model_path = str(before / "best.ckpt")
    first.best_k_models = {str(before / "best.ckpt"): torch.tensor(0.9)}
    moved = BestCheckpoint(after, filename="best", monitor="val/top1", mode="max")
    moved.load_state_dict(first.state_dict())
    assert moved.best_model_score == 0.9 and moved.best_model_path == str(after / "best.ckpt")
    assert list(moved.best_k_models) == [str(after / "best.ckpt")]
    strategy = SimpleNamespace(reduce_boolean_decision=lambda decision, all=True: decision)
    assert not moved.check_monitor_top_k(SimpleNamespace(strategy=strategy), torch.tensor(0.5))


def test_a_checkpoint_of_another_model_is_refused():
    options = dict(num_classes=4, in_chans=1)
    task = Classification("darswin_a_nano")
    task.card = ModelCard("darswin_a_nano", options, list("abcd"), 32, 2.8)
    ours = vars(task.card)
    # A model may be measured on pictures that come to it in another way.
    for same in ({}, {"fit": "crop", "fov": 0.0}, {"colors": [[0, 0, 0]]}):
        task.on_load_checkpoint({"darswin": ours | same, "steps_per_epoch": 7})
    for other, said in (
        ({"options": options | {"embed_dim": 12}}, "embed_dim 12 there, None here"),
        ({"size": 64}, "size 64 there, 32 here"),
        ({"fov": 2.0}, "fov 2.0 there, 2.8 here"),
        ({"classes": list("abce")}, "classes"),
    ):
        said = f"belongs to another model: {said}"
        refused(said, task.on_load_checkpoint, {"darswin": ours | other})


# -- options ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Classification, Segmentation])
def test_one_class_is_not_enough(kind):
    task = kind()
    task._trainer = SimpleNamespace(datamodule=SimpleNamespace(classes=["a"]))
    refused(r"needs at least two classes, but the data has \['a'\]", task._head_options)
    task.data.classes += ["b"]
    assert task._head_options()["num_classes"] == 2


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Classification("resnet"), "unknown model 'resnet'"),
        (lambda: Classification("swin_unet_nano"), "`name` swin_unet_nano is no model for `task`"),
        (lambda: Classification(label_smoothing=1.0), r"`label_smoothing` must be in \[0, 1\)"),
        (lambda: Classification(learning_rate=0), "`learning_rate` must be above 0, got 0"),
        (lambda: Classification(learning_rate=torch.nan), "`learning_rate` must be above 0, got n"),
        (lambda: Classification(reference_batch=0), "`reference_batch` must be above 0"),
        (lambda: Classification(weight_decay=-1), "`weight_decay` must be at least 0"),
        (lambda: Classification(warmup_epochs=torch.inf), "`warmup_epochs` must be at least 0"),
        (lambda: Classification(freeze_stages=1), "`freeze_stages` 1 .*: give `weights`"),
        (lambda: WideAngleData("digits", batch_size=0), "`batch_size` must be at least 1"),
        (lambda: WideAngleData("digits", workers=-1), "`workers` must be at least 0, got -1"),
        (lambda: WideAngleData("digits", camera="7"), "`camera` 7 needs a calibration: give"),
        (lambda: WideAngleData("digits", coefficients="pinhole"), "`coefficients` pinhole needs"),
        (lambda: WideAngleData("digits", mean=[0.5, 0.5]).mean, "`mean` must have 1 values"),
        (lambda: WideAngleData("digits", channels=3, std=[0.5]).std, "`std` must have 3 values"),
    ],
)  # fmt: skip
def test_wrong_options_are_named(make, message):
    refused(message, make, error=(ValueError, OSError))
