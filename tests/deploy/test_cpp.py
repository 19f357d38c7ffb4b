"""The C++ examples are built, and classify pictures without Python."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from darswin import create_model
from darswin.deploy import camera
from darswin.deploy.export import export_package
from darswin.lens import Spherical

ROOT = Path(__file__).parents[2]
TOOLS = ("cmake", os.environ.get("CXX", "c++"))


def build(folder: Path, *options: str) -> None:
    for command in (
        ["cmake", "-S", ROOT / "examples/cpp", "-B", folder, *options],
        ["cmake", "--build", folder],
    ):
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        run = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert run.returncode == 0 and "warning" not in run.stderr.lower(), run.stderr


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """The folder of the built programs."""
    if missing := [tool for tool in TOOLS if shutil.which(tool) is None]:
        pytest.skip(f"{' and '.join(missing)} missing")
    folder = tmp_path_factory.mktemp("programs")
    build(folder, f"-DPython3_EXECUTABLE={sys.executable}")
    return folder


def libraries_of(program: Path) -> str:
    """What the dynamic linker loads, without its folders."""
    shown = subprocess.run(["ldd", program], capture_output=True, text=True, check=True).stdout
    assert "not found" not in shown
    return re.sub(r"=> .*(?= \()", "", shown)


def result(folder: Path, *arguments) -> str:
    """What a program prints: its result, or why it failed."""
    run = subprocess.run(arguments, cwd=folder, env={}, capture_output=True, text=True)
    assert (run.returncode == 0) == (not run.stderr)
    return run.stdout + run.stderr


def write_ppm(path: Path, picture: torch.Tensor) -> Path:
    height, width, _ = picture.shape
    path.write_bytes(b"P6\n%d %d\n255\n" % (width, height) + picture.numpy().tobytes())
    return path


@pytest.mark.slow
def test_the_programs_need_no_python(programs, tmp_path):
    with_torch, alone = libraries_of(programs / "classify"), libraries_of(programs / "frame")
    assert "libtorch_cpu.so" in with_torch and "libdarswin.so" in with_torch
    assert "libdarswin_frames.so" in alone and "torch" not in alone and "gomp" not in alone
    assert "python" not in with_torch + alone
    # Without torch and without Python, the second is built alone.
    build(tmp_path, f"-DDARSWIN_DIR={ROOT / 'darswin'}", "-DPython3_EXECUTABLE=none")
    assert (tmp_path / "frame").exists() and not (tmp_path / "classify").exists()


@pytest.mark.slow
def test_classify_prints_the_class_or_one_sentence(programs, tmp_path):
    options = dict(depths=(1,), num_heads=(1,), num_classes=5, mean=0.5, std=0.2)
    model = create_model("darswin_a_nano", **options).eval()
    lens = Spherical.from_fov(0.9, 2.6, 16.0)
    pictures = torch.randint(256, (2, 32, 40, 3), dtype=torch.uint8)
    package = tmp_path / "model.pt2"
    export_package(model, package, pictures, lens, fixed_lens=True)

    def told(*arguments):
        return result(tmp_path, programs / "classify", *arguments)

    with torch.no_grad():
        chances = model(pictures, lens).softmax(1)
    for picture, chance in zip(pictures, chances, strict=True):
        line = told(package, write_ppm(tmp_path / "a.ppm", picture))
        label, probability = re.fullmatch(r"class (\d+), probability (\S+)\n", line).groups()
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
        ([tmp_path / "none.pt2", small], "none.pt2 cannot be opened"),
        ([package, tmp_path / "none.ppm"], "none.ppm cannot be opened"),
        ([], "usage: .*"),
    ):
        assert re.fullmatch(f"classify: .*{error}\n", told(*arguments)), arguments


@pytest.mark.slow
def test_frame_prints_the_class_or_one_sentence(programs, tmp_path):
    torch.manual_seed(0)
    lens, size = Spherical.from_fov(0.9, 2.6, 16.0), (32, 40)
    pictures = torch.randint(256, (2, *size, 3), dtype=torch.uint8)
    network, names = tmp_path / "camera.safetensors", ["cat", "dog", "車", "tram", "bus"]

    def told(*arguments):
        return result(tmp_path, programs / "frame", *arguments)

    for channels, labels in ((3, None), (3, names), (1, names)):
        options = dict(num_classes=5, mean=0.5, std=0.2, in_chans=channels)
        model = create_model("darswin_a_nano", **options).eval()
        camera.export_network(model, lens, size, network, labels=labels)
        given = pictures[..., :channels]
        with torch.no_grad():
            chances = model(given, lens).softmax(1)
        for picture, chance in zip(given, chances, strict=True):
            path = tmp_path / "a.ppm"
            kind = b"P6" if channels == 3 else b"P5"
            path.write_bytes(b"%s\n40 32\n255\n" % kind + picture.contiguous().numpy().tobytes())
            found = re.fullmatch(r"class (\S+), probability (\S+)\n", told(network, path))
            label, probability = found.groups()
            best = int(chance.argmax())
            assert label == (str(best) if labels is None else names[best])
            assert float(probability) == pytest.approx(chance.max().item(), rel=1e-4)

    picture, short = write_ppm(tmp_path / "a.ppm", pictures[0]), tmp_path / "short.ppm"
    short.write_bytes(picture.read_bytes()[:-1])
    unet, maps = create_model("darswin_unet_a_nano").eval(), tmp_path / "unet.safetensors"
    camera.export_network(unet, lens, size, maps)
    for arguments, error in (
        ([network, picture], "frame must have the network's 1 channels, got 3"),
        ([maps, write_ppm(tmp_path / "b.ppm", pictures[0, 1:])], "the network is no classifier"),
        ([network, short], "short.ppm ends too early"),
        ([network, tmp_path / "none.ppm"], "none.ppm cannot be opened"),
        ([network, network], "camera.safetensors is not a binary PPM or PGM file .*"),
        ([picture, picture], "a.ppm is no network that darswin.frames can read: .*"),
        ([tmp_path / "none.safetensors", picture], "none.safetensors: No such file or directory"),
        ([], "usage: .*"),
    ):
        assert re.fullmatch(f"frame: .*{error}\n", told(*arguments)), arguments
