"""The command line: `darswin COMMAND`, or `python -m darswin COMMAND`."""

import codecs
import contextlib
import json
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import NamedTuple

from darswin.cli import options
from darswin.cli.arguments import run_command
from darswin.utils.extras import lack
from darswin.utils.nearest import did_you_mean
from darswin.utils.parameters import with_flags
from darswin.utils.processes import die_with_first_process

PACKAGE = Path(__file__).parents[1]


class Command(NamedTuple):
    """A command of `darswin`."""

    text: str  # its help
    needs: tuple[str, ...]  # modules of the extra `train`
    function: str  # or a dict of functions; imported only when called, because that takes seconds

    def flag_of(self, parameter: str) -> str:
        """The flag of a parameter that an error of the library carries."""
        return options.flag_of(parameter) if self.function == RUN else f"--{parameter}"


TRAIN = (
    "PIL", "cv2", "jsonargparse", "lightning", "matplotlib", "sklearn", "tensorboard",
    "torchmetrics",
)  # fmt: skip
PICTURES = ("PIL", "cv2", "matplotlib")
RUN = "darswin.cli.fit:run"
COMMANDS = {
    "fit": Command("trains a model on a folder of pictures", TRAIN, RUN),
    "validate": Command("evaluates a trained model on the validation set", TRAIN, RUN),
    "test": Command("evaluates a trained model on the test set, for each lens", TRAIN, RUN),
    "predict": Command(
        "predicts classes, or a class or a distance for every pixel; or runs any ONNX network",
        PICTURES,
        "darswin.cli.predict:COMMANDS",
    ),
    "quantize": Command(
        "converts a trained model to 8 bits, for faster inference on CPUs",
        TRAIN,
        "darswin.cli.quantize:quantize",
    ),
    "convert": Command(
        "converts a pickled checkpoint to safetensors, without executing it",
        (),
        "darswin.compat.checkpoint:convert_checkpoint",
    ),
    "models": Command("lists the models", (), "darswin.cli.info:models"),
    "lens": Command(
        "makes, draws, describes, converts or crops a calibration, or undistorts pictures",
        PICTURES,
        "darswin.cli.lens:COMMANDS",
    ),
    "rig": Command(
        "draws, stitches and checks several cameras, or makes fisheye pictures of a cube's faces",
        PICTURES,
        "darswin.cli.rig:COMMANDS",
    ),
    "warp": Command(
        "writes pictures and labels as another lens or a view sees them",
        PICTURES,
        "darswin.cli.warp:warp",
    ),
    "info": Command(
        "prints versions, CPU and extras, for bug reports", (), "darswin.cli.info:info"
    ),
}
STOPPED = 130  # the exit code after Ctrl-C, by convention
HELP = Command("", (), "darswin.cli.main:print_help")
# Replacements for terminals that can only show ASCII.
PLAIN = {"°": "deg", "×": "x", "±": "+/-", "–": "-", "…": "...", "²": "^2", "θ": "theta",
         "φ": "phi", "ξ": "xi", "π": "pi", "α": "alpha"}  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Runs a command. Errors that users can fix are printed in one line, without a traceback."""
    open_closed_streams()
    argv = sys.argv[1:] if argv is None else argv
    name = argv[0] if argv else "--help"
    print_anywhere({} if name == "predict" else PLAIN)  # predict prints JSON for programs
    if name in ("-h", "--help"):
        command, argv = HELP, []
    elif name in COMMANDS:
        command = COMMANDS[name]
    else:
        meant = did_you_mean(name, COMMANDS)
        raise misuse(f"there is no command {name!r}{meant} The commands are {', '.join(COMMANDS)}")
    if (without := lack("train", command.needs)) is not None:
        raise SystemExit(f"darswin {name}: {without}")
    warnings.showwarning = _one_line(warnings.showwarning, command)
    try:
        if command.function == RUN:
            argv, task = options.complete(argv)
            with die_with_first_process():  # it may end during the imports here
                resolve_name(RUN)(argv, task)
        else:
            run_command(resolve_name(command.function), argv[1:], f"darswin {name}")
        sys.stdout.flush()
    except KeyboardInterrupt:
        raise SystemExit(STOPPED) from None
    except BrokenPipeError:  # `darswin lens info … | head` stops reading early
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError, ImportError, FloatingPointError, MemoryError) as error:
        message = with_flags(error, command.flag_of)
        if isinstance(error, OSError) and error.filename is not None:
            message = f"{error.filename}: {error.strerror}"
        # A worker process puts its traceback into the message; only the last line is the error.
        if "Traceback" in message:
            message = message.strip().splitlines()[-1]
        broken = "BrokenImageError" in f"{type(error).__name__}{message}"
        if broken and command.function == RUN:
            message += " (to leave such files out, set --data.skip_broken true)"
        if isinstance(error, FloatingPointError):
            raise SystemExit(f"darswin: {message}") from error
        raise misuse(message) from error


def print_help() -> None:
    """Prints the commands."""
    print("usage: darswin COMMAND [OPTIONS]\n")
    print("\n".join(f"  {name:<10}{command.text}" for name, command in COMMANDS.items()))
    print("\n`darswin COMMAND --help` lists its options.")


def misuse(message: str) -> SystemExit:
    """Prints an error, and returns the exception that ends the program with exit code 2."""
    end = SystemExit(f"darswin: {message}")
    with contextlib.suppress(OSError):  # the code says it too
        print(end, file=sys.stderr)
    end.code = 2
    return end


def open_closed_streams() -> None:
    """Opens the standard streams that are closed, as in `darswin models >&-`, on the null device.
    Otherwise prints would fail, and a file that is opened later would get all that C libraries
    print."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


def print_anywhere(words: Mapping[str, str]) -> None:
    """Lets stdout and stderr replace characters that the terminal cannot encode: by `words`, or by
    their escapes in JSON."""

    def plain(error: UnicodeError) -> tuple[str, int]:
        if not isinstance(error, UnicodeEncodeError):
            raise error
        text = error.object[error.start : error.end]
        return "".join(words.get(c, json.dumps(c)[1:-1]) for c in text), error.end

    codecs.register_error("darswin.plain", plain)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="darswin.plain")


def _one_line(show: Callable[..., None], command: Command) -> Callable[..., None]:
    """Shows warnings of darswin in one line and only once. Those that other packages give are shown
    by `show`, if Python was asked for warnings, and otherwise not."""
    shown = set()

    def show_once(message: Warning, category: type[Warning], file: str, *where, **options) -> None:
        ours = category.__module__.startswith("darswin.") or Path(file).is_relative_to(PACKAGE)
        if not ours:
            if sys.warnoptions:
                show(message, category, file, *where, **options)
        elif str(message) not in shown:
            shown.add(str(message))
            print(f"darswin: {with_flags(message, command.flag_of)}", file=sys.stderr)

    return show_once
