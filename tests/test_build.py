"""The compiled module: its tiers, what it links, and what happens when it is not there."""

import json
import os
import re
import shlex
import shutil
import sys
import sysconfig
import tarfile
import zipfile
from fnmatch import fnmatch
from pathlib import Path

import calibrate_boards as boards
import numpy as np
import pytest
import torch
from graphs import write_constants
from helpers import output
from scenes import write, write_classes, write_outlines, write_rooms
from torch_abi_audit import inspect_extension

from darswin.frames import _frames
from darswin.lens.rig import CUBES
from darswin.ops import _module, cpu_capability, polar_sample

ROOT = Path(__file__).parent.parent


def test_the_tier_in_use_is_the_one_asked_for():
    tiers = _module.tiers()
    asked = os.environ.get("ATEN_CPU_CAPABILITY", tiers[-1])
    assert cpu_capability() == {"default": tiers[0]}.get(asked, asked)


def test_tiers_of_this_machine():
    capability = torch.backends.cpu.get_cpu_capability()
    expected = {"DEFAULT": 1, "AVX2": 2, "AVX512": 3}.get(capability, 1)
    if "ATEN_CPU_CAPABILITY" in os.environ:
        assert len(_module.tiers()) >= expected
    else:
        assert len(_module.tiers()) == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    ("asked", "expected"),
    [("default", "generic"), ("avx2", "avx2"), ("avx512", "avx512"), ("nonsense", None)],
)
def test_environment_chooses_the_tier_at_load(asked, expected):
    code = "from darswin.ops import cpu_capability; print(cpu_capability())"
    found = output(sys.executable, "-c", code, env=dict(ATEN_CPU_CAPABILITY=asked))
    best = _module.tiers()[-1]
    assert found.strip() == (expected if expected in _module.tiers() else best)


X86 = "generic,avx2,avx512"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "processor", "tiers"),
    [
        ("Linux", "x86_64", X86), ("Linux", "aarch64", "neon"), ("Linux", "riscv64", "generic"),
        ("Darwin", "arm64", "neon"), ("Darwin", "x86_64", X86),
    ],
)  # fmt: skip
def test_a_build_for_each_processor(system, processor, tiers, tmp_path):
    """It is configured here, and not started."""
    settings = dict(
        TORCH_DIR=Path(torch.__file__).parent,
        CMAKE_SYSTEM_NAME=system,
        CMAKE_SYSTEM_PROCESSOR=processor,
        DARSWIN_PYTHONS=f".cpython-311-{system}.so:{sysconfig.get_path('include')}",
    )
    if system == "Darwin":  # no compiler of this machine makes programs for macOS
        settings |= dict(CMAKE_CXX_COMPILER_WORKS=1, CMAKE_HAVE_LIBC_PTHREAD=1)
    defined = [f"-D{name}={value}" for name, value in settings.items()]
    output("cmake", "-G", "Ninja", "-S", ROOT, "-B", tmp_path, *defined)
    commands = (tmp_path / "compile_commands.json").read_text()
    assert f"-DDARSWIN_TIERS={tiers} " in commands
    assert set(re.findall(r"-DTIER=(\w+)", commands)) == set(tiers.split(","))
    if system == "Linux":
        return
    ninja = (tmp_path / "build.ninja").read_text()
    library, c_library, python = map(shlex.split, re.findall(r" LINK_FLAGS = (.*)", ninja))
    for flags, exported in ((library, "darswin_*"), (c_library, "darswin_*"), (python, "PyInit_*")):
        (name,) = (flag for flag in flags if flag.startswith("-Wl,-exported_symbol,_"))
        assert fnmatch(name.rpartition(",_")[2], exported) and "-Wl,-dead_strip" in flags
        assert not [flag for flag in flags if "version-script" in flag or "gc-sections" in flag]
    assert "-Wl,-undefined,dynamic_lookup" in python and "/lib/libtorch_cpu.dylib" in ninja


def test_tiers_can_be_forced_and_agree():
    before = cpu_capability()
    image, radii = torch.randn(1, 3, 40, 40), torch.linspace(0, 20, 32)[None]
    azimuths, center = torch.linspace(0, 6, 48), torch.tensor([[19.5, 19.5]])
    results = []
    try:
        for tier in _module.tiers():
            _module.set_tier(tier)
            assert cpu_capability() == tier
            results.append(polar_sample(image, radii, azimuths, center, samples=(4, 4), jitter=0.5))
    finally:
        _module.set_tier(before)
    for other in results[1:]:
        torch.testing.assert_close(other, results[0], rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match=r"tier must be one that .* got 'sse9'"):
        _module.set_tier("sse9")


def test_build_info():
    info = _module.build_info()
    assert info["cxx_standard"] >= 202002 and "stable" in info["torch_abi"]


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory) -> Path:
    """The unpacked sdist after README's lines were pasted there into an empty environment, with our
    version of torch for the newest, and in its `dist` a wheel: without optimization, in a fraction
    of the time."""
    folder = tmp_path_factory.mktemp("sdist")
    output(sys.executable, *["-m", "build", "--no-isolation", "--sdist", "--outdir"], folder, ROOT)
    (sdist,) = folder.glob("darswin-*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    sources = folder / sdist.name.removesuffix(".tar.gz")
    # Stands for a Python beside this one: the same headers, and another name of the module.
    another = sources / "another-python"
    another.write_text(f"#!/bin/sh\necho .another-python.so:{sysconfig.get_path('include')}\n")
    another.chmod(0o755)
    ours = Path(sys.executable).parent
    path = [place for place in os.environ["PATH"].split(":") if Path(place) != ours]
    environment = dict(
        PATH=":".join(path), PYTHONPATH="", CMAKE_BUILD_TYPE="None", DARSWIN_PYTHONS=str(another)
    )
    _, install = (ROOT / "README.md").read_text().split("## Install\n")
    torch_line, *others = install.split("```sh\n")[1].partition("```")[0].splitlines()
    assert torch_line == "pip install torch"
    (version,) = re.findall(r"^torch==.*", (ROOT / "requirements.txt").read_text(), re.M)
    lines = [
        "set -e", f"{shlex.quote(sys.executable)} -m venv empty", ". empty/bin/activate",
        f"pip install {version}", *others,
        "pip wheel --no-deps --no-build-isolation --wheel-dir dist .",
    ]  # fmt: skip
    printed = output("sh", "-c", "\n".join(lines), cwd=sources, env=environment)
    (sources / "printed").write_text(printed)
    return sources


def write_labels(folder: Path) -> None:
    write_outlines(folder / "coco")
    (folder / "coco" / "lens.json").rename(folder / "lens.json")
    (folder / "flat.json").write_text('{"model": "Perspective", "fov_deg": 60}')


def write_pictures(folder: Path) -> None:
    shutil.copytree(ROOT / "examples" / "surround", folder / "photos")
    (folder / "photos" / "rig.json").rename(folder / "rig.json")
    for name, of in (("a.jpg", "parking.jpg"), ("lens.json", "parking.json")):
        shutil.copy(ROOT / "examples" / of, folder / name)
    (folder / "sim").mkdir()
    for name in CUBES["carla"]:
        write(folder / "sim" / f"{name}.png", np.full((90, 90, 3), 99, np.uint8))
    box = np.array([[[100, 100, 200, 200]]], np.float32)
    values = dict(boxes=box, scores=box[..., 0] / 200, labels=box[..., 0].astype(np.int64))
    write_constants(folder / "yolo.onnx", (256, 256), **values)


# What README's first table takes for granted, by the command, and what the command leaves.
ROWS = {
    "calibrate": (lambda at: boards.main([f"{at}/photos", "--count", "8"]), "camera.json"),
    "estimate": (lambda at: write_rooms(at / "photos", 2), "lens.json"),
    "show": (write_pictures, "lens.png"),
    "predict": (write_pictures, "found/overlays/a.jpg"),
    "fisheye": (write_pictures, "fisheye/images/0000.png"),
    "stitch": (write_pictures, "ground.png"),
    "warp": (write_labels, "fisheye/annotations.json"),
    "fit": (lambda at: write_classes(at / "photos"), "runs/a/checkpoints/best.safetensors"),
}


@pytest.mark.slow
def test_the_lines_and_rows_of_the_readme_run_where_it_is_installed(unpacked, tmp_path):
    (answer,) = re.findall(r"^\[\n.*?^\]\n", (unpacked / "printed").read_text(), re.M | re.S)
    assert json.loads(answer)[0]["top"][0]["class"] == "4"  # as the page says
    first, *_ = (ROOT / "README.md").read_text().partition("## DarSwin")
    typed = re.findall(r"^\| .* \| `(.+)` \|$", first, re.M)
    for (name, (prepare, left)), line in zip(ROWS.items(), typed, strict=True):
        words, folder = shlex.split(line), tmp_path / name
        assert name in words[:2]
        folder.mkdir()
        prepare(folder)
        output(unpacked / "empty/bin/darswin", *words, cwd=folder, env=dict(PYTHONPATH=""))
        assert (folder / left).stat().st_size > 0, line


@pytest.mark.parametrize("optimized", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_no_inline_function_leaks_from_a_tier(optimized, request):
    """A weak symbol compiled with AVX-512 could be the copy that the linker keeps for every CPU.

    Where code is optimized, such a function may have been inlined; so all is also compiled without.
    """
    root = ROOT if optimized else request.getfixturevalue("unpacked")
    build = root / "build" / os.environ.get("DARSWIN_BUILD", "cmake")
    commands = json.loads((build / "compile_commands.json").read_text())
    kernels = [command for command in commands if "/kernels/" in command["file"]]
    assert all((" -O3 " in command["command"]) == optimized for command in kernels)
    sources = {command["file"] for command in kernels}
    assert sources == set(map(str, (root / "csrc" / "kernels").glob("*.cpp")))
    tiers = set(re.findall(r"/kernels_(\w+)\.dir/", " ".join(c["output"] for c in kernels)))
    assert tiers >= set(_module.tiers()) and len(kernels) == len(tiers) * len(sources)
    for command in kernels:
        path = build / command["output"]
        shown = output("nm", "-C", "--defined-only", path)
        symbols = re.findall(r"^\w+ (\w) (.*)$", shown, re.MULTILINE)
        outside = [(kind, name) for kind, name in symbols if kind not in "tbdr"]
        assert outside, "not even a table of kernels"
        for kind, name in outside:
            table = re.fullmatch(r"darswin::Kernels<.*, \(darswin::Tier\)\d>::table", name)
            # The second is a pointer to what handles exceptions, the same from every tier.
            known = (kind in "DR" and table) or (kind, name) == ("V", "DW.ref.__gxx_personality_v0")
            assert known, f"{path.name}: {kind} {name}"


def test_the_module_keeps_to_the_stable_abi_of_torch_2_10():
    torch_abi = inspect_extension(_module.FILE).torch
    assert torch_abi.uses_torch and torch_abi.stable, torch_abi.unstable_symbols
    assert torch_abi.min_torch_version == "2.10.0" and not torch_abi.unknown_shim_symbols


FRAMES = Path(_frames.__file__)
LIBRARY = FRAMES.parent / "libdarswin_frames.so"
HEADER = FRAMES.parent / "include" / "darswin_frames.h"
ALL = pytest.mark.parametrize("path", [_module.FILE, FRAMES, LIBRARY], ids=lambda path: path.name)


@ALL
def test_the_modules_hold_no_path_of_the_build_machine(path):
    module = path.read_bytes()
    sources = re.findall(rb"[\w./+-]+\.(?:h|hpp|cpp)\b", module)
    assert not [name for name in sources if name.startswith(b"/")]
    for folder in (ROOT, Path(torch.__file__).parent, sys.prefix, sys.base_prefix):
        assert str(folder).encode() not in module
    dynamic = output("readelf", "-d", path)
    assert "RPATH" not in dynamic and "RUNPATH" not in dynamic
    needed = [line for line in dynamic.splitlines() if "NEEDED" in line]
    assert any("libtorch_cpu.so" in line for line in needed) == (path == _module.FILE)
    assert not any("omp" in line for line in needed)
    assert not any("/" in line.split("[")[1] for line in needed)


def test_the_modules_export_no_more_than_needed():
    facts = {"tier", "tiers", "set_tier", "build_info", "byte_products", "cpu_is_intel"}
    facts |= {"use_torch_threads"}
    for path, names in [
        (_module.FILE, {f"darswin_{fact}" for fact in facts}),
        (FRAMES, {"PyInit__frames"}),
        (LIBRARY, set(re.findall(r"\b(darswin_\w+)\(", HEADER.read_text()))),
    ]:
        shown = output("nm", "-D", "--defined-only", path)
        assert {line.split()[-1] for line in shown.splitlines()} == names


@ALL
def test_the_modules_ask_for_nothing_newer_than_manylinux_2_28(path):
    compiler, version = _module.build_info()["compiler"].split()[:2]
    if compiler == "clang++":  # it uses the headers of g++
        version = output("g++", "-dumpversion")
    if int(version.split(".")[0]) > 12:
        pytest.skip("headers of a newer compiler may ask for more: use the container")
    newest = {"GLIBC": (2, 28), "GLIBCXX": (3, 4, 24), "CXXABI": (1, 3, 11)}
    shown = output("readelf", "-V", path)
    found = re.findall(r"Name: (GLIBC|GLIBCXX|CXXABI)_([\d.]+)", shown)
    assert {library for library, _ in found} == set(newest)
    for library, version in found:
        assert tuple(map(int, version.split("."))) <= newest[library], f"{library}_{version}"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems need no portable.cpp")
def test_a_program_with_the_core_copies_exceptions(tmp_path):
    """What portable.cpp defines for modules would call itself without end in a program."""
    sources = ROOT / "tests/cpp/exceptions.cpp", ROOT / "csrc/core/portable.cpp"
    output("g++", "-std=c++20", *sources, "-o", tmp_path / "program")
    assert output(tmp_path / "program") == "copied\n"


def test_a_module_that_cannot_be_loaded_is_explained(monkeypatch, tmp_path):
    monkeypatch.setattr(_module, "FILE", tmp_path / "libdarswin.so")
    with pytest.raises(
        ImportError, match=re.escape(f"no compiled module, {_module.FILE}: its wheel is")
    ):
        _module.load()
    _module.FILE.write_bytes(b"not a library")
    with pytest.raises(ImportError) as caught:
        _module.load()
    message = str(caught.value)
    assert f"{_module.FILE}: file too short" in message
    assert torch.__version__ in message and "torch>=2.10" in message
    assert "make build" in message and "pip install" in message
    assert isinstance(caught.value.__cause__, OSError)


def test_python_in_a_checkout_that_is_not_built_is_explained(monkeypatch, tmp_path):
    monkeypatch.setattr(_module, "FILE", tmp_path / "darswin" / "libdarswin.so")
    (tmp_path / "setup.py").touch()
    with pytest.raises(ImportError, match=r"from its source code in .*, which has no compiled"):
        _module.load()


@pytest.mark.slow
@pytest.mark.parametrize("broken", [False, True])
def test_without_its_modules_darswin_runs_the_reference_and_says_why(tmp_path, broken):
    package, program = tmp_path / "darswin", ROOT / "tests" / "without_module.py"
    shutil.copytree(ROOT / "darswin", package, ignore=shutil.ignore_patterns("*.so"))
    if broken:
        (package / "libdarswin.so").write_bytes(b"not a library")
    said = output(sys.executable, program, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)})
    if broken:
        assert f"{package / 'libdarswin.so'}: file too short" in said
        assert "make build" in said and f"torch {torch.__version__} is running" in said
    else:
        assert f"no compiled module, {package / 'libdarswin.so'}: its wheel is" in said
    assert "darswin.frames: cannot load" in said and "No module named 'darswin.frames._fr" in said


@pytest.mark.slow
def test_the_sdist_builds_a_wheel_that_runs_from_another_folder(unpacked, tmp_path):
    (wheel,) = (unpacked / "dist").glob("darswin-*-py3-none-linux_*.whl")
    assert not (unpacked / "tests").exists()  # setuptools would add a few, without their helpers
    names = zipfile.ZipFile(wheel).namelist()
    modules = {
        name.removeprefix("darswin/frames/").removeprefix("darswin/")
        for name in names
        if name.endswith(".so")
    }
    assert modules == {"libdarswin.so", FRAMES.name, "_frames.another-python.so", LIBRARY.name}
    assert "darswin/frames/include/darswin_frames.h" in names
    assert all(name.startswith(("darswin/", "darswin-")) for name in names)
    elsewhere = tmp_path / "site"
    output(sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", elsewhere, wheel)
    code = (
        "import torch, darswin; print(darswin.__file__, darswin.ops._module.FILE);"
        "lens = darswin.lens.Spherical.from_fov(0.4, 2.6, 16.0);"
        "model = darswin.create_model('darswin_a_nano', num_classes=3);"
        "print(model(torch.zeros(1, 3, 32, 32), lens).shape)\n"
        # An exception of a module whose functions the compiler has not inlined.
        "try: darswin.frames._frames.polar_places([], [], [], None, None, (2, 2))\n"
        "except ValueError as error: print(error)"
    )
    out = output(sys.executable, "-c", code, cwd=tmp_path, env={"PYTHONPATH": str(elsewhere)})
    assert out.count(str(elsewhere)) == 2 and "torch.Size([1, 3])" in out
    assert "the arrays of the grid do not fit together" in out
    assert (elsewhere / "darswin" / "train" / "presets" / "iccv2023.yaml").is_file()
    assert (elsewhere / "bin" / "darswin").is_file()
