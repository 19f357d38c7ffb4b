"""What is missing is said, with a command that installs it."""

import importlib.util
import shlex

import pytest
from packaging.requirements import Requirement

from darswin.cli.main import COMMANDS, NEEDS, TRAIN, main
from darswin.utils.extras import lack


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_a_command_names_the_packages_that_it_lacks(command, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    if not NEEDS.get(command, TRAIN):
        main(["models"])
        return
    with pytest.raises(SystemExit) as stopped:
        main([command])
    said, _, install = str(stopped.value).partition("pip install ")
    assert said.startswith(f"darswin {command}: ") and "jsonargparse" in said
    packages = [Requirement(word) for word in shlex.split(install)]
    assert {"jsonargparse", "lightning", "opencv-python-headless"} <= {p.name for p in packages}
    assert all(package.specifier for package in packages)
    assert "darswin" not in install and "onnx" not in install


def test_nothing_is_missing_here():
    assert lack("train", TRAIN) is None
