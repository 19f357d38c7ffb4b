"""The layering of the package: a folder imports only from lower folders, and never in a circle."""

import graphlib
from pathlib import Path

import grimp
import pytest
from grimp import Layer

ROOT = Path(__file__).parent.parent
# From the top down. Folders of one floor do not import each other.
FLOORS = (
    ("cli",),
    ("train",),
    ("compat", "deploy"),
    ("models", "viz"),
    ("data", "layers"),
    ("calibrate", "views"),
    ("lens",),
    ("frames", "ops"),
    ("boxes",),
    ("utils",),
)
MOST_LINES = 400


@pytest.fixture(scope="module")
def imports():
    return grimp.build_graph("darswin", cache_dir=None)


def test_every_room_has_a_floor(imports):
    rooms = {child.removeprefix("darswin.") for child in imports.find_children("darswin")}
    assert rooms - {"__main__"} == {room for floor in FLOORS for room in floor}


def test_no_import_runs_upward(imports):
    layers = [Layer(*floor, independent=True) for floor in FLOORS]
    upward = imports.find_illegal_dependencies_for_layers(layers, containers={"darswin"})
    assert not upward, upward


def test_no_room_imports_the_whole_package(imports):
    assert not imports.find_modules_that_directly_import("darswin")


def test_modules_import_each_other_in_no_circle(imports):
    # A package that imports its compiled module seems to import itself.
    graph = {
        name: imports.find_modules_directly_imported_by(name) - {name} for name in imports.modules
    }
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("folder", ["benchmarks", "csrc", "darswin", "docs", "examples", "studies"])
def test_no_file_of_code_is_long(folder):
    files = (file for file in (ROOT / folder).rglob("*") if file.suffix in (".py", ".cpp", ".h"))
    lines = {str(file.relative_to(ROOT)): file.read_text().count("\n") for file in files}
    assert lines and not {name: n for name, n in lines.items() if n > MOST_LINES}
