"""Imports load only the modules they need; slow modules are imported where they are used."""

import ast
import json
import sys
from pathlib import Path

import pytest
import torch
from helpers import output

import darswin

LENS = Path(__file__).parent.parent / "examples" / "room.json"
# Importing each of these takes a part of a second or more.
HEAVY = {
    "PIL", "cv2", "jsonargparse", "lightning", "matplotlib", "onnx", "sklearn", "sympy",
    "torch._dynamo", "torch._inductor", "torch.utils.tensorboard", "torchmetrics",
}  # fmt: skip
COMMAND = """
from importlib.metadata import entry_points
(command,) = entry_points(group="console_scripts", name="darswin")
command.load()({})
"""


def loaded(code: str) -> set[str]:
    """The names of the modules that a new Python process has loaded after running the code."""
    report = "import json, sys; print(); print(json.dumps([*sys.modules]))"
    *_, names = output(sys.executable, "-c", f"{code}\n{report}").splitlines()
    return set(json.loads(names))


@pytest.mark.slow
def test_the_package_alone_loads_nothing_and_the_help_no_torch():
    modules = loaded("import darswin")
    assert {name for name in modules if name.startswith("darswin")} == {"darswin"}
    assert modules.isdisjoint({"numpy", "torch"})
    assert loaded(COMMAND.format(["--help"])).isdisjoint({"numpy", "torch"} | HEAVY)


@pytest.fixture(scope="module")
def with_torch():
    return loaded("import torch")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "needed"),
    [
        ("import darswin.ops", "darswin.ops"),
        ("from darswin import *", "darswin.ops"),
        (COMMAND.format(["lens", "info", str(LENS)]), "darswin.viz.report"),
    ],
)
def test_nothing_heavy_is_loaded(code, needed, with_torch):
    modules = loaded(f"import torch\n{code}")
    assert needed in modules and not (modules - with_torch) & HEAVY


@pytest.mark.slow
def test_every_module_for_inference_may_be_the_first_one():
    names = sorted(path.stem for path in Path(darswin.__file__).parent.glob("deploy/[a-z]*.py"))
    assert "optimize" in names
    code = f"""
import os, torch
for name in {names}:
    if not (process := os.fork()):
        __import__(f"darswin.deploy.{{name}}")
        os._exit(0)
    assert os.waitpid(process, 0)[1] == 0, name
"""
    loaded(code)


def test_every_public_name_is_found():
    names: dict[str, object] = {}
    exec("from darswin import *", names)
    assert set(darswin.__all__) <= names.keys()
    assert {*darswin.__all__, "__version__"} <= set(dir(darswin))
    assert darswin.optimize is sys.modules["darswin.deploy.optimize"].optimize
    assert darswin.lens is sys.modules["darswin.lens"]
    with pytest.raises(AttributeError, match="'darswin' has no attribute 'nothing'"):
        _ = darswin.nothing


def test_type_checkers_see_the_same_modules():
    tree = ast.parse(Path(darswin.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    seen = {name.name: node.module for node in imports for name in node.names}
    assert {name: seen[name] for name in darswin.__all__} == {
        name: darswin._MODULES.get(name, "darswin") for name in darswin.__all__
    }


def test_constants_are_marked_as_torch_marks_them():
    from darswin.ops import _library

    def function(): ...

    marked = torch.compiler.assume_constant_result(function)
    assert vars(marked) == vars(_library._has_autocast) != {}
