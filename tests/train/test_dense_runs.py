"""Runs that learn a label or a distance for each pixel, in this process, with tiny models."""

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from runs import KilledError, assert_same, checkpoint, error, fit, killed, patch_batch
from scenes import CLASSES, WOODSCAPE, write_plain

from darswin.cli.main import main
from darswin.models.saving import load_model
from darswin.train import pixel_task as dense_results

METRES = np.array([2.0, 5.0, 8.0])  # of the classes, so that a distance can be told from a colour
TINY = "{embed_dim: 8, depths: [1, 1, 1], rings: 8, sectors: 32, samples: [2, 2]}"
QUIET = """--data.workers 0 --trainer.enable_progress_bar false
    --trainer.enable_model_summary false""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Scenes whose label is the colour's, and whose distance is the label's."""
    folder = write_plain(tmp_path_factory.mktemp("data") / "scenes", 60, size=(45, 60))
    for file in (folder / "labels").iterdir():
        labels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        metres = (METRES[labels] * 256).astype(np.uint16)
        metres[20:24] = 0
        cv2.imwrite(str(folder / "distance" / file.name), metres)
        labels[20:24] = 255
        cv2.imwrite(str(file), labels)
    return folder


@pytest.fixture
def tiny(data):
    return [
        *("--data.path", str(data), "--data.size", "32", "--data.batch_size", "8"),
        *("--model.name", "darswin_unet_a_nano", "--model.options", TINY),
        *("--model.learning_rate", "1e-2", "--model.reference_batch", "8"),
        *("--checkpoint_steps", "1", *QUIET),
    ]


def test(run, *options):
    main(["test", "--run", str(run), "--trainer.enable_progress_bar", "false", *options])
    return json.loads((run / "test.json").read_text())["results"]


def table(file):
    with file.open() as lines:
        return list(csv.DictReader(lines))


test.__test__ = False


@pytest.fixture(scope="module")
def labelled(data, tmp_path_factory):
    """A run of a few seconds that learned labels."""
    run = tmp_path_factory.mktemp("runs") / "labelled"
    fit(run, "--task", "segmentation", *tiny.__wrapped__(data), "--trainer.max_epochs", "6",
        "--model.loss", "ce+dice")  # fmt: skip
    return run


def test_labels_are_learned_and_what_a_test_writes(labelled, data, capsys):
    recorded = yaml.safe_load((labelled / "config.yaml").read_text())
    assert recorded["task"] == "segmentation" and recorded["model"]["loss"] == "ce+dice"
    net, card = load_model(labelled / "checkpoints" / "best.safetensors")
    assert (card.task, card.classes, card.colors) == ("segmentation", *CLASSES.values())
    assert card.fit == "crop" and card.fov == 0 and net.num_classes == 3
    (row,) = test(labelled)
    assert row["data"] == "scenes" and row["miou"] > 0.75 and row["accuracy"] > 0.85
    assert 0 < row["miou_sr"] < 1 and row["miou_sr"] != row["miou"] and row["loss"] > 0
    assert set(row["per_class"]) == {"sky", "ground", "wall"}
    ious = [scores["iou"] for scores in row["per_class"].values()]
    assert sum(ious) / 3 == pytest.approx(row["miou"])
    assert [zone["from_deg"] for zone in row["per_zone"]] == [0, 30, 60, 90]
    pixels = [zone["pixels"] for zone in row["per_zone"]]
    assert sum(pixels) == row["pixels"] == sum(c["pixels"] for c in row["per_class"].values())
    said = capsys.readouterr().out
    assert "miou (%)" in said and "wall" in said and "30–60°" in said
    assert "test.csv, test_classes.csv, test_zones.csv, test.json and test.png" in said
    (line,) = table(labelled / "test.csv")
    assert float(line["miou"]) == row["miou"] and float(line["accuracy_sr"]) == row["accuracy_sr"]
    assert [line["class"] for line in table(labelled / "test_classes.csv")] == card.classes
    assert len(table(labelled / "test_zones.csv")) == 4
    assert (labelled / "test.png").read_bytes().startswith(b"\x89PNG")
    main(["validate", "--run", str(labelled), "--trainer.enable_progress_bar", "false"])
    assert "val/miou" in capsys.readouterr().out


def test_a_test_on_other_folders(labelled, data, tmp_path, monkeypatch):
    shown = []
    draw = dense_results.draw_predictions
    monkeypatch.setattr(
        dense_results,
        "draw_predictions",
        lambda rows, *rest: shown.extend(rows) or draw(rows, *rest),
    )
    lens = json.dumps({"model": "Equidistant", "focal": 16.0, "theta_max": 1.5})
    from darswin.lens import from_dict

    other = write_plain(
        tmp_path / "a" / "scenes", 3, lens=from_dict(json.loads(lens)), size=(45, 60)
    )
    rows = test(labelled, "--data.test_paths", str(other), str(data), "--model.zones", "45")
    _, truth, said = shown[0]
    assert (said[0, 0], said[-1, -1]) == (255, 255) and (said == 255).mean() < 0.3
    assert (truth[said == 255] == 255).all()  # beyond θ_max nothing is known, nor said
    names = [row["data"] for row in rows]
    assert [name.split("/")[-1] for name in names] == ["scenes", "scenes"] and len({*names}) == 2
    assert len(rows[0]["per_zone"]) == 2
    zones = [line["data"] for line in table(labelled / "test_zones.csv")]
    assert zones == [names[0], names[0], names[1], names[1]]
    # All 3 scenes of a folder that has no splits; the corners are beyond θ_max.
    assert 3 * 800 < rows[0]["pixels"] < 3 * 32 * 32 and rows[0]["miou"] > 0.5


def test_distances_are_learned(tiny, data, tmp_path, capsys):
    run = tmp_path / "run"
    options = ["--model.loss", "log_l1", "--trainer.max_epochs", "12"]
    fit(run, "--task", "distance", *tiny, *options)
    (row,) = test(run)
    labels = [cv2.imread(str(f), -1) for f in (data / "labels").iterdir()]
    metres = METRES[np.concatenate([part[part != 255] for part in labels])]
    constant = min(np.mean(abs(m - metres) / metres) for m in np.linspace(2, 8, 61))
    assert row["abs_rel"] < 0.5 * constant and row["delta1"] > 0.7
    assert row["per_class"] == {} and len(row["per_zone"]) == 4
    assert row["abs_rel_sr"] > 0 and row["rmse"] > 0 and row["silog_sr"] > 0
    assert not (run / "test_classes.csv").exists() and (run / "test.png").exists()
    assert "abs_rel" in capsys.readouterr().out
    best = checkpoint(run, "best")
    (score,) = (c["best_model_score"] for k, c in best["callbacks"].items() if "abs_rel" in k)
    assert 0 < score < constant
    (near,) = test(run, "--data.max_distance", "6")
    assert near["pixels"] < row["pixels"]


AUGMENTED = """--data.flip true --data.rotate_deg 180 --data.crop 0.6 --model.loss LOSS
    --model.solid_angle_weights true""".split()  # noqa: SIM905


@pytest.mark.parametrize(
    ("task", "loss", "more"),
    [
        ("segmentation", "ce+dice", ["--data.lens_augmentation", "0..1"]),
        ("distance", "silog", ["--trainer.accumulate_grad_batches", "4"]),
    ],
)
def test_a_killed_run_goes_on_bit_for_bit(tiny, tmp_path, monkeypatch, task, loss, more):
    augmented = [loss if word == "LOSS" else word for word in AUGMENTED]
    options = ["--task", task, *tiny, *augmented, *more, "--trainer.max_epochs", "2"]
    options += ["--data.batch_size", "4", "--data.limit", "20"]
    fit(tmp_path / "whole", *options)
    run = tmp_path / "killed"
    for number, given in ((4, options), (4, ["--resume"])):
        patch_batch(monkeypatch, number, killed)
        with pytest.raises(KilledError):
            fit(run, *given)
    patch_batch(monkeypatch, 0, killed)
    fit(run, "--resume")
    assert_same(run, tmp_path / "whole")


@pytest.mark.parametrize(
    "name", ["swin_unet_nano", "swin_unet_undis_nano", "swin_unet_adapted_nano"]
)
def test_other_models_train_on_them(tiny, tmp_path, name):
    options = ["--task", "segmentation", *tiny, "--model.name", name, "--trainer.max_steps", "2"]
    fit(tmp_path / "run", *options, "--model.options", "{embed_dim: 8, depths: [1, 1, 1]}")
    weights = checkpoint(tmp_path / "run")["state_dict"]
    assert all(torch.isfinite(tensor).all() for tensor in weights.values())


def test_classes_of_a_run_may_be_left_out(tiny, tmp_path):
    options = ["--model.ignore_index", "0", "--model.class_weights", "0,1,2"]
    fit(tmp_path, "--task", "segmentation", *tiny, *options, "--trainer.max_epochs", "1")
    (row,) = test(tmp_path)
    assert set(row["per_class"]) == {"ground", "wall"}
    assert row["miou"] == pytest.approx(np.mean([c["iou"] for c in row["per_class"].values()]))
    (line,) = table(next(tmp_path.glob("csv/*/metrics.csv")))[-1:]
    assert 0 <= float(line["val/miou"]) <= 1


def test_skipped_pictures_weigh_nothing(tiny, tmp_path, capsys):
    folder = write_plain(tmp_path / "scenes", 30, size=(45, 60))
    for k in range(0, 30, 5):
        (folder / "images" / f"{k:03d}.png").write_bytes(b"broken")
    options = [*tiny, "--data.path", str(folder), "--trainer.max_epochs", "1"]
    start = ["--task", "distance", *options]
    assert "--data.skip_broken true leaves such" in error(capsys, tmp_path / "a", *start)
    fit(tmp_path / "b", *start, "--data.skip_broken", "true")
    assert "6 pictures could not be read" in capsys.readouterr().out


def with_targets(data, folder, kind, change):
    """The same scenes with other targets; as many as make 6 batches of training."""
    shutil.copytree(data, folder)
    for file in (folder / kind).iterdir():
        target = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), change(target).astype(target.dtype))
    return folder


def only(*labels):
    return lambda target: np.where(np.isin(target, labels), target, 255)


NOTHING_TO_LEARN = {
    "all 255": ("segmentation", only(), [], "none of the pixels of 48 training images has a label"),
    "0 and 255": ("segmentation", only(0), [], "0 and 255 must be stored as the ids 0 and 1"),
    "one that counts": (
        "segmentation", only(0, 1), ["--model.ignore_index", "0"],
        "has a label of ['wall'], so that a single class is left to learn",
    ),
    "all 0": ("distance", np.zeros_like, [], "none of the pixels of 48 training images has a kno"),
    "too far": (
        "distance", lambda target: target, ["--data.max_distance", "0.5"],
        "above --data.max_distance 0.5 m; a PNG must hold metres × 256",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTHING_TO_LEARN)
def test_targets_that_nothing_can_be_learned_from(tiny, data, tmp_path, capsys, case):
    task, change, options, message = NOTHING_TO_LEARN[case]
    kind = {"segmentation": "labels", "distance": "distance"}[task]
    path = with_targets(data, tmp_path / "scenes", kind, change)
    start = ["--task", task, *tiny, "--data.path", str(path), *options]
    assert message in error(capsys, tmp_path / "run", *start, "--trainer.max_epochs", "3")
    if "48 training images" in message:  # a few of them are enough, where nothing at all is known
        few = error(capsys, tmp_path / "few", *start, "--trainer.max_steps", "2")
        assert message.replace("48", "16") in few


def test_two_processes_with_nothing_to_learn_say_so_once(tiny, data, tmp_path):
    path = with_targets(data, tmp_path / "scenes", "labels", only())
    options = [*tiny, "--data.path", str(path), *PAIR, "--data.batch_size", "4"]
    done = subprocess.run(
        [sys.executable, "-m", "darswin", "fit", "--run", str(tmp_path / "run"),
         "--task", "segmentation", *options, "--trainer.max_epochs", "1"],
        capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=300,
    )  # fmt: skip
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert done.stderr.count("none of the pixels of 48 training images has a label") == 1


def test_a_class_that_is_never_there_is_named_once(tiny, data, tmp_path, capsys):
    path = with_targets(data, tmp_path / "scenes", "labels", only(0, 2))
    start = ["--task", "segmentation", *tiny, "--data.path", str(path)]
    said = "no pixel of 48 training images has a label of ['ground'], which cannot be learned"
    fit(tmp_path / "run", *start, "--trainer.max_epochs", "2")
    assert capsys.readouterr().err.count(said) == 1
    fit(tmp_path / "run", "--resume", "--trainer.max_epochs", "3")
    assert capsys.readouterr().err.count(said) == 1
    fit(tmp_path / "short", *start, "--trainer.max_steps", "2")  # it may come later
    left_out = [*start, "--model.ignore_index", "1", "--trainer.max_epochs", "1"]
    fit(tmp_path / "left out", *left_out)
    assert "cannot be learned" not in capsys.readouterr().err


@pytest.mark.parametrize("task", ["segmentation", "distance"])
def test_a_test_of_weights_that_are_not_finite_has_no_results(tiny, tmp_path, capsys, task):
    run = tmp_path / "run"
    fit(run, "--task", task, *tiny, "--trainer.max_epochs", "1", "--data.limit", "8")
    broken = checkpoint(run, "best")
    for tensor in broken["state_dict"].values():
        if tensor.is_floating_point():
            tensor.fill_(np.nan)
    torch.save(broken, run / "checkpoints" / "best.ckpt")
    with pytest.raises(SystemExit, match="the loss on scenes is nan: the weights are not finite"):
        test(run)
    assert not (run / "test.json").exists()


def test_a_test_without_targets_is_valid_json(tiny, data, tmp_path):
    run = tmp_path / "run"
    fit(run, "--task", "segmentation", *tiny, "--trainer.max_epochs", "1", "--data.limit", "8")
    path = with_targets(data, tmp_path / "scenes", "labels", only())
    (row,) = test(run, "--data.test_paths", str(path))
    assert row["loss"] is None and row["miou"] is None and row["pixels"] == 0
    assert "NaN" not in (run / "test.json").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--task", "depth"], "--task must be one of classification, segmentation, distance, got"),
        (["--model.name", "swin_nano"], "swin_nano is no model for --task segmentation; there are"),
        (["--model.name", "resnet"], "unknown model 'resnet'"),
        (["--data.size", "33"], "with --data.size 33"),
        (["--data.limit", "0"], "--data.limit must be at least 1, got 0"),
        (["--data.crop", "2"], "--data.crop must be a share in (0, 1], got 2"),
        (["--data.lens_augmentation", "odd"], "lenses must be one of"),
        (["--data.max_distance", "3"], "unrecognized arguments: --data.max_distance 3"),
        (["--xi", "0.3"], "xi"),
        (["--model.loss", "silog"], "--model.loss"),
        (
            ["--model.class_weights", "1,2"],
            "one for each of the 3 classes sky, ground, wall, got 2",
        ),
        (["--model.class_weights", "0,0,0"], "not all 0"),
        (["--model.ignore_index", "3"], "--model.ignore_index must be a class, 0 to 2, or 255"),
        (["--model.label_smoothing", "1"], "--model.label_smoothing must be in [0, 1)"),
        (["--model.zones", "60,30"], "--model.zones must rise"),
        (["--model.options", "{num_classes: 3}"], "--model.options cannot set num_classes"),
        (["--model.options", "{task: distance}"], "--model.options cannot set task"),
        (["--data.lens", "none.json"], "none.json"),
    ],
)
def test_what_is_wrong_is_named(tiny, tmp_path, capsys, options, message):
    start = ["--task", "segmentation", *tiny]
    if options[0] == "--data.size":
        start += ["--model.name", "swin_unet_nano", "--model.options", "{}"]
    assert message in error(capsys, tmp_path / "run", *start, *options)
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_models_of_another_task_are_named(tmp_path, capsys, data):
    unet = ["--model.name", "swin_unet_nano"]
    message = error(capsys, tmp_path, "--config", "minutes", "--data.path", "digits", *unet)
    assert "swin_unet_nano is no model for --task classification; there are darswin_a_m" in message
    wrong = ["--task", "distance", "--data.path", str(data), "--data.max_distance", "-1"]
    assert "--data.max_distance must be above 0, got -1" in error(capsys, tmp_path, *wrong)


def test_data_without_what_a_task_needs(tiny, tmp_path, capsys):
    labels = write_plain(tmp_path / "labels", 8, size=(45, 60), targets=("labels",))
    path = ["--data.path", str(labels)]
    message = error(capsys, tmp_path / "r", "--task", "distance", *tiny, *path)
    assert f"{labels / 'distance'}" in message
    distance = write_plain(
        tmp_path / "distance", 8, size=(45, 60), targets=("distance",), classes=None
    )
    path = ["--data.path", str(distance)]
    message = error(capsys, tmp_path / "r", "--task", "segmentation", *tiny, *path)
    assert "classes.json" in message or f"{distance / 'labels'}" in message
    nameless = write_plain(tmp_path / "nameless", 8, size=(45, 60), classes=None)
    path = ["--data.path", str(nameless)]
    message = error(capsys, tmp_path / "r", "--task", "segmentation", *tiny, *path)
    assert "classes" in message


def test_a_run_keeps_its_task(labelled, capsys, data):
    message = error(capsys, labelled, "--resume", "--task", "distance")
    assert f"{labelled} is a run of --task segmentation, not of distance" in message
    other = write_plain(labelled.parent / "o", 2, size=(45, 60), classes=["a", "b", "c"])
    with pytest.raises(SystemExit):
        test(labelled, "--data.test_paths", str(other))
    assert "a model is tested on the classes that it was trained on" in capsys.readouterr().err


def test_a_calibration_of_all_pictures(tiny, tmp_path, data):
    options = ["--data.lens", str(WOODSCAPE), "--trainer.max_steps", "1", "--data.fit", "stretch"]
    fit(tmp_path, "--task", "segmentation", *tiny, *options)
    assert load_model(tmp_path / "checkpoints" / "last.safetensors")[1].fit == "stretch"


def test_two_processes_train_and_test_as_one(tiny, data, tmp_path):
    still = TINY.replace("}", ", jitter: 0, drop_path_rate: 0}")
    options = ["--task", "segmentation", *tiny, "--model.options", still, "--data.limit", "40"]
    options += ["--trainer.max_epochs", "1", "--data.randaugment", "false"]
    one, two = tmp_path / "one", tmp_path / "two"
    fit(one, *options)
    before = test(one)
    train = ["fit", "--run", str(two), *options, *PAIR, "--data.batch_size", "4"]
    run_pair(train, ["test", "--run", str(one), *PAIR, *QUIET[2:4]])
    for name, tensor in checkpoint(one)["state_dict"].items():
        torch.testing.assert_close(
            checkpoint(two)["state_dict"][name], tensor, rtol=1e-3, atol=1e-4
        )
    after = json.loads((one / "test.json").read_text())["results"]
    assert after[0]["pixels"] == before[0]["pixels"]
    for name in ("miou", "accuracy", "miou_sr", "accuracy_sr", "loss"):
        assert after[0][name] == pytest.approx(before[0][name], abs=2e-3)


PAIR = ["--devices", "2", "--trainer.accelerator", "cpu"]
BOTH = """
import json, sys
from darswin.cli.main import main
for words in json.loads(sys.argv[1]):
    main(words)
"""


def run_pair(*commands):
    """Commands, one after the other, in two processes: Lightning starts the second one, as a copy
    of the first."""
    script = Path(commands[0][2]).with_suffix(".py")
    script.write_text(BOTH)
    done = subprocess.run(
        [sys.executable, str(script), json.dumps(commands)],
        capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"}, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
