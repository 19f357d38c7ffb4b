"""Runs that end early, in many ways, and go on; each in this process, with a tiny model."""

import contextlib
import csv
import functools
import io
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from runs import KilledError, assert_same, checkpoint, error, files, fit, killed, patch_batch

from darswin.cli.main import main
from darswin.train.runs import CHANGEABLE, check_changes
from darswin.train.task import learning_rate
from darswin.train.tasks import TASKS
from darswin.utils.files import locked

# 12 batches an epoch, in steps of 5, 5 and 2.
TINY = """
    --config minutes --data.path digits --data.limit 96 --data.batch_size 8 --data.workers 0
    --trainer.max_epochs 2 --trainer.accumulate_grad_batches 5 --checkpoint_steps 1
    --trainer.enable_progress_bar false --trainer.enable_model_summary false
    --trainer.log_every_n_steps 1 --model.options {embed_dim:\\ 8,depths:\\ [1,1,1]}
    --model.mixup 0.8 --data.randaugment true
""".replace("\\ ", "\0").split()
TINY = [word.replace("\0", " ") for word in TINY]


@pytest.fixture
def at_batch(monkeypatch):
    return functools.partial(patch_batch, monkeypatch)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "whole"
    fit(run, *TINY)
    return run


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "begun"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KilledError):
        patch_batch(patch, 19, killed)
        fit(run, *TINY)
    assert checkpoint(run)["global_step"] == 4
    return run


@pytest.fixture
def begun(kept, tmp_path) -> Path:
    """A run that was killed in its second epoch, when its last checkpoint was amid that epoch."""
    return shutil.copytree(kept, tmp_path / "begun")


def test_kills_amid_a_step_lose_none_of_its_batches(whole, tmp_path, at_batch):
    run = tmp_path / "killed"
    for number, options in ((8, TINY), (3, ["--resume"]), (9, ["--resume"])):
        at_batch(number, killed)
        with pytest.raises(KilledError):
            fit(run, *options)
    at_batch(0, killed)
    fit(run, "--resume")
    assert_same(run, whole)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_told_to_stop_saves_where_it_is(whole, tmp_path, at_batch, capfd, number, code):
    run = tmp_path / "a run"
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    for batch, options, step in ((2, [*TINY, "--checkpoint_steps", "9"], 1), (6, ["--resume"], 3)):
        at_batch(batch, lambda self: os.kill(os.getpid(), number))
        with pytest.raises(SystemExit) as caught:
            fit(run, *options)
        assert caught.value.code == code and checkpoint(run)["global_step"] == step
        told = capfd.readouterr().err
        assert f"stopped at step {step}: `darswin fit --run '{run}' --resume` goes on" in told
    assert handlers == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    at_batch(0, killed)
    fit(run, "--resume")
    assert_same(run, whole)


def test_a_second_signal_stops_at_once(tmp_path, at_batch, capfd):
    def twice(self):
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGINT)

    at_batch(2, twice)
    with pytest.raises(SystemExit) as caught:
        fit(tmp_path, *TINY)
    assert caught.value.code == 130 and not (tmp_path / "checkpoints").exists()
    assert "--resume` goes on" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data.path", "nowhere"], "no folder nowhere"),
        (["--model.name", "darswin_ra_nano"], "--model.name 'darswin_ra_nano' in place of"),
        (["--model.options", "{embed_dim: 16}"], "--model.options {'embed_dim': 16} in place of"),
        (["--data.size", "48", "--data.channels", "3"], "--data.size 48 in place of 32; --data.ch"),
        (["--data.limit", "90"], "--data.limit 90 in place of 96"),
        (["--data.holdout", "0.2"], "--data.holdout 0.2 in place of 0.1"),
        (["--seed_everything", "1"], "--seed_everything 1 in place of 0"),
        (["--model.decay_position_bias", "true"], "--model.decay_position_bias True in place of"),
        (["--data.batch_size", "4"], "global batch"),
        (["--trainer.accumulate_grad_batches", "4"], "--trainer.accumulate_grad_batches 4 in"),
        (["--trainer.limit_train_batches", "4"], "--trainer.limit_train_batches decide"),
        (["--trainer.max_epochs", "0"], "max_epochs=0"),
        (["--trainer.overfit_batches", "2"], "--trainer.overfit_batches"),
        (["--model.learning_rate", "0"], "--model.learning_rate must be above 0"),
        (["--data.speed", "1"], "--data.speed"),
    ],
)
def test_a_refused_resume_changes_nothing(begun, capsys, options, message):
    before = files(begun)
    assert message in error(capsys, begun, "--resume", *options)
    assert files(begun) == before


def test_a_run_is_known_by_its_configuration(begun, capsys):
    (begun / "config.yaml").unlink()
    assert "it has no config.yaml" in error(capsys, begun, "--resume", *TINY)


def test_rates_and_decay_change_on_resume(begun, capsys):
    new = [
        "--model.learning_rate",
        "1e-3",
        "--model.weight_decay",
        "0.2",
        "--model.final_rate",
        "0",
    ]
    fit(begun, "--resume", *new, "--trainer.max_epochs", "3")
    assert "--model.weight_decay 0.2 in place of 0.05" in capsys.readouterr().err
    recorded = yaml.safe_load((begun / "config.yaml").read_text())
    assert recorded["model"]["learning_rate"] == 1e-3 and recorded["trainer"]["max_epochs"] == 3
    groups = checkpoint(begun)["optimizer_states"][0]["param_groups"]
    assert [group["weight_decay"] for group in groups] == [0.2, 0.0]
    file = max(begun.glob("csv/*/metrics.csv"))
    with file.open() as lines:
        rows = {
            int(r["step"]): float(r["train/rate"]) for r in csv.DictReader(lines) if r["train/rate"]
        }
    scale = 8 * 5 / 48  # images a step over the preset's reference batch
    rates = dict(peak=1e-3 * scale, warmup=1e-5 * scale, final=0, warmup_steps=3, steps=9)
    assert rows.keys() == {4, 5, 6, 7, 8}  # the step before is not trained again
    assert all(rate == pytest.approx(learning_rate(step, **rates)) for step, rate in rows.items())


def test_what_may_change_is_an_option():
    names = {
        line.split()[0].strip("-,") for line in _help().splitlines() if line.strip()[:2] == "--"
    }
    assert {name for name in CHANGEABLE if name not in names} == set()


def _help() -> str:
    text = io.StringIO()
    for task in TASKS:
        with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
            main(["fit", "--task", task, "--help.all"])
    return text.getvalue()


def test_a_run_of_before_there_were_tasks_goes_on():
    assert (
        check_changes({"data": {"size": 32}}, {"task": "classification", "data": {"size": 32}})
        == []
    )
    with pytest.raises(ValueError, match="`task` 'distance' in place of 'classification'"):
        check_changes({}, {"task": "distance"})


def test_changes_are_named():
    before = {"data": {"size": 32, "workers": 1}, "trainer": {"devices": 1}, "run": "a"}
    now = {"data": {"size": 32, "workers": 2}, "trainer": {"devices": 2}, "run": "a"}
    assert check_changes(before, before) == []
    assert check_changes(before, now) == [
        "`data.workers` 2 in place of 1", "`trainer.devices` 2 in place of 1",
    ]  # fmt: skip
    with pytest.raises(ValueError, match=r"not with `data\.size` 64 in place of 32$"):
        check_changes(before, now | {"data": {"size": 64, "workers": 2}})


def test_no_checkpoint_follows_a_loss_that_is_not_finite(begun, capsys, at_batch):
    before = checkpoint(begun)

    def finite_without_gradients(self):
        return sum((0 * p).sqrt().sum() for p in self.net.parameters())

    at_batch(1, finite_without_gradients)
    message = error(capsys, begun, "--resume")
    assert "not finite after step 5: go on with --resume and" in message
    assert "--model.learning_rate below 0.003" in message
    assert all(t.isfinite().all() for t in checkpoint(begun)["state_dict"].values())
    assert checkpoint(begun)["global_step"] == before["global_step"] == 4
    at_batch(0, killed)
    fit(begun, "--resume", "--model.learning_rate", "0.002")  # as it advises
    assert checkpoint(begun)["global_step"] == 6


def test_a_loss_that_is_not_finite_tells_what_helps(begun, capsys):
    message = error(capsys, begun, "--resume", "--model.learning_rate", "1e30")
    assert "--resume and a --model.learning_rate below 1e+30; if the last checkpoint has" in message
    best = ["--ckpt_path", str(begun / "checkpoints" / "best.ckpt")]
    fit(begun, "--resume", "--model.learning_rate", "0.002", *best)
    assert checkpoint(begun)["global_step"] == 6


def test_one_fit_at_a_time(begun, capsys):
    before = files(begun)
    hold = "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.lockf(f, 2); print(); input()"
    with subprocess.Popen(
        [sys.executable, "-c", hold, begun / ".lock"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        assert f"another `darswin fit` is at work in {begun}" in error(capsys, begun, "--resume")
        assert files(begun) == before
        other.kill()
    with locked(begun / ".lock"):
        pass


def test_a_cut_off_checkpoint_is_named_with_the_other_one(whole, begun, capsys):
    last, best = (begun / "checkpoints" / f"{name}.ckpt" for name in ("last", "best"))
    data = last.read_bytes()
    for size in (0, 100, len(data) // 2, len(data) - 10):
        last.write_bytes(data[:size])
        message = error(capsys, begun, "--resume")
        assert f"{last} cannot be read as a checkpoint; --ckpt_path {best}" in message
    fit(begun, "--resume", "--ckpt_path", str(best))
    assert_same(begun, whole)
    best.unlink()
    last.write_bytes(data[:99])
    assert error(capsys, begun, "--resume").strip().endswith("cannot be read as a checkpoint")


def test_few_steps_an_epoch_are_logged_and_the_number_of_processes_is_kept(tmp_path):
    fit(tmp_path, *TINY, "--trainer.log_every_n_steps", "50", "--devices", "1")
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["trainer"]["devices"] == 1
    with next(tmp_path.glob("csv/*/metrics.csv")).open() as lines:
        logged = {int(row["step"]) for row in csv.DictReader(lines) if row["train/loss"]}
    assert logged == {2, 5}


def test_the_progress_bar_shows_no_folder(tmp_path, capsys):
    fit(tmp_path, *TINY, "--trainer.enable_progress_bar", "true", "--trainer.max_steps", "1")
    shown = capsys.readouterr().out
    assert "train/loss" in shown and "v_num" not in shown and "oard" not in shown
