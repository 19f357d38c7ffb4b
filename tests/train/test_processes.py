"""Runs in processes of their own, as a user starts them: kills, and two that train as one."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers import output
from runs import DIGITS, PIXELS, assert_same, checkpoint, fit, test
from train.kills import finish, start, wait_for_steps

from darswin.utils.processes import die_with_first_process

PAIR = ["--devices", "2", "--trainer.accelerator", "cpu"]
ENDLESS = [*DIGITS, *PAIR, "--trainer.max_epochs", "100000", "--data.workers", "1"]


@pytest.mark.slow
def test_a_killed_process_goes_on_bit_for_bit(whole, tmp_path):
    run = tmp_path / "killed"
    process = start(run, *DIGITS)
    while not (run / "checkpoints" / "last.ckpt").exists() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoint(run)["global_step"] > 0
    finish(run, start(run, "--resume"))
    assert_same(run, whole)


def of_session(session: int) -> dict[int, int]:
    """The running processes of a session, and the parent of each."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        state, parent, _, its_session = fields[:4]
        if int(its_session) == session and state != "Z":
            found[int(folder.name)] = int(parent)
    return found


def seconds_of(first: int) -> list[int]:
    """The second process of a run, or none yet."""
    children = [process for process, parent in of_session(first).items() if parent == first]
    return [p for p in children if b"LOCAL_RANK=1\0" in Path(f"/proc/{p}/environ").read_bytes()]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("victim", "moment"), [("first", "start"), ("first", "training"), ("second", "training")]
)
def test_when_a_process_is_killed_all_end(tmp_path, victim, moment):
    run = tmp_path / "run"
    first = start(run, *ENDLESS)
    try:
        if moment == "training":
            wait_for_steps(run, first)
        while first.poll() is None and not (second := seconds_of(first.pid)):
            time.sleep(0.01)
        assert first.poll() is None, Path(f"{run}.log").read_text()
        os.kill({"first": first.pid, "second": second[0]}[victim], signal.SIGKILL)
        # Importing may take the second one that long on a busy machine; it would wait for minutes.
        end = time.monotonic() + 60
        while of_session(first.pid) and time.monotonic() < end:
            first.poll()
            time.sleep(0.1)
        assert of_session(first.pid) == {}
        assert first.wait() != 0
        said = Path(f"{run}.log").read_text()
        assert "Traceback" not in said
        if victim == "second":
            goes_on = f": `darswin fit --run {run} --resume` goes on"
            ended = f"darswin: process 2 of 2 (number {second[0]}) was ended by SIGKILL{goes_on}"
            assert said.splitlines()[-1] == ended
    finally:
        for process in of_session(first.pid):
            os.kill(process, signal.SIGKILL)
        first.wait()


@pytest.mark.slow
def test_an_orphan_ends_at_once():
    script = "from darswin.utils.processes import *\nwith die_with_first_process(): pass"
    # The first process has died before this one looked: Linux has no such number.
    environment = os.environ | {"LOCAL_RANK": "1", "DARSWIN_FIRST_PROCESS": str(2**22 + 1)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, timeout=300)
    assert done.returncode == 1


@pytest.mark.parametrize(
    ("rank", "first"),
    [
        ("1", None),  # started by torchrun or SLURM
        ("0", "1"),  # started by a process of another run
    ],
)
def test_other_processes_stay_as_they_are(monkeypatch, rank, first):
    monkeypatch.setenv("LOCAL_RANK", rank)
    if first is not None:
        monkeypatch.setenv("DARSWIN_FIRST_PROCESS", first)
    with die_with_first_process():
        assert os.environ["DARSWIN_FIRST_PROCESS"] == str(os.getpid())
    assert "DARSWIN_FIRST_PROCESS" not in os.environ


BOTH = """
import json, sys
from darswin.cli.main import main
for words in json.loads(sys.argv[1]):
    main(words)
"""


def with_gradients(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The weights without those whose exact gradient is 0.

    The softmax cancels a number that is equal for all keys: the bias of the keys, and b_theta in
    windows of one ring, as in the first stage. Adam scales the rounding errors of these gradients
    up to whole steps, so they differ between runs that add in another order.
    """
    kept = {}
    for name, tensor in weights.items():
        if name.endswith("qkv.bias"):
            queries, _, values = tensor.chunk(3)
            tensor = torch.cat((queries, values))
        if not (".stages.0." in name and name.endswith("b_theta")):
            kept[name] = tensor
    return kept


@pytest.mark.slow
@pytest.mark.parametrize("task", ["classification", "segmentation"])
def test_two_processes_train_and_test_as_one(scenes, tmp_path, task):
    still, options = "jitter: 0, drop_path_rate: 0}", DIGITS
    if task == "segmentation":
        options = ["--task", task, "--data.path", str(scenes), *PIXELS, "--data.limit", "40"]
    own = options[options.index("--model.options") + 1]
    options = [
        *(*options, "--model.options", own.replace("}", f", {still}"), "--trainer.max_epochs", "1"),
        *("--data.randaugment", "false", "--trainer.accumulate_grad_batches", "1"),
    ]
    one, two = tmp_path / "one", tmp_path / "two"
    fit(one, *options)
    lenses = [] if task == "segmentation" else ["--xi", "0,0.5"]
    before = test(one, *lenses)
    commands = [
        ["fit", "--run", str(two), *options, *PAIR, "--data.batch_size", "4"],
        ["test", "--run", str(one), *PAIR, *lenses, "--trainer.enable_progress_bar", "false"],
    ]
    script = tmp_path / "both.py"
    script.write_text(BOTH)
    # Lightning starts the second process as a copy of the first.
    threads = {"OMP_NUM_THREADS": "1"}
    output(sys.executable, script, json.dumps(commands), env=threads, timeout=300)
    found, expected = (with_gradients(checkpoint(run)["state_dict"]) for run in (two, one))
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)
    for a, b in zip(json.loads((one / "test.json").read_text())["results"], before, strict=True):
        numbers = {name: value for name, value in b.items() if isinstance(value, float | int)}
        assert {name: a[name] for name in numbers} == pytest.approx(numbers, abs=2e-3)
