"""The Makefile tells what its set-up is doing, in any folder."""

import shutil
import subprocess
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).parents[1] / "Makefile"
# `python -m venv FOLDER` that makes programs that do nothing.
PYTHON = """#!/bin/sh
mkdir -p $3/bin
for name in pip python; do printf '#!/bin/sh\\n' > $3/bin/$name; chmod +x $3/bin/$name; done
"""


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_the_set_up_names_its_steps_once(tmp_path):
    folder = tmp_path / "a clone"  # whose path has a space
    folder.mkdir()
    shutil.copy(MAKEFILE, folder)
    for name in ("requirements.txt", "pyproject.toml", "setup.py"):
        (folder / name).touch()
    python = folder / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    command = ["make", "--no-print-directory", "build", f"PYTHON={python}"]
    first = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    steps = [line.split()[:2] for line in first.stdout.splitlines()]
    assert steps == [["1/3", "creating"], ["2/3", "installing"], ["3/3", "compiling"]]
    again = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert again.stdout == ""


def test_every_path_of_the_folder_is_quoted():
    text = MAKEFILE.read_text()
    assert text.count("$(CURDIR)") == 1 and '\nROOT := "$(CURDIR)"\n' in text
