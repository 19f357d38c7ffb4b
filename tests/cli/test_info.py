import importlib.util
import tomllib
from pathlib import Path

import torch

import darswin
from darswin.cli.info import EXTRAS, facts
from darswin.cli.main import main
from darswin.ops import _module, cpu_capability

ROOT = Path(__file__).parent.parent.parent


def test_facts_of_this_machine(capsys):
    main(["info"])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["darswin"].startswith(darswin.__version__)
    assert lines["torch"] == torch.__version__
    assert lines["tier"].startswith(f"{cpu_capability()}, of {_module.tiers()[0]}")
    assert all(lines[f"[{extra}]"] == "installed" for extra in EXTRAS)


def test_what_is_missing_and_why_onednn_is_not_used(monkeypatch):
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == declared["optional-dependencies"].keys()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: False)
    found = facts()
    assert "is built without oneDNN" in found["float32"]
    for extra, packages in declared["optional-dependencies"].items():
        assert all(package.partition(">")[0] in found[f"[{extra}]"] for package in packages)
