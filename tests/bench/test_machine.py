from importlib.metadata import PackageNotFoundError

import cv2
import numpy as np
import onnxruntime
import torch

from darswin.bench import machine


def test_the_record_names_the_versions_of_all_peers():
    head = machine.machine()
    versions = {"torch": torch, "numpy": np, "onnxruntime": onnxruntime}
    assert all(head[name] == module.__version__ for name, module in versions.items())
    opencv = [head[name] for name in machine.PACKAGES if name.startswith("opencv") and name in head]
    assert opencv and all(found.startswith(cv2.__version__) for found in opencv)


def test_packages_that_are_not_installed_are_left_out(monkeypatch):
    def version(name):
        if name in ("openvino", "opencv-python"):
            raise PackageNotFoundError(name)
        return "1.2"

    monkeypatch.setattr(machine, "version", version)
    head = machine.machine()
    assert set(machine.PACKAGES) - head.keys() == {"openvino", "opencv-python"}
    assert head["onnxruntime"] == head["darswin"] == "1.2"
