"""Where the options of a run come from: presets, files, and the run's own folder."""

import argparse
from pathlib import Path
from typing import Any, get_args

import yaml

from darswin.models.saving import Task

PRESETS = Path(__file__).parent.parent / "train" / "presets"
FIRST_TASK: Task = "classification"  # of runs that say none


def with_configs(argv: list[str]) -> list[str]:
    """The arguments with presets' names as their files, and a run's own configuration first.

    `test`, `validate` and `fit --resume` start from `RUN/config.yaml`, so that they need no other
    option.

    Raises:
        ValueError: an unknown preset. FileExistsError, FileNotFoundError: a run, or none, in RUN.
    """
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    scan.add_argument("-c", "--config", action="append", default=[])
    scan.add_argument("--run")
    scan.add_argument("--resume", action="store_true")
    known, others = scan.parse_known_args(argv[1:])
    configs = [_config_file(name) for name in known.config]
    if known.run:
        others += ["--run", known.run]
        own = Path(known.run) / "config.yaml"
        if argv[0] == "fit" and not known.resume:
            check_free(Path(known.run))
        elif own.exists():
            configs.insert(0, str(own))
        elif last_of(Path(known.run)).exists() if argv[0] == "fit" else not configs:
            raise FileNotFoundError(f"there is no run in {known.run}: it has no config.yaml")
    if known.resume:
        others.append("--resume=true")
    return [argv[0], *(f"--config={config}" for config in configs), *others]


def task_of(argv: list[str]) -> Task:
    """The task of a command whose arguments `with_configs` gave.

    Raises:
        ValueError: an unknown task, or another one than that of the run.
    """
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    scan.add_argument("--config", action="append", default=[])
    scan.add_argument("--run", default="")
    scan.add_argument("--task")
    known, _ = scan.parse_known_args(argv[1:])
    said = {config: _task_in(Path(config)) for config in known.config}
    task = known.task or next((t for t in reversed(said.values()) if t is not None), FIRST_TASK)
    if task not in get_args(Task):
        raise ValueError(f"--task must be one of {', '.join(get_args(Task))}, got {task!r}")
    own = str(Path(known.run) / "config.yaml")
    if own in said and (before := said[own] or FIRST_TASK) != task:
        raise ValueError(f"{known.run} is a run of --task {before}, not of {task}")
    return task


def _task_in(config: Path) -> Any:
    try:
        content = yaml.safe_load(config.read_text())
    except (yaml.YAMLError, OSError):
        return None  # the parser says what is wrong with it
    return content.get("task") if isinstance(content, dict) else None


def last_of(folder: Path) -> Path:
    """The last checkpoint of a run."""
    return folder / "checkpoints" / "last.ckpt"


def check_free(folder: Path) -> None:
    """FileExistsError for a folder that holds a run."""
    if last_of(folder).exists():
        raise FileExistsError(
            f"{folder} holds a run already: go on with --resume, or choose another one"
        )


def presets() -> str:
    """The names of the presets, in words."""
    return ", ".join(sorted(path.stem for path in PRESETS.glob("*.yaml")))


def _config_file(name: str) -> str:
    preset = PRESETS / f"{name}.yaml"
    if Path(name).exists():
        return name
    if not preset.exists():
        raise ValueError(f"there is no file {name} and no such preset; the presets are {presets()}")
    return str(preset)
