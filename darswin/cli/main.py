"""The command line: `darswin COMMAND`, or `python -m darswin COMMAND`."""

import argparse
import codecs
import json
import os
import sys
import warnings
from collections.abc import Callable, Mapping

from darswin.utils.extras import lack

COMMANDS = {
    "fit": "trains a model",
    "validate": "measures a trained model on the validation set",
    "test": "measures a trained model through lenses, for one after the other",
    "predict": "names what is in pictures taken through a known lens",
    "convert": "makes a safetensors file of a pickled checkpoint, without executing it",
    "models": "lists the models",
    "lens": "draws, describes or converts a calibrated lens",
    "bench": "measures how fast a model is on this machine, in some minutes",
}
# The modules of the extra `train` that a command imports, if not all of them.
TRAIN = (
    "PIL", "cv2", "jsonargparse", "lightning", "matplotlib", "sklearn", "tensorboard",
    "torchmetrics",
)  # fmt: skip
NEEDS = {
    "models": (),
    "bench": (),
    "convert": ("jsonargparse",),
    "lens": ("cv2", "jsonargparse", "matplotlib"),
}
# For terminals that know no more than ASCII.
PLAIN = {"°": "deg", "×": "x", "±": "+/-", "–": "-", "…": "...", "²": "^2", "θ": "theta",
         "φ": "phi", "ξ": "xi", "π": "pi", "α": "alpha"}  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Runs a command; what a user can mend is said in one line, without a traceback."""
    argv = sys.argv[1:] if argv is None else argv
    command = argv[0] if argv else "--help"
    print_anywhere({} if command == "predict" else PLAIN)  # which prints JSON, to be read again
    if command in ("-h", "--help"):
        print("usage: darswin COMMAND [OPTIONS]\n")
        print("\n".join(f"  {name:<10}{text}" for name, text in COMMANDS.items()))
        print("\n`darswin COMMAND --help` lists its options.")
        return
    if command not in COMMANDS:
        raise misuse(f"no command {command!r}; there are {', '.join(COMMANDS)}")
    if (without := lack("train", NEEDS.get(command, TRAIN))) is not None:
        raise SystemExit(f"darswin {command}: {without}")
    warnings.showwarning = _one_line(warnings.showwarning)
    try:
        _run(command, argv)
        sys.stdout.flush()
    except BrokenPipeError:  # `darswin lens info … | head`: who reads has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError, FloatingPointError, MemoryError) as error:
        # A worker process puts its whole traceback into the message; the last line is the error's.
        message = str(error).strip().splitlines()[-1] if "Traceback" in str(error) else str(error)
        if "BrokenImageError" in f"{type(error).__name__}{message}" and command not in (
            "predict",
            "lens",
        ):
            message += " (--data.skip_broken true leaves such files out)"
        if isinstance(error, FloatingPointError):
            raise SystemExit(f"darswin: {message}") from error
        raise misuse(message) from error


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


def _run(command: str, argv: list[str]) -> None:
    # Imported here, because they take seconds.
    if command in ("fit", "bench"):
        from darswin.utils.malloc import keep_freed_memory

        keep_freed_memory()
    if command in ("fit", "validate", "test"):
        from darswin.cli.arguments import with_lists
        from darswin.cli.fit import run_command

        run_command(with_lists(argv, ("data.mean", "data.std")))
        return
    if command == "predict":
        from jsonargparse import ArgumentParser

        from darswin.cli.predict import predict

        parser = ArgumentParser(prog="darswin predict", description=predict.__doc__.split("\n")[0])
        parser.add_argument("pictures", nargs="+", type=str, help="image files")
        parser.add_function_arguments(predict, skip={"pictures"})
        predict(**parser.parse_args(argv[1:]).as_dict())
    elif command == "convert":
        from darswin.cli.arguments import run_command
        from darswin.compat import convert_checkpoint

        run_command(convert_checkpoint, argv[1:], "darswin convert")
    elif command == "lens":
        from darswin.cli.lens import run

        run(argv[1:])
    elif command == "bench":
        from darswin.cli.bench import main as bench

        bench(argv[1:])
    else:
        from darswin.models import list_models

        argparse.ArgumentParser(prog="darswin models", description=COMMANDS[command]).parse_args(
            argv[1:]
        )
        print("\n".join(list_models()))
