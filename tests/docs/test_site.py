"""The site builds without a warning, and has an entry for every public name."""

import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
from sphinx.util.inventory import InventoryFile

import darswin

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-n", "-W", "--keep-going", DOCS, out]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


def test_it_has_every_public_name(site):
    with (site / "objects.inv").open("rb") as file:
        inventory = InventoryFile.load(file, "", lambda base, name: name)
    entries = {name for kind in inventory.values() for name in kind}
    modules = set(inventory["py:module"])
    missing: list[str] = []
    for module in map(importlib.import_module, sorted(modules)):
        own = {
            name
            for name, value in vars(module).items()
            if (inspect.isclass(value) or inspect.isfunction(value))
            and value.__module__ == module.__name__
            and value.__doc__
        }
        names = getattr(module, "__all__", [name for name in own if not name.startswith("_")])
        missing += [
            f"{module.__name__}.{n}" for n in names if f"{module.__name__}.{n}" not in entries
        ]
    assert not missing
    assert len(entries) > 400


def test_every_room_has_a_page():
    rooms = {name for _, name, package in pkgutil.iter_modules(darswin.__path__) if package}
    for room in rooms - {"cli"}:  # the page of commands
        text = (DOCS / "reference" / f"{room}.md").read_text()
        assert text.startswith(f"# darswin.{room}\n")
        public = {
            name
            for _, name, _ in pkgutil.iter_modules(
                importlib.import_module(f"darswin.{room}").__path__
            )
            if not name.startswith("_")
        }
        if not hasattr(sys.modules[f"darswin.{room}"], "__all__"):
            assert public == set(re.findall(rf"automodule:: darswin\.{room}\.(\w+)", text))
    pages = {path.stem for path in (DOCS / "reference").glob("*.md")}
    assert pages == rooms - {"cli"} | {"index", "commands"}
