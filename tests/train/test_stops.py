"""Runs that stop without an error: a resumed one ends where an uninterrupted one does."""

import os
import signal
from contextlib import nullcontext

import pytest
from helpers import in_turn, slow_but
from runs import DIGITS, assert_same, checkpoint, fit, patch_batch, table

from darswin.train.classification import Classification

# The rate is the same at each step, whatever ends the schedule: a limit of steps moves its end.
STEADY = [*("--model.warmup_epochs", "0"), *("--model.final_rate", "3e-3")]
# Batches in 2 epochs of 12, in steps of 5, 5 and 2 unless a case changes that.
CASES = {
    "accumulated": [],
    "validated within epochs": ["--trainer.val_check_interval", "5"],
    "validated between steps": ["--trainer.val_check_interval", "4"],
    "validated across epochs": [*("--trainer.val_check_interval", "10"),
                                *("--trainer.check_val_every_n_epoch", "null")],
    "validated rarely": ["--trainer.check_val_every_n_epoch", "2"],
    "cut epochs": ["--trainer.limit_train_batches", "7", "--data.workers", "1"],
    "one step": ["--trainer.accumulate_grad_batches", "12", "--checkpoint_steps", "5"],
}  # fmt: skip


def validations(run):
    """What a run and its continuations logged of their validations."""
    found = []
    for file in sorted(run.glob("csv/*/metrics.csv"), key=lambda file: file.stat().st_mtime_ns):
        rows = [line for line in table(file) if line.get("val/loss")]
        found += [(row["epoch"], row["step"], row["val/loss"], row["val/top1"]) for row in rows]
    return found


def want_a_stop(module):
    """As Lightning's Timer, or any other callback."""
    module.trainer.should_stop = True


def stop_at(monkeypatch, how, batch, run, *options):
    """A `fit` that is stopped in its n-th batch, or after its next step."""
    with monkeypatch.context() as patch:
        if how == "steps":
            done = checkpoint(run)["global_step"] if "--resume" in options else 0
            fit(run, *options, "--trainer.max_steps", done + 1)
        elif how == "time":
            patch_batch(patch, batch, want_a_stop)
            fit(run, *options)
        else:
            patch_batch(patch, batch, lambda module: os.kill(os.getpid(), signal.SIGTERM))
            try:
                fit(run, *options)
            except SystemExit as end:
                assert end.code == 143


@pytest.fixture(scope="module")
def wholes(tmp_path_factory):
    """Uninterrupted runs, made when they are asked for."""
    made = {}

    def whole(case):
        if case not in made:
            made[case] = tmp_path_factory.mktemp("whole") / "run"
            fit(made[case], *DIGITS, *STEADY, *CASES[case])
        return made[case]

    return whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "how"), in_turn([(case,) for case in CASES], ["steps", "time", "signal"])
)
def test_a_run_that_stops_at_every_step_ends_as_a_whole_one(
    wholes, tmp_path, monkeypatch, case, how
):
    whole, run = wholes(case), tmp_path / "parts"
    steps = checkpoint(whole)["global_step"]
    options = [*DIGITS, *STEADY, *CASES[case]]
    for step in range(1, steps + 1):
        stop_at(monkeypatch, how, 1, run, *options)
        assert checkpoint(run)["global_step"] == step
        options = ["--resume"]
    fit(run, "--resume", "--trainer.max_steps", "-1")
    assert_same(run, whole)
    assert validations(run) == validations(whole)
    assert checkpoint(run, "best")["global_step"] == checkpoint(whole, "best")["global_step"]


def early(tmp_path, patience):
    """The options for Lightning's EarlyStopping, on a score that never gets better."""
    file = tmp_path / "early.yaml"
    file.write_text(
        "trainer: {callbacks: [{class_path: EarlyStopping, init_args: {monitor: val/loss, "
        f"min_delta: 1000, patience: {patience}}}}}]}}"
    )
    return ["--config", str(file)]


@pytest.mark.slow
@pytest.mark.parametrize("every", [4, 5, 12])
def test_early_stopping_ends_a_whole_step(wholes, tmp_path, every):
    """Validations after 4 and 8 of 12 batches are amid a step of 5."""
    run = tmp_path / "run"
    often = ["--trainer.val_check_interval", every, "--trainer.accumulate_grad_batches", "5"]
    fit(run, *DIGITS, *STEADY, *often, *early(tmp_path, 1))
    step = checkpoint(run)["global_step"]
    assert step == {4: 2, 5: 2, 12: 6}[every]  # the second validation has no better score
    for _ in range(6):  # each call goes on to the next validation
        fit(run, "--resume")
    assert checkpoint(run)["global_step"] == 6
    assert_same(run, wholes("accumulated"))


@pytest.mark.slow
def test_a_least_number_of_epochs_holds_against_time_and_not_against_signals(tmp_path, monkeypatch):
    options = [*DIGITS, "--trainer.min_epochs", "2"]
    stop_at(monkeypatch, "time", 1, tmp_path / "time", *options)
    assert checkpoint(tmp_path / "time")["global_step"] == 6
    stop_at(monkeypatch, "signal", 1, tmp_path / "signal", *options)
    assert checkpoint(tmp_path / "signal")["global_step"] == 1


@pytest.mark.parametrize("how", slow_but(["signal", "time"], "signal"))
def test_a_stop_during_a_validation(whole, tmp_path, monkeypatch, how):
    def act(module, *batch):
        if how == "time":
            want_a_stop(module)
        elif batch[-1] == 0:  # a second signal would stop at once
            os.kill(os.getpid(), signal.SIGINT)
        return step(module, *batch)

    run, step = tmp_path / "run", Classification.validation_step
    stops = pytest.raises(SystemExit, match="130") if how == "signal" else nullcontext()
    with monkeypatch.context() as patch, stops:
        patch.setattr(Classification, "validation_step", act)
        fit(run, *DIGITS)
    assert checkpoint(run)["global_step"] == 3  # of 6: the epoch's
    fit(run, "--resume")
    assert_same(run, whole)
    assert validations(run) == validations(whole)
