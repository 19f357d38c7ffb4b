"""Command lines of functions, by jsonargparse: lists as people type them, errors in a sentence."""

import inspect
import json
import re
import types
import typing
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Literal, NoReturn

_NUMBERS = re.compile(r"[\s\[\](),.+\-eE\d]*\d[\s\[\](),.+\-eE\d]*")
_WORDS = {int: "a whole number", float: "a number", bool: "true or false"}


def run_command(commands: Callable[..., Any] | dict[str, Any], argv: list[str], prog: str) -> None:
    """Calls the function, or the one of several that `argv` names, with the arguments in `argv`.

    Raises:
        SystemExit: code 2 and a sentence on stderr for arguments that the function does not take.
    """
    from jsonargparse import ArgumentParser, auto_cli

    functions = commands.values() if isinstance(commands, dict) else [commands]
    kinds = {
        name: parameter.annotation
        for function in functions
        for name, parameter in inspect.signature(function).parameters.items()
    }

    class Parser(ArgumentParser):
        def error(self, message: str, ex: Exception | None = None) -> NoReturn:
            of = getattr(ex, "subcommand_parser", None) or self
            of = of.prog.replace(" [options]", "")
            self.exit(2, f"{of}: {_sentence(message, kinds)}; `{of} --help` tells more\n")

    lists = [name for name, kind in kinds.items() if _length(kind)]
    auto_cli(
        commands, args=with_lists(argv, lists), prog=prog, parser_class=Parser, fail_untyped=False
    )


def with_lists(argv: Sequence[str], names: Collection[str]) -> list[str]:
    """The arguments with the numbers of each list in one: `--size 10,10`, `--size 10 10` and
    `--size=[10, 10]` become `--size=[10,10]`.

    Args:
        names: of the options that take a list, without dashes.
    """
    found, left = [], list(argv)
    while left:
        argument = left.pop(0)
        option, equals, value = argument.partition("=")
        # argparse also takes an unambiguous beginning of an option's name.
        if option[:2] != "--" or not any(name.startswith(option[2:] or "-") for name in names):
            found.append(argument)
            continue
        parts = [value] if equals else []
        while (not parts or _NUMBERS.fullmatch(parts[-1])) and left and _NUMBERS.fullmatch(left[0]):
            parts.append(left.pop(0))
        if all(_NUMBERS.fullmatch(part) for part in parts) and parts:
            numbers = re.findall(r"[^\s\[\](),]+", " ".join(parts))
            argument = f"{option}=[{','.join(numbers)}]"
        found.append(argument)
    return found


def with_words(argv: Sequence[str], name: str) -> list[str]:
    """The arguments with all words that follow an option in one list: `--paths A B` becomes
    `--paths=["A", "B"]`; what is a list already stays.

    Args:
        name: of the option, without dashes.
    """
    found, left = [], list(argv)
    while left:
        argument = left.pop(0)
        option, equals, value = argument.partition("=")
        if option == f"--{name}" and not value.startswith("[") and value != "null":
            words = [value] if equals else []
            while left and not left[0].startswith("-"):
                words.append(left.pop(0))
            if words not in ([], ["null"]) and not words[0].startswith("["):
                argument = f"{option}={json.dumps(words)}"
            else:
                argument = "=".join((option, *words))
        found.append(argument)
    return found


def _sentence(message: str, kinds: Mapping[str, Any]) -> str:
    """What jsonargparse says of an argument, in one line and with options as people type them."""
    key = re.search(r'[Kk]ey "([^"]+)"', message)
    name = key[1].rpartition(".")[2] if key else ""
    got = re.search(r"(?:Got|Given) value: (.*)", message)
    if name in kinds and got:
        return f"--{name} must be {_kind(kinds[name])}, got {got[1] or 'nothing'}"
    return " ".join(message.split()).rstrip(".")


def _kind(annotation: Any) -> str:
    """A type in words."""
    options = typing.get_args(annotation)
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        kinds = dict.fromkeys(_kind(option) for option in options if option is not types.NoneType)
        return " or ".join(kinds)
    if typing.get_origin(annotation) is Literal:
        return f"one of {', '.join(map(str, options))}"
    if length := _length(annotation):
        return f"{length} whole numbers, such as {','.join(['10'] * length)}"
    return _WORDS.get(annotation, "a text")


def _length(annotation: Any) -> int:
    """How many numbers an option of a tuple type takes; 0 for other types."""
    if typing.get_origin(annotation) is tuple:
        return len(typing.get_args(annotation))
    return max((_length(option) for option in typing.get_args(annotation)), default=0)
