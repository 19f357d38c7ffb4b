"""Long steps tell that they are at work; short ones are silent."""

import time

from darswin.utils import progress
from darswin.utils.progress import Progress


def test_long_steps_tell_how_far_they_are(monkeypatch, capsys):
    monkeypatch.setattr(progress, "EVERY", 0.01)
    with Progress("counting", 3) as step:
        step.done = 2
        time.sleep(0.1)
    first, *_ = capsys.readouterr().err.splitlines()
    assert first == "darswin: counting: 2 of 3, 0 s"
    time.sleep(0.05)
    assert not capsys.readouterr().err  # it has ended
    with Progress("waiting"):
        time.sleep(0.1)
    assert capsys.readouterr().err.startswith("darswin: waiting: 0 s\n")


def test_short_steps_are_silent(capsys):
    with Progress("blinking"):
        pass
    assert capsys.readouterr().err == ""
