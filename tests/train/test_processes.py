"""Runs of two processes, of which one is killed: all others end, within seconds."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from train.kills import ALL, start, wait_for_steps

from darswin.utils.processes import die_with_first_process

TINY = [
    *("--config", "minutes", "--data.path", "digits", "--data.limit", "64"),
    *("--data.batch_size", "4", "--trainer.max_epochs", "100000", "--devices", "2", *ALL),
    *("--data.workers", "1", "--model.options", "{embed_dim: 8}"),
]


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


@pytest.mark.parametrize(
    ("victim", "moment"), [("first", "start"), ("first", "training"), ("second", "training")]
)
def test_when_a_process_is_killed_all_end(tmp_path, victim, moment):
    run = tmp_path / "run"
    first = start(run, *TINY)
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
    finally:
        for process in of_session(first.pid):
            os.kill(process, signal.SIGKILL)
        first.wait()


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
