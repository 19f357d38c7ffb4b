import importlib.util
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F

import darswin
from darswin.cli.info import EXTRAS, facts
from darswin.cli.main import main
from darswin.deploy.record import RULES
from darswin.ops import _module, cpu_capability, linear

ROOT = Path(__file__).parent.parent.parent


def test_facts_of_this_machine(capsys):
    main(["info"])
    lines = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert lines["darswin"].startswith(darswin.__version__)
    assert lines["torch"] == torch.__version__
    assert lines["tier"].startswith(f"{cpu_capability()}, of {_module.tiers()[0]}")
    assert all(lines[f"[{extra}]"] == "installed" for extra in EXTRAS)


@pytest.mark.parametrize(
    ("model", "way"),
    [
        ("darswin_a_nano", "one program"), ("conv_unet_nano", "one program"),
        ("digits", "one program"), ("dat_nano", "layer by layer, because of stages.1"),
        ("swin_unet_nano", "layer by layer, because of segmentation_head"),
    ],
)  # fmt: skip
def test_how_a_model_runs(model, way, capsys, monkeypatch):
    if way != "one program":
        monkeypatch.delitem(RULES, F.gelu)
    main(["info", "--model", model])
    assert capsys.readouterr().out.splitlines()[-1].startswith(f"model     {model}: {way}")


@pytest.mark.parametrize("ours", [False, True])
def test_what_is_missing_and_who_multiplies(ours, monkeypatch):
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == declared["optional-dependencies"].keys()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(linear, "IS_FASTER", ours)
    found = facts()
    assert found["training"] == f"linear layers by {'darswin' if ours else 'torch'}"
    for extra, packages in declared["optional-dependencies"].items():
        assert all(package.partition(">")[0] in found[f"[{extra}]"] for package in packages)


@pytest.mark.slow
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-", ">/dev/full", "2>/dev/full"])
def test_standard_streams_may_be_closed_or_full(closed):
    """Without a traceback. Words that are lost make exit code 2, unless nobody wants them."""
    full = closed == ">/dev/full"
    for words, code in (("--help", 2 * full), ("nothing", 2), ("models", 2 * full)):
        line = f'"{sys.executable}" -m darswin {words} {closed}'
        done = subprocess.run(["sh", "-c", line], capture_output=True, text=True)
        assert done.returncode == code, (words, done.stderr)
        assert all(text.startswith("darswin: ") for text in done.stderr.splitlines())
        assert "there is no command" not in done.stdout


@pytest.mark.slow
def test_closed_streams_are_no_place_for_files(tmp_path):
    """A file that is opened after a closed stream would get its number, and what C code prints."""
    script = (
        "import sys; from darswin.cli.main import main; main(['info']); "
        "assert open(sys.argv[1], 'w').fileno() > 2"
    )
    line = f'"{sys.executable}" -c "{script}" {tmp_path / "a"} <&- >&- 2>&-'
    assert subprocess.run(["sh", "-c", line]).returncode == 0
