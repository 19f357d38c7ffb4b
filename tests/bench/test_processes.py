"""What is measured in a process of its own, and what the record tells of the machine."""

import sys
from importlib.metadata import PackageNotFoundError

import cv2
import numpy as np
import onnxruntime
import pytest
import torch
from kit import machine, memory, start
from kit.timing import OURS

MB = 2**20


@pytest.mark.slow
@pytest.mark.skipif(not memory.available(), reason="this system does not tell a process its peak")
def test_a_training_step_tells_its_peak():
    found = memory.measure("training", "darswin_a_nano", 32, "float32", 64, OURS, 1)
    assert (found.mode, found.batch, found.name) == ("training, float32", 64, OURS)
    assert 100 * MB < found.before < found.between < found.peak
    # Activations of 64 images, most of all those of the first map: 16 of 256 × 24 floats a block.
    assert 64 * 256 * 24 * 4 * 8 < found.own < found.whole < 1000 * MB


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells the memory in /proc")
def test_a_program_tells_its_time_and_memory():
    small = start.measure("nothing", "python", "import time; time.sleep(0.05)", processes=3)
    large = start.measure(
        "nothing", "python", "block = bytearray(range(250)) * 400_000", processes=1
    )
    assert (small.subject, small.name) == ("nothing", "python")
    assert small.seconds >= 0.05
    assert 90e6 < large.resident - small.resident < 110e6


@pytest.mark.parametrize(
    ("measure", "arguments", "words"),
    [
        pytest.param(memory.measure, ("training", "no_model", 32, "float32", 2, OURS, 1),
                     r"of darswin cannot be measured(.|\n)*no_model", marks=pytest.mark.slow),
        (start.measure, ("model", "a runtime", "import no_module"),
         r"start of a runtime cannot be measured(.|\n)*no_module"),
    ],
)  # fmt: skip
def test_what_went_wrong_is_said(measure, arguments, words):
    with pytest.raises(RuntimeError, match=words):
        measure(*arguments)


def test_the_record_names_the_versions_of_the_peers_that_are_there(monkeypatch):
    head = machine.machine()
    versions = {"torch": torch, "numpy": np, "onnxruntime": onnxruntime}
    assert all(head[name] == module.__version__ for name, module in versions.items())
    opencv = [head[name] for name in machine.PACKAGES if name.startswith("opencv") and name in head]
    assert opencv and all(found.startswith(cv2.__version__) for found in opencv)

    def version(name):
        if name in ("openvino", "opencv-python"):
            raise PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr(machine, "version", version)
    head = machine.machine()
    assert set(machine.PACKAGES) - head.keys() == {"openvino", "opencv-python"}
    assert head["onnxruntime"] == head["darswin"] == "1.2"
