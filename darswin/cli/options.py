"""The options of `fit`, `validate` and `test`: presets, the folder of the run, and the help."""

import argparse
import inspect
import textwrap
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

import yaml

from darswin.cli.arguments import Parser, check_out_folder, with_nearest
from darswin.utils.nearest import did_you_mean
from darswin.utils.tasks import Task
from darswin.utils.text import read_text

PRESETS = Path(__file__).parent.parent / "train" / "presets"
FIRST_TASK: Task = "classification"  # unless a run names another one
# What these commands do with a file in place of the folder of a run.
_TAKES = {
    ".ckpt": "--ckpt_path takes a checkpoint",
    "": "--model.weights takes a model to start from, `darswin predict --model` one to use",
}
# Options that take a file of a group's options, and the option that was probably meant.
FILES = {"data": "--data.path", "model": "--model.name", "trainer": ""}


def complete(argv: list[str]) -> tuple[list[str], Task]:
    """Replaces presets by their files and finds the task.

    `test`, `validate` and `fit --resume` begin with the configuration of the run, so that they need
    no other option. Errors that are found here come before the slow imports of the parser.
    """
    scan = Parser(prog=f"darswin {argv[0]}", add_help=False, allow_abbrev=False)
    scan.add_argument("-c", "--config", action="append", default=[])
    scan.add_argument("--run")
    scan.add_argument("--resume", action="store_true")
    scan.add_argument("--task")
    scan.add_argument("--data.path", dest="path")
    given, others = scan.parse_known_args(argv[1:])
    _check_files(argv)
    contents = {file: content_of(file) for file in map(_config_file, given.config)}
    before = None
    if given.run:
        check_folder(Path(given.run), _TAKES)
        if argv[0] == "fit":
            check_out_folder(Path(given.run), "run")
        others += ["--run", given.run]
        own = Path(given.run) / "config.yaml"
        if argv[0] == "fit" and not given.resume:
            check_free(Path(given.run))
        elif own.exists():
            contents = {own: content_of(own)} | contents
            before = contents[own].get("task") or FIRST_TASK
        elif last_of(Path(given.run)).exists() if argv[0] == "fit" else not contents:
            raise FileNotFoundError(f"there is no run in {given.run}: it has no config.yaml")
    if given.resume:
        others.append("--resume=true")
    said = [before, *(content.get("task") for content in contents.values()), given.task]
    task = next((task for task in reversed(said) if task is not None), FIRST_TASK)
    if task not in get_args(Task):
        raise ValueError(f"--task must be one of {', '.join(get_args(Task))}, got {task!r}")
    if before not in (None, task):
        raise ValueError(f"{given.run} is a run of --task {before}, not of {task}")
    for file in contents:
        if file.parent == PRESETS and task not in (fitting := _tasks_of(contents[file])):
            others_fit = [p.stem for p in _presets() if task in _tasks_of(content_of(p))]
            raise ValueError(
                f"the preset {file.stem} is for --task {' or '.join(fitting)}, not for {task}, "
                f"which has {', '.join(others_fit)}"
            )
    if given.task:
        others += ["--task", given.task]
    if given.path:
        others += ["--data.path", given.path]
    else:
        given.path = next((p for p in map(_path_in, reversed(contents.values())) if p), "digits")
    if given.path != "digits" and not Path(given.path).exists():
        raise FileNotFoundError(f"no folder {given.path}")
    return [argv[0], *(f"--config={file}" for file in contents), *others], task


def _check_files(argv: list[str]) -> None:
    """ValueError for a value that is no file of a group's options."""
    scan = Parser(prog=f"darswin {argv[0]}", add_help=False, allow_abbrev=False)
    for group in FILES:
        scan.add_argument(f"--{group}", default=[], action="append")
    for group, values in vars(scan.parse_known_args(argv[1:])[0]).items():
        for value in values:
            if not Path(value).is_file() and not value.lstrip().startswith("{"):
                meant = FILES[group] and f"; type {FILES[group]} {value}"
                raise ValueError(
                    f"--{group} takes a file of options, and {value} is none{meant}; "
                    f"`darswin {argv[0]} --help` lists the options"
                )


def _config_file(name: str) -> Path:
    preset = PRESETS / f"{name}.yaml"
    if Path(name).exists():
        return Path(name)
    if not preset.exists():
        meant = did_you_mean(name, [path.stem for path in _presets()])
        text = f"{name} is neither a file nor a preset{meant} The presets are {presets()}"
        raise ValueError(text)
    return preset


def _presets() -> list[Path]:
    return sorted(PRESETS.glob("*.yaml"))


def _tasks_of(preset: dict[str, Any]) -> list[str]:
    """The tasks that a preset fits. One for pixels fits both, which have the same options."""
    dense = preset.get("task", FIRST_TASK) != FIRST_TASK
    return [task for task in get_args(Task) if (task != FIRST_TASK) == dense]


def content_of(config: Path) -> dict[str, Any]:
    """The options in a YAML file; none if it cannot be read."""
    try:
        content = yaml.safe_load(read_text(config))
    except (yaml.YAMLError, ValueError, OSError):
        return {}  # the parser will report the error
    return content if isinstance(content, dict) else {}


def _path_in(content: dict[str, Any]) -> str | None:
    data = content.get("data")
    path = data.get("path") if isinstance(data, dict) else None
    return path if isinstance(path, str) else None


def presets() -> str:
    """The names of the presets, joined by commas."""
    return ", ".join(path.stem for path in _presets())


def last_of(folder: Path) -> Path:
    """The last checkpoint of a run."""
    return folder / "checkpoints" / "last.ckpt"


def check_folder(run: Path, takes: Mapping[str, str]) -> None:
    """ValueError for a file in place of the folder of a run. `takes` says what the command does
    with a file of each ending; "" is any other."""
    if not run.is_file():
        return
    use = takes.get(run.suffix, takes.get("", ""))
    above = run.parent.parent
    hint = f"; this one belongs to the run {above}" if (above / "config.yaml").exists() else ""
    raise ValueError(
        f"--run names the folder in which `darswin fit` keeps all of a training, but {run} is a "
        f"file{hint}" + f". {use}" * bool(use)
    )


def check_free(folder: Path) -> None:
    """FileExistsError for a folder that holds a run."""
    if last_of(folder).exists():
        raise FileExistsError(
            f"{folder} holds a run already: continue it with --resume, or choose another folder"
        )


def flag_of(name: str) -> str:
    """The flag of a parameter of `fit` that an error of the library carries."""
    if name in RUN or "." in name:
        return f"--{name}"
    from lightning.pytorch import Trainer  # takes seconds

    from darswin.train.tasks import TASKS

    classes = [("data", part) for task in TASKS.values() for part in task.data.__mro__]
    for group, part in (*classes, ("trainer", Trainer)):
        ours = part.__module__.startswith(("darswin.", "lightning.pytorch.trainer"))
        if ours and name in inspect.signature(part).parameters:
            return f"--{group}.{name}"
    return f"--model.{name}"


def with_nearest_of_run(message: str, names: Collection[str]) -> str:
    """`with_nearest`, which names options of the trainer that the help leaves out only at last."""
    shown = [n for n in names if not n.startswith("--trainer.") or n[2:] in TRAINER]
    return with_nearest(message, shown, names)


# -- help: our own options first, then the important ones of Lightning's trainer ---------------

ALL = "--help.all"  # shows all options of the trainer
# The options by their names in argparse; a text replaces Lightning's own.
RUN = {
    "config": "",
    "run": "",
    "resume": "",
    "task": "",
    "checkpoint_steps": "",
    "xi": "",
    "devices": "",
    "ckpt_path": "a checkpoint to use in place of the run's own",
    "seed_everything": "the seed of shuffles, lenses, augmentation, weights, jitter and mixing",
}
TRAINER = {
    "trainer.max_epochs": "the number of epochs",
    "trainer.max_steps": "the number of steps, in place of epochs; -1 sets no limit",
    "trainer.max_time": "the time limit of the training, as DD:HH:MM:SS",
    "trainer.accelerator": "cpu, gpu or auto",
    "trainer.precision": "32-true or bf16-mixed",
    "trainer.accumulate_grad_batches": "the number of batches in one optimizer step",
    "trainer.gradient_clip_val": "the largest norm of the gradients; null sets no limit",
    "trainer.limit_train_batches": "the number of batches in an epoch, or a fraction of them",
    "trainer.limit_val_batches": "the same for a validation; 0 skips it",
    "trainer.check_val_every_n_epoch": "the number of epochs between validations",
    "trainer.log_every_n_steps": "the number of steps between lines of the logs",
    "trainer.logger": "false switches the logs off",
    "trainer.enable_progress_bar": "true shows a progress bar, null only on a terminal",
}
GROUPS = {"data": "pictures and lenses", "model": "the model and its training"}
# The other commands take the path from the run.
REQUIRED = {"fit": ("run", "data.path"), "validate": ("run",), "test": ("run",)}
WIDTH, COLUMN = 118, 34


def format_help(
    actions: Iterable[argparse.Action], formatter: argparse.HelpFormatter, command: str, whole: bool
) -> str:
    """The help of a command, in lines of at most `WIDTH`. With `whole`, the `formatter` adds the
    remaining options of the trainer."""
    # Options that are linked to others cannot be typed.
    typed = (a for a in actions if any(name.startswith("-") for name in a.option_strings))
    left = {action.dest: action for action in typed}
    required = REQUIRED[command]
    usage = "--run RUN [-c PRESET] --data.path PATH" if "data.path" in required else "--run RUN"
    lines = [f"usage: darswin {command} {usage} [options]"]

    def section(title: str, texts: dict[str, str]) -> None:
        lines.extend(("", f"{title}:"))
        for name, text in texts.items():
            if name in left:
                lines.extend(_option(left.pop(name), text, required))

    section("the run", RUN)
    for group, title in GROUPS.items():
        section(title, {name: "" for name in left if name.startswith(f"{group}.")})
    section("the trainer", TRAINER)
    if not whole:
        lines += ["", f"`darswin {command} {ALL}` shows all options of Lightning's trainer."]
        return "\n".join(lines) + "\n"
    formatter._width, formatter._max_help_position = WIDTH, COLUMN
    formatter.start_section("all others")
    formatter.add_arguments(list(left.values()))
    formatter.end_section()
    return "\n".join(lines) + "\n\n" + formatter.format_help()


def _option(action: argparse.Action, text: str, required: Collection[str]) -> list[str]:
    """The lines for an option: its name, its help, and its default in brackets."""
    names = ", ".join(name for name in action.option_strings if not name.endswith("+"))
    default = action.default
    if action.dest in required:
        shown = "required"
    elif action.dest == "data.path":
        shown = "from the run"
    elif isinstance(default, float):
        shown = f"{default:g}"
    else:
        shown = "null" if default is None else str(default).lower()
    lines = textwrap.wrap(f"{(text or str(action.help)).rstrip('.')} [{shown}]", WIDTH - COLUMN)
    head = f"  {names}"
    if len(head) < COLUMN - 1:
        head = f"{head:<{COLUMN}}{lines.pop(0)}"
    return [head, *(" " * COLUMN + line for line in lines)]
