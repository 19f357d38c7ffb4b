"""Prints the lowest versions that pyproject.toml allows, for `make test-lowest`.

torch and what the tests alone need are those of requirements.txt: torch's older wheels are gone.
"""

import re
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parent.parent
PINNED = ("torch", "pytest", "hypothesis", "allpairspy", "onnxruntime")


def lowest() -> list[str]:
    """`name[extras]==version` of each declared dependency, in pip's form."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = chain(project["dependencies"], *project["optional-dependencies"].values())
    versions = {}
    for requirement in declared:
        name, version = re.match(r"([\w.\[\]-]+)>=([\w.]+)", requirement).groups()
        if name not in PINNED:
            assert versions.setdefault(name, version) == version, f"{name} has two lower bounds"
    pins = re.findall(
        rf"^(?:{'|'.join(PINNED)})==.*", (ROOT / "requirements.txt").read_text(), re.M
    )
    return [*pins, *(f"{name}=={version}" for name, version in versions.items())]


if __name__ == "__main__":
    print("\n".join(lowest()))
