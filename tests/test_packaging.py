"""Files beside the code: the citation, and the sources of the data."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = PROJECT["project"]
    assert citation["version"] == project["version"] and citation["license"] == project["license"]
    assert citation["authors"] == project["authors"]
    assert citation["preferred-citation"]["url"] == project["urls"]["Paper"]


@pytest.mark.parametrize("folder", ["tests/lens/files", "tests/fixtures"])
def test_a_readme_names_the_source_of_each_data_file(folder):
    files = {path.name for path in (ROOT / folder).iterdir()} - {"README.md"}
    suffixes = {Path(name).suffix for name in files}
    named = re.findall(r"`([\w.]+)`", (ROOT / folder / "README.md").read_text())
    assert files == {name for name in named if Path(name).suffix in suffixes}
