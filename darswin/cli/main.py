"""The command line: `darswin COMMAND`, or `python -m darswin COMMAND`."""

import codecs
import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from pkgutil import resolve_name
from typing import NamedTuple

from darswin.cli import options
from darswin.cli.arguments import run_command
from darswin.utils.extras import lack
from darswin.utils.processes import die_with_first_process


class Command(NamedTuple):
    """A command: its help, the modules of the extra `train` that it imports, and its function, or
    functions. It is imported when the command is called, which takes seconds."""

    text: str
    needs: tuple[str, ...]
    function: str


TRAIN = (
    "PIL", "cv2", "jsonargparse", "lightning", "matplotlib", "sklearn", "tensorboard",
    "torchmetrics",
)  # fmt: skip
PICTURES = ("PIL", "cv2", "matplotlib")
RUN = "darswin.cli.fit:run"
COMMANDS = {
    "fit": Command("trains a model", TRAIN, RUN),
    "validate": Command("measures a trained model on the validation set", TRAIN, RUN),
    "test": Command("measures a trained model through lenses, for one after the other", TRAIN, RUN),
    "predict": Command(
        "says what is in pictures taken through a known lens, or in each of their pixels",
        PICTURES,
        "darswin.cli.predict:predict",
    ),
    "quantize": Command(
        "makes a file of a trained model that computes with 8 bits",
        TRAIN,
        "darswin.cli.quantize:quantize",
    ),
    "convert": Command(
        "makes a safetensors file of a pickled checkpoint, without executing it",
        (),
        "darswin.compat:convert_checkpoint",
    ),
    "models": Command("lists the models", (), "darswin.cli.info:models"),
    "lens": Command(
        "draws, describes or converts a calibrated lens", PICTURES, "darswin.cli.lens:COMMANDS"
    ),
    "bench": Command(
        "measures how fast a model is on this machine, in a quarter of an hour",
        (),
        "darswin.cli.bench:bench",
    ),
    "info": Command(
        "says what an issue's report needs: versions, CPU, extras", (), "darswin.cli.info:info"
    ),
}
# For terminals that know no more than ASCII.
PLAIN = {"°": "deg", "×": "x", "±": "+/-", "–": "-", "…": "...", "²": "^2", "θ": "theta",
         "φ": "phi", "ξ": "xi", "π": "pi", "α": "alpha"}  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Runs a command; an error that a user can mend is one line, without a traceback."""
    argv = sys.argv[1:] if argv is None else argv
    name = argv[0] if argv else "--help"
    print_anywhere({} if name == "predict" else PLAIN)  # which prints JSON, to be read again
    if name in ("-h", "--help"):
        print("usage: darswin COMMAND [OPTIONS]\n")
        print("\n".join(f"  {name:<10}{command.text}" for name, command in COMMANDS.items()))
        print("\n`darswin COMMAND --help` lists its options.")
        return
    if name not in COMMANDS:
        raise misuse(f"no command {name!r}; there are {', '.join(COMMANDS)}")
    command = COMMANDS[name]
    if (without := lack("train", command.needs)) is not None:
        raise SystemExit(f"darswin {name}: {without}")
    warnings.showwarning = _one_line(warnings.showwarning)
    try:
        if command.function == RUN:
            argv, task = options.complete(argv)
            with die_with_first_process():  # which may end while this one still imports
                resolve_name(RUN)(argv, task)
        else:
            run_command(resolve_name(command.function), argv[1:], f"darswin {name}")
        sys.stdout.flush()
    except BrokenPipeError:  # `darswin lens info … | head`: who reads has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError, FloatingPointError, MemoryError) as error:
        # A worker process puts its whole traceback into the message; the last line is the error's.
        message = str(error).strip().splitlines()[-1] if "Traceback" in str(error) else str(error)
        broken = "BrokenImageError" in f"{type(error).__name__}{message}"
        if broken and command.function == RUN:
            message += " (`skip_broken` true leaves such files out)"
        message = with_flags(message, command)
        if isinstance(error, FloatingPointError):
            raise SystemExit(f"darswin: {message}") from error
        raise misuse(message) from error


def with_flags(message: str, command: Command) -> str:
    """An error's message with flags in place of parameters, which the library writes as `name`;
    darswin.lens as name=, and its `model` is the command's `coefficients`."""
    flag_of = options.flag_of if command.function == RUN else "--{}".format
    names = {"camera": "camera", "model": "coefficients"}
    message = re.sub(
        r"\b(camera|model)=([\"']?)",
        lambda m: flag_of(names[m[1]]) + (f" {m[2]}" if m[2] else ""),
        message,
    )
    return re.sub(r"`([\w.]+)`", lambda m: flag_of(m[1]), message)


def misuse(message: str) -> SystemExit:
    """Prints an error, and gives the exception that ends the program with exit code 2."""
    end = SystemExit(f"darswin: {message}")
    print(end, file=sys.stderr)
    end.code = 2
    return end


def print_anywhere(words: Mapping[str, str]) -> None:
    """Lets stdout and stderr replace characters that the terminal has no code for: by `words`,
    others as JSON escapes them."""

    def plain(error: UnicodeError) -> tuple[str, int]:
        if not isinstance(error, UnicodeEncodeError):
            raise error
        text = error.object[error.start : error.end]
        return "".join(words.get(c, json.dumps(c)[1:-1]) for c in text), error.end

    codecs.register_error("darswin.plain", plain)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="darswin.plain")


def _one_line(show: Callable[..., None]) -> Callable[..., None]:
    """Shows our own warnings in one line, each once, as errors are; others as `show` does."""
    shown = set()

    def show_once(message: Warning, category: type[Warning], *where, **options) -> None:
        if not category.__module__.startswith("darswin."):
            show(message, category, *where, **options)
        elif str(message) not in shown:
            shown.add(str(message))
            print(f"darswin: {message}", file=sys.stderr)

    return show_once
