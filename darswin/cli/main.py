"""The command line: `darswin COMMAND`, or `python -m darswin COMMAND`."""

import argparse
import codecs
import json
import os
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import NamedTuple

from darswin.utils.extras import lack


class Command(NamedTuple):
    """A command: its help, the modules of the extra `train` that it imports, and what runs it."""

    text: str
    needs: tuple[str, ...]
    run: Callable[[list[str]], None]


# Each imports what it runs when it is called: that takes seconds.
def _fit(argv: list[str]) -> None:
    from darswin.utils.processes import die_with_first_process

    with die_with_first_process():  # the imports alone may take longer than the first one lives
        from darswin.cli.fit import run

        run(argv)


def _predict(argv: list[str]) -> None:
    from darswin.cli.predict import run

    run(argv[1:])


def _quantize(argv: list[str]) -> None:
    from darswin.cli.arguments import run_command
    from darswin.cli.quantize import quantize

    run_command(quantize, argv[1:], "darswin quantize")


def _convert(argv: list[str]) -> None:
    from darswin.cli.arguments import run_command
    from darswin.compat import convert_checkpoint

    run_command(convert_checkpoint, argv[1:], "darswin convert")


def _models(argv: list[str]) -> None:
    from darswin.models import list_models, list_pretrained

    parser = argparse.ArgumentParser(prog="darswin models", description=COMMANDS["models"].text)
    parser.parse_args(argv[1:])
    print("\n".join(list_models()))
    print("\ntrained, for --model of predict:")
    print("\n".join(list_pretrained()))


def _lens(argv: list[str]) -> None:
    from darswin.cli.lens import run

    run(argv[1:])


def _bench(argv: list[str]) -> None:
    from darswin.cli.bench import run
    from darswin.utils.malloc import keep_freed_memory

    keep_freed_memory()
    run(argv[1:])


def _info(argv: list[str]) -> None:
    from darswin.cli.info import run

    run(argv[1:])


TRAIN = (
    "PIL", "cv2", "jsonargparse", "lightning", "matplotlib", "sklearn", "tensorboard",
    "torchmetrics",
)  # fmt: skip
PICTURES = ("PIL", "cv2", "jsonargparse")
COMMANDS = {
    "fit": Command("trains a model", TRAIN, _fit),
    "validate": Command("measures a trained model on the validation set", TRAIN, _fit),
    "test": Command(
        "measures a trained model through lenses, for one after the other", TRAIN, _fit
    ),
    "predict": Command(
        "says what is in pictures taken through a known lens, or in each of their pixels",
        (*PICTURES, "matplotlib"),
        _predict,
    ),
    "quantize": Command(
        "makes a file of a trained model that computes with 8 bits", TRAIN, _quantize
    ),
    "convert": Command(
        "makes a safetensors file of a pickled checkpoint, without executing it",
        ("jsonargparse",),
        _convert,
    ),
    "models": Command("lists the models", (), _models),
    "lens": Command(
        "draws, describes or converts a calibrated lens", (*PICTURES, "matplotlib"), _lens
    ),
    "bench": Command(
        "measures how fast a model is on this machine, in a quarter of an hour", (), _bench
    ),
    "info": Command("says what an issue's report needs: versions, CPU, extras", (), _info),
}
# For terminals that know no more than ASCII.
PLAIN = {"°": "deg", "×": "x", "±": "+/-", "–": "-", "…": "...", "²": "^2", "θ": "theta",
         "φ": "phi", "ξ": "xi", "π": "pi", "α": "alpha"}  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Runs a command; what a user can mend is said in one line, without a traceback."""
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
        command.run(argv)
        sys.stdout.flush()
    except BrokenPipeError:  # `darswin lens info … | head`: who reads has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError, FloatingPointError, MemoryError) as error:
        # A worker process puts its whole traceback into the message; the last line is the error's.
        message = str(error).strip().splitlines()[-1] if "Traceback" in str(error) else str(error)
        broken = "BrokenImageError" in f"{type(error).__name__}{message}"
        if broken and command.run is _fit:
            message += " (--data.skip_broken true leaves such files out)"
        message = _with_flags(message, command.run is _fit)
        if isinstance(error, FloatingPointError):
            raise SystemExit(f"darswin: {message}") from error
        raise misuse(message) from error


def _with_flags(message: str, of_data: bool) -> str:
    """A library's error, in which flags stand for the parameters in backticks."""
    data = "data." if of_data else ""
    message = re.sub(r"`(\w+)`", rf"--{data}\1", message)
    options = {"give model=": "coefficients", "choose one as camera=": "camera"}
    name = next((options[said] for said in options if said in message), None)
    return message if name is None else f"{message} (on the command line as --{data}{name})"


def misuse(message: str) -> SystemExit:
    """Says what is wrong with a command, and gives what ends the program with exit code 2."""
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
    said = set()

    def shown(message: Warning, category: type[Warning], *where, **options) -> None:
        if not category.__module__.startswith("darswin."):
            show(message, category, *where, **options)
        elif str(message) not in said:
            said.add(str(message))
            print(f"darswin: {message}", file=sys.stderr)

    return shown
