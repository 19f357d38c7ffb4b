import logging
import subprocess
import sys
import warnings

import pytest

from darswin.deploy.export import quiet_export

LOGGER = logging.getLogger("torch.onnx._internal.exporter")


def say():
    LOGGER.warning("folding")
    LOGGER.error("wrong")
    warnings.warn("soon", FutureWarning, stacklevel=1)
    warnings.warn("ours", UserWarning, stacklevel=1)


def test_only_within_the_context_and_what_matters_is_still_said(caplog):
    before = logging.getLogger("torch.onnx").level
    with pytest.warns() as seen, quiet_export():
        say()
    assert [str(warning.message) for warning in seen] == ["ours"]
    assert "wrong" in caplog.text and "folding" not in caplog.text
    with pytest.warns() as seen:
        say()
    assert [str(warning.message) for warning in seen] == ["soon", "ours"]
    assert "folding" in caplog.text and logging.getLogger("torch.onnx").level == before


EXPORT = """
import sys, torch
from darswin.deploy.export import export_onnx
from darswin.lens import from_dict
from darswin.models import create_model
model = create_model("swin_nano", num_classes=4, depths=[1, 1, 1]).eval()
export_onnx(model, sys.argv[1], torch.zeros(2, 3, 32, 32))
"""


@pytest.mark.slow
def test_an_export_to_onnx_prints_only_our_own_lines(tmp_path):
    command = [sys.executable, "-c", EXPORT, str(tmp_path / "model.onnx")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = (done.stdout + done.stderr).splitlines()
    assert [line for line in lines if not line.startswith("darswin: ")] == []  # signs of life
