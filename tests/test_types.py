"""What type checkers see of an editable install, from another folder."""

import ast
import inspect
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path
from typing import get_args

import pytest

from darswin import lens
from darswin.lens.ideal import FocalLens
from darswin.models import create, list_models, load_model
from darswin.models.registry import list_pretrained, model_class

ROOT = Path(__file__).parent.parent
# In place of CMake: the modules are compiled already.
CMAKE = """#!/bin/sh
for word in "$@"; do case "$word" in -DDARSWIN_OUTPUT_DIR=*)
  mkdir -p "${word#*=}/frames"
  cp -n darswin/libdarswin.so "${word#*=}"
  cp -n darswin/frames/*.so "${word#*=}/frames"
esac; done
"""
CODE = """
from pathlib import Path
from typing import assert_type

import darswin
import darswin.models
from darswin import create_model, lens, load_model
from darswin.models import (
    DAT, ConvUnet, DarSwin, Encoder, FeatureMaps, LensAdapter, ModelCard, Swin, Unet,
)
from darswin.models.pixel import PixelModel
from darswin.views import make_view

assert_type(create_model("darswin_a_nano"), DarSwin)
assert_type(create_model("darswin_ra_small", num_classes=3, spacing="tan"), DarSwin)
assert_type(create_model("swin_tiny", view="mercator", features_only=False), Swin)
assert_type(create_model("dat_nano"), DAT)
assert_type(create_model("darswin_unet_a_micro", task="distance"), Unet)
assert_type(create_model("swin_unet_nano", view=make_view("square", 128)), Unet)
assert_type(create_model("conv_unet_nano"), ConvUnet)
assert_type(create_model("darswin_a_nano", features_only=True), FeatureMaps)
assert_type(create_model("swin_nano", features_only=True, out_indices=(0, 1)), FeatureMaps)


def of_any_name(name: str, only: bool) -> None:
    assert_type(create_model(name), Encoder | PixelModel)
    assert_type(create_model(name, task="segmentation"), PixelModel)
    assert_type(create_model(name, features_only=True, output_fmt="NCHW"), FeatureMaps)
    assert_type(create_model(name, features_only=only), Encoder | PixelModel | FeatureMaps)


assert_type(load_model("digits"), tuple[DarSwin, ModelCard])
assert_type(darswin.load_model(Path("m.safetensors")), tuple[Encoder | PixelModel, ModelCard])
assert_type(darswin.models.load_model("m.safetensors")[0], Encoder | PixelModel)
assert_type(darswin.optimize(create_model("dat_nano")), DAT)

assert_type(lens.Spherical.from_fov(0.5, 2.9, 32), lens.Spherical)
assert_type(lens.Spherical.from_fov(xi=[0.3, 0.9], fov=2.9, radius=32), lens.Spherical)
assert_type(lens.Perspective.from_fov(1.5, 32.0, image_size=(64, 64)), lens.Perspective)
assert_type(lens.Mei.from_fov(1.2, 2.9, 32, radial=[0.1], center=[31.0, 31.0]), lens.Mei)
assert_type(lens.Fisheye624.from_fov(2.9, 32, affine=[[1.0, 0.0], [0.0, 1.0]]), lens.Fisheye624)
LensAdapter(create_model("swin_nano"), 32, mean=(0.4, 0.5, 0.6), std=0.2, output="view")
"""
WRONG = {
    'create_model("darswin_a_nano", features_only=1)': "call-overload",
    'create_model("x", features_only=True, output_fmt="CHW")': "call-overload",
    "create_model(3)": "call-overload",
    "load_model(3)": "call-overload",
    'create_model("darswin_a_nano").decoder()': "operator",
    "darswin.nothing": "attr-defined",
    "lens.Spherical.from_fov(2.9, 32)": "call-arg",
    "lens.Perspective.from_fov(2.9, 32, xi=0.5)": "call-arg",
    'lens.Mei.from_fov("1", 2.9, 32)': "arg-type",
}


@pytest.mark.slow
def test_the_types_of_an_editable_install(tmp_path):
    """By mypy in an empty folder, after `pip install -e` elsewhere: pip calls the same function of
    setuptools, and unpacks the wheel as is done here."""
    source, programs, elsewhere = (tmp_path / name for name in ("source", "bin", "elsewhere"))
    for made in (source, programs, elsewhere):
        made.mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    shutil.copytree(ROOT / "darswin", source / "darswin", ignore=shutil.ignore_patterns("*.pyc"))
    for name in ("cmake", "ninja"):
        (programs / name).write_text(CMAKE)
        (programs / name).chmod(0o755)
    environment = {name: os.environ[name] for name in os.environ if name != "PYTHONPATH"}
    environment["PATH"] = f"{programs}:{environment['PATH']}"

    def run(*command, cwd):
        return subprocess.run(
            command, cwd=cwd, env=environment, capture_output=True, text=True, check=False
        )

    build = "from setuptools.build_meta import build_editable as b; b('dist')"
    built = run(sys.executable, "-c", build, cwd=source)
    assert built.returncode == 0, built.stdout + built.stderr
    venv.create(tmp_path / "venv", with_pip=False)
    (packages,) = (tmp_path / "venv").glob("lib/python*/site-packages")
    (wheel,) = (source / "dist").glob("darswin-*.whl")
    zipfile.ZipFile(wheel).extractall(packages)
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))  # torch
    python = tmp_path / "venv" / "bin" / "python"

    where = "import darswin.ops; print(darswin.__file__)"
    found = run(python, "-c", where, cwd=elsewhere)
    assert found.stdout.strip() == str(source / "darswin" / "__init__.py"), found.stderr
    code = [*CODE.splitlines(), *WRONG]
    (elsewhere / "code.py").write_text("\n".join(code))
    found = run(
        sys.executable, "-m", "mypy", "--python-executable", python, "code.py", cwd=elsewhere
    )
    *errors, summary = [line for line in found.stdout.splitlines() if " note: " not in line]
    assert summary.startswith("Found "), found.stdout + found.stderr
    told = {code[int(line.split(":")[1]) - 1]: line.rpartition(" ")[2] for line in errors}
    assert told == {line: f"[{kind}]" for line, kind in WRONG.items()}, found.stdout


def test_the_names_of_each_class():
    kinds = ("DarSwin", "DAT", "Swin", "Unet", "ConvUnet")
    names = {kind: get_args(getattr(create, f"{kind}Name")) for kind in kinds}
    found = {name: kind for kind in kinds for name in names[kind]}
    assert found == {name: model_class(name).__name__ for name in list_models()}
    assert sum(map(len, names.values())) == len(found)


def test_the_classes_of_trained_models():
    source = ast.parse(inspect.getsource(sys.modules[load_model.__module__]))
    loads = [node for node in source.body if getattr(node, "name", None) == "load_model"]
    (of_names, *_) = [ast.unparse(node.args.args[0].annotation) for node in loads]
    assert of_names == f"Literal[{', '.join(map(repr, list_pretrained()))}]"
    for name in list_pretrained():
        assert type(load_model(name)[0]).__name__ in ast.unparse(loads[0].returns)


@pytest.mark.parametrize(
    "kind", [m for m in lens.MODELS.values() if issubclass(m, FocalLens)], ids=lambda k: k.__name__
)
def test_the_declared_arguments_of_from_fov(kind):
    """A declaration for type checkers has the arguments that the lens has."""
    for base in kind.__mro__:
        tree = ast.parse(inspect.getsource(sys.modules[base.__module__]))
        own = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == base.__name__)
        declared = [n for n in ast.walk(own) if getattr(n, "name", None) == "from_fov"]
        if declared:
            break
    places = declared[0].args
    assert declared[0].args.vararg is None, f"{kind.__name__} declares no from_fov"
    parameters = kind._of_fov().signature.parameters.values()
    by_place = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert [a.arg for a in places.args] == ["cls", *by_place]
    assert {a.arg for a in places.kwonlyargs} == {p.name for p in parameters} - {*by_place}
    needed = [p for p in parameters if p.default is p.empty]
    assert len(places.defaults) == len(by_place) - len(needed)
