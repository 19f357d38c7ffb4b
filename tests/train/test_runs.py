"""Whole runs in this process: tasks × data × what happens to them."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
import yaml
from helpers import ended, refused, slow_but
from lens_pictures import WOODSCAPE
from lightning.pytorch.strategies import Strategy
from runs import (
    DIGITS,
    PIXELS,
    assert_same,
    checkpoint,
    error,
    files,
    fit,
    killed_fit,
    patch_batch,
    table,
    test,
)
from scenes import CLASSES, write_plain
from train.conftest import METRES

from darswin.cli.fit import RunCLI
from darswin.cli.main import main
from darswin.cli.predict import predict
from darswin.data import open_source
from darswin.lens import from_dict
from darswin.models.saving import load_model
from darswin.train.runs import _options, check_changes
from darswin.train.task import learning_rate
from darswin.train.tasks import TASKS
from darswin.utils.files import locked

EQUIDISTANT = {"model": "Equidistant", "focal": 45.0, "theta_max": 1.5, "image_size": [121, 160]}


@pytest.fixture
def options(frames, scenes, tmp_path):
    """The options of a run: on digits, on frames of several cameras, on labels, on distances."""
    cameras = tmp_path / "lenses.json"
    cameras.write_text(json.dumps({".": str(WOODSCAPE), "1": EQUIDISTANT, "2": EQUIDISTANT}))
    turned = ["--data.flip", "true", "--data.rotate_deg", "180"]
    pixels = ["--data.path", scenes, *PIXELS, "--trainer.max_epochs", "2", "--data.limit", "20"]
    pixels += ["--data.batch_size", "4", "--data.crop", "0.6", *turned]
    pixels += ["--model.solid_angle_weights", "true"]
    return {
        "digits": DIGITS,
        "frames": [*DIGITS, "--data.path", frames, "--data.lens", cameras, *turned],
        "labels": ["--task", "segmentation", *pixels, "--data.lens_augmentation", "0..1",
                   "--model.loss", "ce+dice"],
        "distances": ["--task", "distance", *pixels, "--trainer.accumulate_grad_batches", "4"],
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "kills"),
    [("digits", (8, 9)), ("frames", (5, 6)), ("labels", (4, 4)), ("distances", (4, 4))],
)
def test_a_killed_run_goes_on_bit_for_bit(options, tmp_path, monkeypatch, data, kills):
    fit(tmp_path / "whole", *options[data])
    given = options[data]
    for number in kills:
        killed_fit(monkeypatch, tmp_path / "killed", number, *given)
        given = ["--resume"]
    fit(tmp_path / "killed", "--resume")
    assert_same(tmp_path / "killed", tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("data", ["digits", "labels"])
def test_with_lightnings_device_a_gpu_all_is_the_same(options, tmp_path, monkeypatch, data):
    few = [*options[data], "--trainer.max_steps", "2", "--data.workers", "1"]
    fit(tmp_path / "cpu", *few)
    # What Lightning makes the default device as it calls `configure_model`.
    there = torch.device("meta")
    monkeypatch.setattr(Strategy, "tensor_init_context", lambda self, empty_init=None: there)
    fit(tmp_path / "gpu", *few)
    assert_same(tmp_path / "gpu", tmp_path / "cpu")


MODELS = {
    "darswin_ra_nano": "digits",
    "dat_nano": "digits",
    "swin_nano perspective": "frames",
    "swin_unet_nano": "labels",
    "swin_unet_nano square": "labels",
}


@pytest.mark.parametrize(("name", "data"), slow_but(MODELS.items(), *list(MODELS.items())[::2]))
def test_models_train_and_test(options, tmp_path, data, name):
    name, _, view = name.partition(" ")
    own = dict(embed_dim=8, depths=[1, 1, 1]) if data == "labels" else {}
    own = json.dumps(own | (dict(view=view) if view else {}))
    few = ["--trainer.max_steps", "2", "--trainer.accumulate_grad_batches", "1"]
    few += ["--data.limit", "16", "--model.name", name, "--model.options", own]
    fit(tmp_path / "run", *options[data], *few)
    weights = checkpoint(tmp_path / "run")["state_dict"]
    assert all(torch.isfinite(tensor).all() for tensor in weights.values())
    more = ["--xi", "0.1,polynomial"] if data == "digits" else []
    lenses = [row.get("lenses") for row in test(tmp_path / "run", *more)]
    expected = dict(digits=["0.1", "polynomial"], frames=["lenses.json"], labels=[None])
    assert lenses == expected[data]
    assert json.loads((tmp_path / "run" / "test.json").read_text())["model"] == name


# -- runs that stop and go on -----------------------------------------------------------------


@pytest.fixture
def begun(killed, tmp_path):
    return shutil.copytree(killed, tmp_path / "begun")


def test_a_run_leaves_everything_in_its_folder(whole):
    names = set(files(whole))
    kept = {f"checkpoints/{n}.{e}" for n in ("best", "last") for e in ("ckpt", "safetensors")}
    assert kept | {"config.yaml", "csv/version_0/metrics.csv"} <= names
    assert any("events.out.tfevents" in name for name in names)
    model, card = load_model(whole / "checkpoints" / "last.safetensors")
    state = checkpoint(whole)["state_dict"]
    assert all(torch.equal(t, state[f"net.{name}"]) for name, t in model.state_dict().items())
    assert card.classes == [str(k) for k in range(10)] and card.size == 32
    assert card.channels == 1  # digits are grey
    data = yaml.safe_load((whole / "config.yaml").read_text())["data"]
    assert (data["size"], data["channels"]) == (32, 1)  # later runs on other pictures keep them
    lines = table(whole / "csv" / "version_0" / "metrics.csv")
    assert [line["step"] for line in lines if line["train/loss"]] == [*"012345"]


@pytest.mark.slow
def test_signals_stop_a_run_after_a_step(whole, tmp_path, monkeypatch, capfd):
    run = tmp_path / "a run"
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    cases = ((2, signal.SIGINT, 130, [*DIGITS, "--checkpoint_steps", "9"], 1),
             (6, signal.SIGTERM, 143, ["--resume"], 3))  # fmt: skip
    for batch, number, code, given, step in cases:
        with monkeypatch.context() as patch:
            patch_batch(patch, batch, lambda self, number=number: os.kill(os.getpid(), number))
            said = ended(capfd, code, fit, run, *given).err
        assert checkpoint(run)["global_step"] == step
        assert f"stopped at step {step}: `darswin fit --run '{run}' --resume` goes on" in said
    assert handlers == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    fit(run, "--resume")
    assert_same(run, whole)


def test_a_second_signal_stops_at_once(tmp_path, monkeypatch, capsys):
    def twice(self):
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)

    patch_batch(monkeypatch, 2, twice)
    ended(capsys, 130, fit, tmp_path, *DIGITS)
    assert not (tmp_path / "checkpoints").exists()


def test_a_refused_resume_changes_nothing(whole, capsys):
    before = files(whole)
    fixed = ["--seed_everything", "1", "--model.options", "{embed_dim: 16}", "--data.size", "48"]
    for options, *messages in (
        (["--data.path", "nowhere"], "no folder nowhere"),
        (fixed, "--model.options {'embed_dim': 16} in place of", "--data.size 48 in place of 32",
         "--seed_everything 1 in place of 0"),
        (["--trainer.limit_train_batches", "4"], "steps per epoch and cannot go on with 1: keep"),
        (["--trainer.max_epochs", "0"], "max_epochs=0"),
        (["--task", "distance"], "is a run of --task classification, not of distance"),
    ):  # fmt: skip
        said = error(capsys, "fit", "--run", whole, "--resume", *options)
        assert all(message in said for message in messages), said
        assert files(whole) == before


# All options of `fit` but the trainer's: those that may change on resume, and those that may not.
# A new option belongs to one of them, and to `FIXED` of darswin/train/runs.py if it may not change.
MAY_CHANGE = {
    "": "checkpoint_steps weights_only",
    "model.": """learning_rate warmup_rate final_rate warmup_epochs reference_batch weight_decay
        label_smoothing mixup cutmix mix_p loss class_weights solid_angle_weights zones
        grad_checkpointing""",
    "data.": """path classes splits label_map skip_broken lens camera coefficients batch_size
        workers train_lenses test_lenses pair_lenses render fit picture_size randaugment erasing
        flip rotate_deg crop lens_augmentation test_paths max_distance""",
}
MAY_NOT = {
    "": "task seed_everything",
    "model.": "name options weights freeze_stages decay_position_bias ignore_index",
    "data.": "channels fov_deg holdout limit mean size std",
    "trainer.": "accumulate_grad_batches",
}


def test_what_may_change_on_resume(monkeypatch):
    found = {}

    def options_of(self):
        found.update(_options(yaml.safe_load(self._recorded(self.config["fit"]))))
        raise KeyboardInterrupt

    monkeypatch.setattr(RunCLI, "before_instantiate_classes", options_of)
    for task in TASKS:
        refused("130", fit, "r", "--data.path", "digits", "--task", task, error=SystemExit)
    may, may_not = (
        {f"{group}{name}" for group, names in table.items() for name in names.split()}
        for table in (MAY_CHANGE, MAY_NOT)
    )
    may |= {name for name in found if name.startswith("trainer.")} - may_not
    assert found.keys() == may | may_not and not may & may_not
    for name in found:
        group, _, option = name.rpartition(".")
        before, now = ({group: {option: k}} if group else {option: k} for k in (1, 2))
        if name in may:
            assert check_changes(before, now) == {name: "2 in place of 1"}
        else:
            said = f"cannot change these options: `{name}` 2 in place of [^;]*$"
            refused(said, check_changes, before, now)
        assert check_changes(before, before) == {}
    assert check_changes({"run": "a"}, {"run": "b"}) == {}


@pytest.mark.slow
def test_rates_and_decay_change_on_resume(begun, capsys):
    said = error(capsys, "fit", "--run", begun, "--resume", "--data.batch_size", "4")
    assert "global batch" in said
    new = ["--model.learning_rate", "1e-3", "--model.weight_decay", "0.2", "--model.final_rate"]
    fit(begun, "--resume", *new, "0", "--trainer.max_epochs", "3")
    assert "--model.weight_decay 0.2 in place of 0.05" in capsys.readouterr().err
    recorded = yaml.safe_load((begun / "config.yaml").read_text())
    assert recorded["model"]["learning_rate"] == 1e-3 and recorded["trainer"]["max_epochs"] == 3
    groups = checkpoint(begun)["optimizer_states"][0]["param_groups"]
    assert [group["weight_decay"] for group in groups] == [0.2, 0.0]
    lines = table(max(begun.glob("csv/*/metrics.csv")))
    found = {int(line["step"]): float(line["train/rate"]) for line in lines if line["train/rate"]}
    scale = 8 * 5 / 48  # images a step over the preset's reference batch
    rates = dict(peak=1e-3 * scale, warmup=1e-5 * scale, final=0, warmup_steps=3, steps=9)
    # The step before is not trained again.
    assert found == pytest.approx({step: learning_rate(step, **rates) for step in range(4, 9)})


@pytest.mark.slow
def test_weights_that_are_not_finite_are_not_kept(begun, capsys, monkeypatch):
    def finite_without_gradients(self):
        return sum((0 * p).sqrt().sum() for p in self.net.parameters())

    with monkeypatch.context() as patch:
        patch_batch(patch, 1, finite_without_gradients)
        message = error(capsys, "fit", "--run", begun, "--resume")
    assert "not finite after step 5: go on with --resume and" in message
    assert checkpoint(begun)["global_step"] == 4
    rate = ["--model.learning_rate", "1e30"]
    message = error(capsys, "fit", "--run", begun, "--resume", *rate)
    assert "a --model.learning_rate below 1e+30; if the last checkpoint has" in message
    best = ["--ckpt_path", begun / "checkpoints" / "best.ckpt"]  # as it advises
    fit(begun, "--resume", "--model.learning_rate", "0.002", *best)
    assert checkpoint(begun)["global_step"] == 6


@pytest.mark.slow
def test_a_cut_off_checkpoint_is_named_with_the_other_one(whole, begun, capsys):
    last, best = (begun / "checkpoints" / f"{name}.ckpt" for name in ("last", "best"))
    data = last.read_bytes()
    resume = ["fit", "--run", begun, "--resume"]
    for size in (0, len(data) - 10):
        last.write_bytes(data[:size])
        message = error(capsys, *resume)
        assert f"{last} cannot be read as a checkpoint" in message
        assert f"; --ckpt_path {best} starts from the other one" in message
    fit(begun, "--resume", "--ckpt_path", best)
    assert_same(begun, whole)
    best.unlink()
    last.write_bytes(data[:99])
    message = error(capsys, *resume)
    assert f"{last} cannot be read as a checkpoint" in message and "--ckpt_path" not in message
    (begun / "config.yaml").unlink()
    assert "it has no config.yaml" in error(capsys, *resume)


@pytest.mark.slow
def test_one_fit_at_a_time(begun, capsys):
    before = files(begun)
    hold = "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.lockf(f, 2); print(); input()"
    with subprocess.Popen(
        [sys.executable, "-c", hold, begun / ".lock"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        message = error(capsys, "fit", "--run", begun, "--resume")
        assert f"another `darswin fit` is at work in {begun}" in message
        assert files(begun) == before
        other.kill()
    with locked(begun / ".lock"):
        pass


# -- what is learned, and the results of tests ------------------------------------------------


@pytest.mark.slow
def test_train_test_and_predict_see_the_same(frames, tmp_path, capsys):
    run = tmp_path / "run"
    fit(run, *DIGITS, "--data.path", frames, "--data.lens", WOODSCAPE)
    recorded = yaml.safe_load((run / "config.yaml").read_text())["data"]
    assert recorded["lens"] == str(WOODSCAPE)
    _, card = load_model(run / "checkpoints" / "best.safetensors")
    assert card.fit == "stretch" and card.size == 64 and card.fov == 0
    main(["validate", "--run", str(run), "--trainer.enable_progress_bar", "false"])
    (row,) = test(run)
    assert row["lenses"] == "woodscape.json" and (run / "test.png").exists()
    # What `test` counted is what `predict` says of the same pictures.
    source = open_source(frames, "test", channels=1)
    paths = [str(source.file(k)) for k in range(len(source))]
    found = predict(paths, lens=str(WOODSCAPE), run=str(run), top=1)
    right = [f["top"][0]["class"] == source.classes[source[k][1]] for k, f in enumerate(found)]
    assert sum(right) / len(right) == pytest.approx(row["top1"])


@pytest.mark.slow
def test_one_test_over_all_distortions_and_of_another_camera(whole, frames, tmp_path, capsys):
    run = shutil.copytree(whole, tmp_path / "run")
    rows = test(run, "--xi", "0:1:0.5")
    assert [row["lenses"] for row in rows] == ["0", "0.5", "1"]
    for line, row in zip(table(run / "test.csv"), rows, strict=True):
        assert {key: str(value) for key, value in row.items()} == line
        assert row["top1"] <= row["top5"] <= 1 and row["loss"] > 0
    assert (run / "test.png").read_bytes().startswith(b"\x89PNG")
    assert "top1 (%)" in capsys.readouterr().out
    # A model of warped pictures may be measured on those of a camera.
    (row,) = test(run, "--data.path", frames, "--data.lens", json.dumps(EQUIDISTANT))
    assert row["lenses"] == "lens"


def test_labels_are_learned_and_what_a_test_writes(labelled, capsys):
    recorded = yaml.safe_load((labelled / "config.yaml").read_text())
    assert recorded["task"] == "segmentation" and recorded["model"]["loss"] == "ce+dice"
    net, card = load_model(labelled / "checkpoints" / "best.safetensors")
    assert (card.task, card.classes, card.colors) == ("segmentation", *CLASSES.values())
    assert card.fit == "stretch" and card.fov == 0 and net.num_classes == 3
    (row,) = test(labelled)
    assert row["data"] == "scenes" and row["miou"] > 0.75 and row["accuracy"] > 0.85
    assert 0 < row["miou_sr"] < 1 and row["miou_sr"] != row["miou"] and row["loss"] > 0
    assert [zone["from_deg"] for zone in row["per_zone"]] == [0, 30, 60, 90]
    pixels = [zone["pixels"] for zone in row["per_zone"]]
    assert sum(pixels) == row["pixels"] == sum(c["pixels"] for c in row["per_class"].values())
    said = capsys.readouterr().out
    assert "miou (%)" in said and "wall" in said and "30–60°" in said and "≥ 90°" in said
    assert "test.csv, test_classes.csv, test_zones.csv, test.json and test.png" in said
    (line,) = table(labelled / "test.csv")
    assert float(line["miou"]) == row["miou"] and float(line["accuracy_sr"]) == row["accuracy_sr"]
    assert [line["class"] for line in table(labelled / "test_classes.csv")] == card.classes
    assert len(table(labelled / "test_zones.csv")) == 4
    main(["validate", "--run", str(labelled), "--trainer.enable_progress_bar", "false"])
    assert "val/miou" in capsys.readouterr().out


def test_a_test_on_other_folders(labelled, scenes, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(
        "darswin.train.pixel_task.draw_predictions", lambda rows, *_: shown.extend(rows)
    )
    monkeypatch.setattr("darswin.train.results.save_figure", lambda *_: None)
    lens = from_dict({"model": "Equidistant", "focal": 16.0, "theta_max": 1.5})
    other = write_plain(tmp_path / "a" / "scenes", 3, lens=lens, size=(45, 60))
    rows = test(labelled, "--data.test_paths", other, scenes, "--model.zones", "45")
    _, truth, answer = shown[0]
    assert (answer[0, 0], answer[-1, -1]) == (255, 255) and (answer == 255).mean() < 0.35
    assert (truth[answer == 255] == 255).all()  # beyond θ_max nothing is known, nor answered
    names = [row["data"] for row in rows]
    assert [name.split("/")[-1] for name in names] == ["scenes", "scenes"] and len({*names}) == 2
    zones = [line["data"] for line in table(labelled / "test_zones.csv")]
    assert zones == [names[0], names[0], names[1], names[1]]
    # All 3 scenes of a folder that has no splits; a third of each is beyond θ_max.
    assert 3 * 650 < rows[0]["pixels"] < 3 * 32 * 32 and rows[0]["miou"] > 0.5


@pytest.mark.slow
def test_distances_are_learned(scenes, tmp_path):
    run = tmp_path / "run"
    options = ["--data.path", scenes, *PIXELS, "--model.loss", "log_l1"]
    fit(run, "--task", "distance", *options, "--trainer.max_epochs", "12")
    (row,) = test(run)
    labels = [cv2.imread(str(f), -1) for f in (scenes / "labels").iterdir()]
    metres = METRES[np.concatenate([part[part != 255] for part in labels])]
    constant = min(np.mean(abs(m - metres) / metres) for m in np.linspace(2, 8, 61))
    assert row["abs_rel"] < 0.5 * constant and row["delta1"] > 0.7
    assert row["per_class"] == {} and len(row["per_zone"]) == 4
    assert not (run / "test_classes.csv").exists() and (run / "test.png").exists()
    best = checkpoint(run, "best")
    (score,) = (c["best_model_score"] for k, c in best["callbacks"].items() if "abs_rel" in k)
    assert 0 < score < constant


def test_weights_that_are_not_finite_have_no_results(labelled, tmp_path):
    run = shutil.copytree(labelled, tmp_path / "run")
    (run / "test.json").unlink(missing_ok=True)
    broken = checkpoint(run, "best")
    for tensor in broken["state_dict"].values():
        if tensor.is_floating_point():
            tensor.fill_(np.nan)
    torch.save(broken, run / "checkpoints" / "best.ckpt")
    refused("the loss on scenes is nan: the weights are not finite", test, run, error=SystemExit)
    assert not (run / "test.json").exists()


def test_skipped_pictures_are_counted(tmp_path, capsys):
    """Also: few steps are logged once, and the progress bar does not show the folder."""
    folder, run = write_plain(tmp_path / "scenes", 30, size=(45, 60)), tmp_path / "b"
    for k in range(0, 30, 5):
        (folder / "images" / f"{k:03d}.png").write_bytes(b"broken")
    start = ["--task", "distance", "--data.path", folder, *PIXELS, "--trainer.max_epochs", "1"]
    message = error(capsys, "fit", "--run", tmp_path / "a", *start)
    assert "cannot read" in message and "--data.skip_broken true" in message
    more = ["--trainer.enable_progress_bar", "true", "--devices", "1"]
    fit(run, *start, "--data.skip_broken", "true", *more)
    said = capsys.readouterr()
    assert "they cannot be read: 6 pictures" in said.out
    counts = re.search(r"; (\d+) training and (\d+) validation pictures", said.err).groups()
    assert sum(map(int, counts)) == 30 - 3 - 6  # without those of the test set
    assert "train/loss" in said.out and "v_num" not in said.out
    assert yaml.safe_load((run / "config.yaml").read_text())["trainer"]["devices"] == 1
    lines = table(next(run.glob("csv/*/metrics.csv")))
    assert len({line["step"] for line in lines if line["train/loss"]}) == 1


def test_targets_that_nothing_can_be_learned_from(scenes, tmp_path, capsys):
    path = shutil.copytree(scenes, tmp_path / "scenes")
    for file in (path / "labels").iterdir():
        cv2.imwrite(str(file), np.full((45, 60), 255, np.uint8))
    start = ["--task", "segmentation", *PIXELS, "--data.path", path, "--data.limit", "16"]
    said = error(capsys, "fit", "--run", tmp_path / "run", *start, "--trainer.max_epochs", 2)
    assert "none of the pixels of 16 training images has a label" in said
