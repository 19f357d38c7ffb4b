"""Errors that carry the names of their parameters."""

import ast
import pickle
import re
from pathlib import Path

import pytest
from helpers import refused

import darswin
from darswin.utils.parameters import check, naming, with_flags

PACKAGE = Path(darswin.__file__).parent


def test_flags_replace_the_parameters_that_an_error_carries():
    error = naming(
        FileNotFoundError("no `lens` in `camera`: give `lens` or `size`"), "lens", "size"
    )
    assert type(error) is FileNotFoundError and "give `lens` or `size`" in str(error)
    assert with_flags(error) == "no --lens in `camera`: give --lens or --size"
    assert with_flags(error, "--data.{}".format).startswith("no --data.lens in")
    assert with_flags(ValueError("a `size` of 3 and model=x")) == "a `size` of 3 and model=x"
    assert with_flags(pickle.loads(pickle.dumps(error))) == with_flags(error)


def test_an_error_has_the_parameters_of_its_causes():
    with pytest.raises(OSError) as caught:
        try:
            try:
                check("size", -1, False, "above 0")
            except ValueError as error:
                raise ValueError(f"camera 3: {error}") from error
        except ValueError as error:
            raise naming(OSError(f"`path` x.png: {error}"), "path") from error
    assert with_flags(caught.value) == "--path x.png: camera 3: --size must be above 0, got -1"


def test_what_is_checked():
    check("size", 3, True, "above 0")
    refused(r"^`size` must be above 0, got -1$", check, "size", -1, False, "above 0")
    refused(r"got 1{200}$", check, "size", 10**1000 // 9, False, "small")


def test_every_text_with_a_parameter_carries_it():
    """A name in backticks in a text of the package is also an argument in the same function."""
    lacking, total = [], 0
    for file in sorted(PACKAGE.rglob("*.py")):
        for function in ast.walk(ast.parse(file.read_text("utf-8"))):
            if not isinstance(function, ast.FunctionDef):
                continue
            body = function.body[1:] if ast.get_docstring(function) else function.body
            nodes = [node for part in body for node in ast.walk(part)]
            texts = [n.value for n in nodes if isinstance(n, ast.Constant) and type(n.value) is str]
            names = {name for text in texts for name in re.findall("`([a-z_]+)`", text)}
            total += len(names)
            lacking += [f"{file}: {function.name}: {name}" for name in names - {*texts}]
    assert total > 30 and not lacking
