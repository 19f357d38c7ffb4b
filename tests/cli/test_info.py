import importlib.util
import tomllib
from pathlib import Path

import pytest
import torch

import darswin
from darswin.cli.info import EXTRAS, facts
from darswin.cli.main import main
from darswin.ops import cpu_capability

ROOT = Path(__file__).parent.parent.parent


def test_it_says_what_is_installed(capsys):
    main(["info"])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["darswin"].startswith(darswin.__version__)
    assert lines["torch"] == torch.__version__
    assert lines["tier"].startswith(f"{cpu_capability()}, of generic")
    assert all(lines[f"[{extra}]"] == "installed" for extra in EXTRAS)


def test_every_extra_is_told_and_what_it_lacks(monkeypatch):
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == declared["optional-dependencies"].keys()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    said = facts()
    for extra, packages in declared["optional-dependencies"].items():
        told = said[f"[{extra}]"]
        assert all(package.partition(">")[0] in told for package in packages)


def test_why_onednn_is_not_used(monkeypatch):
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    assert "is built without oneDNN" in facts()["float32"]


def test_it_takes_no_arguments(capsys):
    with pytest.raises(SystemExit):
        main(["info", "more"])
    assert "unrecognized arguments: more" in capsys.readouterr().err
