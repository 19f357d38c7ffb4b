"""What strangers install and how it is made: the wheel, the workflows, the citation."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
TARGETS = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def targets_of(command: str) -> list[str]:
    """The targets of one call of make."""
    make, *words = command.split()
    assert make == "make", command
    return [word for word in words if "=" not in word]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_a_workflow_runs_make_and_nothing_else(path):
    jobs = yaml.safe_load(path.read_text())["jobs"].values()
    asked = []
    for job in jobs:
        for command in (step["run"] for step in job["steps"] if "run" in step):
            variants = job["strategy"]["matrix"].get("targets", [""])
            for variant in variants:
                asked += targets_of(command.replace("${{ matrix.targets }}", variant))
    assert asked and TARGETS.issuperset(asked)


def test_both_workflows_are_looked_at():
    assert [path.name for path in WORKFLOWS] == ["ci.yml", "wheels.yml"]


def test_ci_is_that_of_the_makefile():
    said = re.search(r"^make (.*)", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)[1]
    (job,) = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"].values()
    assert " ".join(job["strategy"]["matrix"]["targets"]) == said


def test_cibuildwheel_uses_what_is_there():
    options = PROJECT["tool"]["cibuildwheel"]
    repair = options["repair-wheel-command"].replace("-C {project} ", "")
    assert targets_of(repair) == ["repair"] and "repair" in TARGETS
    assert (ROOT / options["test-command"].removeprefix("python {project}/")).is_file()
    pinned = set(re.findall(r"^([a-z-]+)==", (ROOT / "requirements.txt").read_text(), re.M))
    for stage in ("before-build", "before-test"):
        names = re.search(r"\^\((.*)\)==", options[stage])[1].split("|")
        assert pinned.issuperset(names)


def test_every_target_that_is_not_a_file_is_phony():
    phony = re.search(r"^\.PHONY: (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]
    assert set(phony.split()) == TARGETS


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
