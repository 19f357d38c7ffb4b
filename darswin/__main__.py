"""The command line: `darswin COMMAND`, or `python -m darswin COMMAND`."""

import importlib.util
import sys

COMMANDS = {
    "fit": "trains a model",
    "validate": "measures a trained model on the validation set",
    "test": "measures a trained model through lenses, for one after the other",
    "predict": "names what is in pictures taken through a known lens",
    "convert": "makes a safetensors file of a pickled checkpoint, without executing it",
    "models": "lists the models",
    "lens": "draws, describes or converts a calibrated lens",
    "bench": "measures how fast a model is on this machine, ten minutes",
}
# What a command imports beyond torch, if not Lightning, which brings all.
NEEDS = {"models": (), "bench": (), "lens": ("cv2", "jsonargparse", "matplotlib")}


def main(argv: list[str] | None = None) -> None:
    """Runs a command; what a user can mend is said in one line, without a traceback."""
    argv = sys.argv[1:] if argv is None else argv
    command = argv[0] if argv else "--help"
    if command in ("-h", "--help"):
        print("usage: darswin COMMAND [OPTIONS]\n")
        print("\n".join(f"  {name:<10}{text}" for name, text in COMMANDS.items()))
        print("\n`darswin COMMAND --help` lists its options.")
        return
    if command not in COMMANDS:
        raise SystemExit(f"darswin: no command {command!r}; there are {', '.join(COMMANDS)}")
    if any(importlib.util.find_spec(name) is None for name in NEEDS.get(command, ("lightning",))):
        raise SystemExit("darswin: this needs more packages: pip install 'darswin[train]'")
    try:
        _run(command, argv)
    except (OSError, ValueError, FloatingPointError, MemoryError) as error:
        # A worker process puts its whole traceback into the message; the last line is the error's.
        message = str(error).strip().splitlines()[-1] if "Traceback" in str(error) else str(error)
        if "BrokenImageError" in f"{type(error).__name__}{message}" and command not in (
            "predict",
            "lens",
        ):
            message += " (--data.skip_broken true leaves such files out)"
        raise SystemExit(f"darswin: {message}") from error


def _run(command: str, argv: list[str]) -> None:
    # Imported here, because they take seconds.
    if command in ("fit", "bench"):
        from darswin.malloc import keep_freed_memory

        keep_freed_memory()
    if command in ("fit", "validate", "test"):
        from darswin.train.cli import run_command

        run_command(argv)
        return
    if command == "predict":
        from jsonargparse import ArgumentParser

        from darswin.predict import predict

        parser = ArgumentParser(prog="darswin predict", description=predict.__doc__.split("\n")[0])
        parser.add_argument("pictures", nargs="+", type=str, help="image files")
        parser.add_function_arguments(predict, skip={"pictures"})
        predict(**parser.parse_args(argv[1:]).as_dict())
    elif command == "convert":
        from jsonargparse import auto_cli

        from darswin.compat import convert_checkpoint

        auto_cli(convert_checkpoint, args=argv[1:], prog="darswin convert")
    elif command == "lens":
        from darswin.lens.cli import run

        run(argv[1:])
    elif command == "bench":
        from darswin.bench.command import main as bench

        bench(argv[1:])
    else:
        from darswin.models import list_models

        print("\n".join(list_models()))


if __name__ == "__main__":
    main()
