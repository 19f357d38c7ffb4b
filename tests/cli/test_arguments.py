"""Command lines but for `darswin lens`, `fit`, `test` and `predict`, which have their own tests."""

import inspect
import re
from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import Literal

import pytest
from helpers import ended
from hypothesis import given
from hypothesis import strategies as st

from darswin.cli import lens
from darswin.cli.arguments import run_command, with_lists
from darswin.cli.main import COMMANDS, main


@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("--mean .5 -1e-3 a.png --other 1 2 --mean", "--mean=[.5,-1e-3] a.png --other 1 2 --mean"),
        ("--std x", "--std x"),
        ("--size 10,8", "--size=[10,8]"),
        ("--size 10 8", "--size=[10,8]"),
        ("--size=[10, 8]", "--size=[10,8]"),
        ("--siz (10,8)", "--siz=[10,8]"),
        ("--paths a b --x 1", '--paths=["a", "b"] --x 1'),
        ("--paths=a b --x", '--paths=["a", "b"] --x'),
        ("--paths null --x", "--paths=null --x"),
        ('--paths ["a"]', '--paths=["a"]'),
        ("--paths=null", "--paths=null"),
        ("--pathsx a", "--pathsx a"),
        ("--paths", "--paths"),
    ],
)
def test_what_follows_an_option_is_its_list(typed, found):
    assert " ".join(with_lists(typed.split(), ("mean", "std", "size"), ["paths"])) == found


def command_of(*argv):
    """What a function with parameters of all kinds is called with."""
    found = {}

    def function(source: str, others: Sequence[str] = (), *, count: int, rate: float = 0.5,
                 kind: Literal["a", "b"] | None = None, sides: tuple[int, int] = (1, 2),
                 names: list[str] | None = None, out: Path | None = None,
                 shares: list[float] | None = None,
                 up: tuple[float, float, float] | None = None):  # fmt: skip
        """Does nothing.

        Args:
            count: of 100%
                of things.
            kind: of it.
            sides: of it, e.g. 3,4. And more.
        """
        found.update(locals())

    run_command(function, list(argv), "prog")
    found.pop("found")
    return found


def test_a_function_gets_its_arguments(capsys):
    usual = dict(source="s", others=(), count=3, rate=0.5, kind=None, sides=(1, 2), names=None)
    usual |= dict(shares=None, up=None)
    assert command_of("s", "--count", "3") == usual | {"out": None}
    assert command_of("s", "a", "b", "--count=-3", "--rate", "1e-3", "--kind", "b", "--sides",
                      "4", "5", "--names", '["x", "y"]', "--out", "o") == dict(
        source="s", others=["a", "b"], count=-3, rate=1e-3, kind="b", sides=(4, 5),
        names=["x", "y"], out=Path("o"), shares=None, up=None)  # fmt: skip
    numbers = command_of("s", "--count", "3", "--shares", "1,.5", "--up", "0", "-1", "1e-2")
    assert numbers == usual | dict(out=None, shares=[1.0, 0.5], up=(0.0, -1.0, 0.01))
    assert all(type(number) is float for number in (*numbers["shares"], *numbers["up"]))
    given = ("s", "--count", "3", "--rate", "2", "--kind", "null", "--out", "null", "--names")
    assert command_of(*given) == usual | dict(rate=2.0, names=[], out=None)
    text = " ".join(ended(capsys, 0, command_of, "--help").out.split())
    assert "Does nothing." in text and "of 100% of things." in text
    assert "of it. One of a, b." in text and "[1,2]" in text and "[0.5]" in text


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("s", "the following arguments are required: --count"),
        ("--count 3", "the following arguments are required: source"),
        ("s --count x", "--count must be a whole number, got x"),
        (
            "s --count 3 --sides 1,2,3",
            "--sides must be 2 whole numbers, got [1,2,3]: of it, e.g. 3",
        ),
        ("s --count=", "--count must be a whole number, got nothing"),
        ("s --count 3 --rate x", "--rate must be a number, got x"),
        ("s --count 3 --kind c", "--kind must be one of a, b, got c"),
        ("s --count 3 --sides 1,x", "--sides must be 2 whole numbers, got 1,x: of it, e.g. 3,4; "),
        ("s --count 3 --up 0,a,1", "--up must be 3 numbers, got 0,a,1"),
        ("s --count 3 --shares a", "--shares must be numbers, got a"),
        ("s --count 3 --names [1]", "--names must be a list of texts, got [1]"),
        ("s --count 3 --names [", "--names must be a list of texts, got ["),
        ("s --count 3 --speed 2", "unrecognized arguments: --speed 2"),
    ],
)
def test_wrong_arguments_are_one_sentence(capsys, typed, said):
    (line,) = ended(capsys, 2, command_of, *typed.split()).err.splitlines()
    assert line.startswith(f"prog: {said}") and line.endswith("; see `prog --help`")


WORDS = st.sampled_from(
    ["models", "convert", "--size", "--out", "--config", "--foo", "-x", "-", "--", "", "0",
     "-1", "9" * 5000, "1e300", "nan", "[", "[]", "1,,2", ",", "x", ".", "/dev/null", "\ud800",
     "²", "source", "=", "--size="]
)  # fmt: skip


@given(st.sampled_from(["models", "convert"]), st.lists(WORDS, max_size=5))
def test_any_arguments_end_with_an_answer_or_a_sentence(tmp_path_factory, name, words):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.getbasetemp())
        try:
            main([name, *words])
        except SystemExit as end:
            assert end.code in (0, 2)


LENS = [f"lens {name}" for name in lens.COMMANDS]
HELPED = ["predict", "predict --network n.onnx", "quantize", "convert", *LENS]


@pytest.mark.parametrize("name", HELPED)
def test_help_describes_every_argument_in_sentences(capsys, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "2000")  # no text is broken into lines
    command, part = [*name.split(), ""][:2]
    function = resolve_name(COMMANDS[command].function)
    function = function[part] if isinstance(function, dict) else function
    text = ended(capsys, 0, main, [*name.split(), "--help"]).out
    assert text.splitlines()[2].endswith(".")
    for argument in inspect.signature(function).parameters:
        (described,) = re.findall(rf"^  (?:--)?{argument}\b(?: [A-Z_[\]]+)?\s+(.+)", text, re.M)
        assert re.search(r"\S\.( \[[^\]]*\])?$", described), described
        assert "read_state" not in described
