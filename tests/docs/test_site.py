"""The site builds without a warning, and has an entry for every public name."""

import re
import sys
from pathlib import Path

import pytest
from helpers import output
from sphinx.util.inventory import InventoryFile
from test_docstrings import MODULES, public_names

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.slow
def test_the_site_has_every_public_name(tmp_path):
    output(sys.executable, "-m", "sphinx", "-q", "-n", "-W", "--keep-going", DOCS, tmp_path)
    with (tmp_path / "objects.inv").open("rb") as file:
        inventory = InventoryFile.load(file, "", lambda base, name: name)
    entries = {name for kind in inventory.values() for name in kind}
    found = {entry.rpartition(".")[2] for entry in entries}
    assert {path.rpartition(".")[2] for path in public_names()} <= found | {"__version__"}
    pages = "".join(page.read_text() for page in (tmp_path / "reference").glob("*.html"))
    assert "BrownConrady" in pages
    assert "Args:" not in pages and "<strong>Others" not in pages  # a section or name left raw


def test_the_pages_name_the_modules_with_public_names():
    text = "".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    named = set(re.findall(r"automodule:: ([\w.]+)", text))
    assert named == {module.__name__ for module in MODULES if hasattr(module, "__all__")}
