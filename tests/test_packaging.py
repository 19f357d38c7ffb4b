"""Files beside the code: the citation, and the sources of the data."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
TARGETS = {*re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M)}
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


def test_the_conda_recipe_is_of_this_version():
    recipe = yaml.safe_load((ROOT / "conda-recipe" / "recipe.yaml").read_text())
    project = PROJECT["project"]
    assert recipe["context"]["version"] == project["version"]
    assert recipe["about"]["license"] == project["license"]
    (command,) = recipe["build"]["python"]["entry_points"]
    assert command == " = ".join(["darswin", project["scripts"]["darswin"]])

    def in_conda(requirements):
        return {re.sub("^torch", "pytorch", r).replace(">=", " >=") for r in requirements}

    needed = recipe["requirements"]
    assert {*needed["run"]} == {"python", *in_conda(project["dependencies"])}
    assert {*needed["build"], *needed["host"]} >= in_conda(PROJECT["build-system"]["requires"])


def test_ci_runs_targets_of_make():
    ci = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    rows = ci["jobs"]["make"]["strategy"]["matrix"]["include"]
    assert {target for row in rows for target in row["targets"].split()} <= TARGETS
    assert {row["machine"] for row in rows} == {"ubuntu-24.04", "ubuntu-24.04-arm"}


def test_every_other_python_is_found_where_wheels_are_built():
    """cibuildwheel itself does not replace `*` and `[1-4]` in the result of a command."""
    settings = PROJECT["tool"]["cibuildwheel"]
    for environment in (settings["environment"], settings["macos"]["environment"]):
        assert re.fullmatch(r"\$\(sh -c 'echo \S*\*?\S+'\)", environment["DARSWIN_PYTHONS"])


def test_a_tag_publishes_what_make_builds():
    release = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    assert release[True]["push"] == {"tags": ["v*"]}  # YAML reads `on` as True
    assert release["permissions"] == {"contents": "read"}
    build, publish = release["jobs"]["build"], release["jobs"]["publish"]
    rows = build["strategy"]["matrix"]["include"]
    assert {row["target"] for row in rows} == {"sdist", "published-wheels", "pure-wheel"} <= TARGETS
    wheels = {row["machine"] for row in rows if row["target"] == "published-wheels"}
    assert wheels == {"ubuntu-24.04", "ubuntu-24.04-arm", "macos-14"}
    assert publish["needs"] == "build" and publish["if"] == "github.ref_type == 'tag'"
    assert publish["permissions"] == {"id-token": "write"}
    *_, last = publish["steps"]
    assert last == {"uses": "pypa/gh-action-pypi-publish@release/v1"}  # without a password
