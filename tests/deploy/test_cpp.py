"""The C++ example is built, and classifies pictures without Python."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from darswin import create_model
from darswin.deploy.export import export_package
from darswin.lens import Spherical

ROOT = Path(__file__).parents[2]
TOOLS = ("cmake", os.environ.get("CXX", "c++"))


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The built program."""
    if missing := [tool for tool in TOOLS if shutil.which(tool) is None]:
        pytest.skip(f"{' and '.join(missing)} missing")
    folder = tmp_path_factory.mktemp("classify")
    interpreter = f"-DPython3_EXECUTABLE={sys.executable}"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for command in (
        ["cmake", "-S", ROOT / "examples/cpp", "-B", folder, interpreter],
        ["cmake", "--build", folder],
    ):
        run = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert run.returncode == 0 and "warning" not in run.stderr.lower(), run.stderr
    return folder / "classify"


def write_ppm(path: Path, picture: torch.Tensor) -> Path:
    height, width, _ = picture.shape
    path.write_bytes(b"P6\n%d %d\n255\n" % (width, height) + picture.numpy().tobytes())
    return path


@pytest.mark.slow
def test_the_program_needs_no_python(program):
    libraries = subprocess.run(["ldd", program], capture_output=True, text=True, check=True).stdout
    assert "libtorch_cpu.so" in libraries and "libdarswin.so" in libraries
    assert "python" not in re.sub(r"=> \S+", "", libraries) and "not found" not in libraries


@pytest.mark.slow
def test_it_prints_the_class_or_one_sentence(program, tmp_path):
    options = dict(depths=(1,), num_heads=(1,), num_classes=5, mean=0.5, std=0.2)
    model = create_model("darswin_a_nano", **options).eval()
    lens = Spherical.from_fov(0.9, 2.6, 16.0)
    pictures = torch.randint(256, (2, 32, 40, 3), dtype=torch.uint8)
    package = tmp_path / "model.pt2"
    export_package(model, package, pictures, lens, fixed_lens=True)

    def result(*arguments):
        command = [program, *arguments]
        run = subprocess.run(command, cwd=tmp_path, env={}, capture_output=True, text=True)
        assert (run.returncode == 0) == (not run.stderr)
        return run.stdout + run.stderr

    with torch.no_grad():
        chances = model(pictures, lens).softmax(1)
    for picture, chance in zip(pictures, chances, strict=True):
        told = result(package, write_ppm(tmp_path / "a.ppm", picture))
        label, probability = re.fullmatch(r"class (\d+), probability (\S+)\n", told).groups()
        assert int(label) == chance.argmax()
        assert float(probability) == pytest.approx(chance.max().item(), rel=1e-4)

    small = write_ppm(tmp_path / "small.ppm", pictures[0, 1:])
    short = tmp_path / "short.ppm"
    short.write_bytes((tmp_path / "a.ppm").read_bytes()[:-1])
    for arguments, error in (
        ([package, small], r"the model takes uint8 \[32, 40, 3\], .* uint8 \[31, 40, 3\]"),
        ([package, short], "short.ppm ends too early"),
        ([package, package], "model.pt2 is not a binary PPM or PGM file .*"),
        ([small, small], ".*zip archive.*"),
        ([], "usage: .*"),
    ):
        assert re.fullmatch(f"classify: .*{error}\n", result(*arguments)), arguments
