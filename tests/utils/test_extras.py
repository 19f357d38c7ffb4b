"""What is missing is said, with a command that installs it."""

import importlib.util
import shlex
import sys

import pytest
from helpers import output
from packaging.requirements import Requirement

from darswin.cli.main import COMMANDS, TRAIN, main
from darswin.utils.extras import lack

NAMES = {"PIL": "pillow", "cv2": "opencv-python-headless", "sklearn": "scikit-learn"}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_names_the_packages_that_it_lacks(command, monkeypatch):
    assert lack("train", COMMANDS[command].needs) is None
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    needs = COMMANDS[command].needs
    if not needs:
        assert lack("train", needs) is None
        return
    with pytest.raises(SystemExit) as stopped:
        main([command])
    said, _, install = str(stopped.value).partition("pip install ")
    assert said.startswith(f"darswin {command}: ") and "cv2" in said
    packages = [Requirement(word) for word in shlex.split(install)]
    assert sorted(p.name for p in packages) == sorted(NAMES.get(name, name) for name in needs)
    assert all(package.specifier for package in packages)


@pytest.mark.slow
@pytest.mark.parametrize("command", [c for c in COMMANDS if COMMANDS[c].needs != TRAIN])
def test_a_command_imports_no_more_than_it_says(command):
    script = (
        "import sys\n"
        "from darswin.cli.main import COMMANDS, TRAIN, main\n"
        f"needs = COMMANDS[{command!r}].needs\n"
        "for name in set(TRAIN) - set(needs): sys.modules[name] = None\n"
        f"main([{command!r}, '--help'])"
    )
    assert "usage" in output(sys.executable, "-c", script)
