"""Functions as commands: their parameters are the arguments, their docstrings are the help."""

import argparse
import inspect
import json
import os
import re
import tempfile
import types
import typing
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NoReturn

import yaml

from darswin.utils.nearest import nearest

_NUMBERS = re.compile(r"[\s\[\](),.+\-eE\d]*\d[\s\[\](),.+\-eE\d]*")
# What the same argument means in several commands, unless their docstrings say it.
_TEXTS = {
    "calib": "the calibration file of the camera, in any format that darswin.lens.load reads.",
    "camera": "the name or number of the camera, if the calibration has several.",
    "coefficients": "the distortion model of an OpenCV or ROS calibration that does not name it.",
    "image_size": "height and width of the images in px, e.g. 960,1280, if the file lacks them.",
    "theta_max_deg": "the largest incident angle of the lens, in degrees, where the last ring of a "
    "partition ends. The default is the largest angle that the images show.",
    "fov_deg": "the horizontal field of view of a view between the outer edges of a row, in "
    "degrees. The default is all that the lens sees.",
    "up": "the direction away from gravity. For views: as x right, y down and z forward of the "
    "camera; the default is the top of the picture, 0,-1,0. For rigs: in the frame of their file; "
    "the default is what the file says.",
    "every": "the step between the frames of a video that are predicted; 1 predicts all.",
    "rings": "the number of rings of the partition.",
    "sectors": "the number of sectors of the partition.",
    "rig": "the file or the folder of a rig, in any format that darswin.Rig.load reads; or "
    "cube:SIDE for the six pictures of a simulator, with their side in px.",
    "height": "the height of the origin of the rig's file above the ground, in metres.",
    "direction": "where the poses of a file lead that does not say so.",
    "span": "the width of the ground that is shown, in metres. The default is 12.",
    "distance": "of what the cameras see, in metres, if they are at different places and the "
    "ground is not shown. The default is far away.",
}
# Nobody names a folder so, but for a mistake.
_OF_FILES = {".csv", ".jpeg", ".jpg", ".json", ".mp4", ".onnx", ".png", ".safetensors", ".txt",
             ".yaml", ".yml", ".zip"}  # fmt: skip
_WORDS = {int: "a whole number", float: "a number", bool: "true or false"}


class Parser(argparse.ArgumentParser):
    """A parser that ends the program with one sentence and exit code 2."""

    def error(self, message: str) -> NoReturn:
        message = with_nearest(" ".join(message.split()), self._option_string_actions)
        self.exit(2, f"{self.prog}: {message}; see `{self.prog} --help`\n")


def with_nearest(message: str, *names: Collection[str]) -> str:
    """A parser's message. If it is about unknown options, it gets the options that were probably
    meant: each from the same group, or else from the first of `names` that holds a similar one."""
    if not message.startswith("unrecognized arguments: "):
        return message
    found = []
    for word in (word.partition("=")[0] for word in message.split() if word.startswith("--")):
        group, _, last = word.rpartition(".")
        same = [name for name in names[-1] if name.startswith(f"{group}.")]
        for part in (same, *names):
            by_last = {name.rpartition(".")[2].lstrip("-"): name for name in part}
            if near := nearest(last.lstrip("-"), by_last, alike=0.7):
                found.append(by_last[near[0]])
                break
    return f"{message}; the nearest option is {', '.join(found)}" if found else message


def run_command(commands: Callable | dict[str, Callable], argv: list[str], prog: str) -> None:
    """Calls a function with the arguments in `argv`. Of several functions, `argv` names one first;
    or, if their names are options, the one whose option is in `argv`, and otherwise that of "".

    Keyword-only parameters are options; the others are positional. The annotations define which
    values are valid. The help consists of the docstring, its text and its section `Args`, and of
    `_TEXTS`.
    """
    if isinstance(commands, dict) and "" in commands:
        commands = _by_option(commands, [word.partition("=")[0] for word in argv])
    if isinstance(commands, dict):
        if argv and argv[0] in commands:
            run_command(commands[argv[0]], argv[1:], f"{prog} {argv[0]}")
            return
        parser = Parser(prog=prog)
        each = (f"{name}: {_summary(function)}" for name, function in commands.items())
        parser.add_argument("command", choices=commands, help=" ".join(each))
        parser.parse_args(argv or ["--help"])
        return
    text, _, section = (inspect.getdoc(commands) or "").partition("\nArgs:\n")
    parser = Parser(prog=prog, description=" ".join(text.split()).replace("%", "%%"))
    texts = _TEXTS | dict(re.findall(r"^    (\w+): (.*(?:\n        .*)*)", section, re.M))
    kinds = {}
    for name, parameter in inspect.signature(commands).parameters.items():
        kinds[name] = kind = _without_none(parameter.annotation)
        words = [*texts.get(name, "").replace("%", "%%").split()]
        if _kind(kind).startswith("one of"):
            words.append(f"{_kind(kind).capitalize()}.")
        settings: dict[str, Any] = dict(default=parameter.default)
        if parameter.kind is not parameter.KEYWORD_ONLY:
            settings |= dict(nargs="*") if _is_list(kind) else {}
        elif parameter.default is parameter.empty:
            settings |= dict(required=True)
        else:
            settings |= dict(nargs="?", const="[]") if _is_list(kind) else {}
            words += [] if parameter.default is None else [f"[{_typed(parameter.default)}]"]
        option = f"--{name}" if parameter.kind is parameter.KEYWORD_ONLY else name
        parser.add_argument(option, help=" ".join(words), **settings)
    lists = [name for name, kind in kinds.items() if _is_list(kind)]
    given = vars(parser.parse_intermixed_args(with_lists(argv, lists)))
    for name, text in given.items():
        if text == "null" and parser.get_default(name) is None:
            given[name] = None
        elif isinstance(text, str):
            try:
                given[name] = _value(text, kinds[name])
            except (ValueError, KeyError, yaml.YAMLError):
                meaning = " ".join(texts.get(name, "").split()) * _is_list(kinds[name])
                first = re.split(r"\.(?= [A-Z]|$)", meaning)[0]  # of its sentences
                said = f"--{name} must be {_kind(kinds[name])}, got {text or 'nothing'}"
                parser.error(": ".join(filter(None, (said, first))))
    commands(**given)


def _by_option(commands: dict[str, Callable], words: list[str]) -> Callable:
    """The function whose option is among `words`; ValueError for an option of another function."""
    chosen = next((o for o in commands if any(o.startswith(w) for w in words if w[2:])), "")
    own = inspect.signature(commands[chosen]).parameters
    for option, function in commands.items():
        for name in inspect.signature(function).parameters:
            if f"--{name}" in words and name not in own:
                goes = f"is an option of {option}" if option else f"does not go with {chosen}"
                raise ValueError(f"--{name} {goes}")
    return commands[chosen]


def check_out(
    out: str | None, inputs: Iterable[str], option: str = "out", may_be_folder: bool = False
) -> None:
    """Raises ValueError if `out` cannot be written, or would replace a file that is read."""
    if out is None:
        return
    path = Path(out).absolute()
    fits = (may_be_folder or not path.is_dir()) and can_write(path)
    if not fits:
        raise ValueError(f"--{option} must be a file in a folder that can be written, got {out}")
    for name in inputs:
        if all(map(os.path.isfile, (name, out))) and os.path.samefile(name, out):
            raise ValueError(f"--{option} {out} would replace {name}, which this command reads")


def check_out_folder(folder: Path, option: str = "out") -> None:
    """Raises ValueError if a folder to write to is or seems to be a file, or cannot be written."""
    text = f"--{option} must be a folder"
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{text}, but {folder} is a file")
    if not folder.exists() and folder.suffix.lower() in _OF_FILES:
        raise ValueError(f"{text}, but {folder} has the ending of a file: leave it out")
    if not can_write(folder.absolute()):
        raise ValueError(f"{text} that can be written, got {folder}")


def can_write(path: Path) -> bool:
    """True if a file or a folder can be written; tried where it would be made, since rights alone
    do not tell."""
    there = next(folder for folder in (path, *path.parents) if folder.exists())
    if not there.is_dir():
        return there == path and os.access(there, os.W_OK)
    try:
        with tempfile.TemporaryFile(dir=there):
            return True
    except OSError:
        return False


def _summary(function: Callable) -> str:
    """The first paragraph of a docstring."""
    return " ".join((inspect.getdoc(function) or "").partition("\n\n")[0].split())


def _without_none(kind: Any) -> Any:
    """The annotation without None; of several types, the first."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return next(choice for choice in typing.get_args(kind) if choice is not types.NoneType)
    return kind


def _is_list(kind: Any) -> bool:
    return typing.get_origin(kind) in (tuple, list, Sequence)


def _value(text: str, kind: Any) -> Any:
    """Converts a text to a type; ValueError, KeyError or YAMLError if that is impossible."""
    choices = typing.get_args(kind)
    if kind is bool:
        return {"true": True, "false": False}[text.lower()]
    if not _is_list(kind):
        if choices and text not in choices:
            raise ValueError
        return text if choices else kind(text)
    values = yaml.safe_load(text)
    values = values if isinstance(values, list) else [values]
    fixed = typing.get_origin(kind) is tuple
    if choices[0] is float:
        values = [float(str(value)) for value in values]  # YAML takes 1e-3 for a text
    if any(type(value) is not choices[0] for value in values):
        raise ValueError
    if fixed and len(values) != len(choices):
        raise ValueError
    return tuple(values) if fixed else values


def _kind(kind: Any) -> str:
    """A type in words."""
    choices = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return f"one of {', '.join(choices)}"
    if _is_list(kind):
        many = {int: "whole numbers", float: "numbers"}.get(choices[0], "a list of texts")
        return f"{len(choices)} {many}" if typing.get_origin(kind) is tuple else many
    return _WORDS.get(kind, "a text")


def _typed(default: Any) -> str:
    """A default in the form that users type."""
    if isinstance(default, Sequence) and not isinstance(default, str):
        return ",".join(map(str, default))
    if isinstance(default, float):
        return f"{default:g}"
    return str(default).lower() if isinstance(default, bool) else str(default)


def with_lists(
    argv: Sequence[str], numbers: Collection[str], words: Collection[str] = ()
) -> list[str]:
    """Joins the values of list options: `--size 10,10`, `--size 10 10` and `--size=[10, 10]` become
    `--size=[10,10]`, and `--paths A B` becomes `--paths=["A", "B"]`."""
    found, left = [], list(argv)
    while left:
        option, equals, value = left.pop(0).partition("=")
        parts = [value] if equals else []
        # argparse also takes an unambiguous beginning of an option's name.
        if option[:2] == "--" and any(name.startswith(option[2:] or "-") for name in numbers):
            while all(map(_NUMBERS.fullmatch, parts)) and left and _NUMBERS.fullmatch(left[0]):
                parts.append(left.pop(0))
            if parts and all(map(_NUMBERS.fullmatch, parts)):
                each = re.findall(r"[^\s\[\](),]+", " ".join(parts))
                parts = [f"[{','.join(each)}]"]
        elif option[2:] in words and not value.startswith("[") and value != "null":
            while left and not left[0].startswith("-"):
                parts.append(left.pop(0))
            if parts not in ([], ["null"]) and not parts[0].startswith("["):
                parts = [json.dumps(parts)]
        found.append("=".join((option, *parts)))
    return found
