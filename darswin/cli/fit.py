"""`darswin fit`, `validate` and `test`: Lightning's command line, with a folder for each run.

A run's folder holds everything of it: `config.yaml`, `checkpoints/{last,best}.{ckpt,safetensors}`,
the logs `csv/` and `tensorboard/`, and `test.{csv,json,png}`. What is trained and tested, and on
which data, is the task's: `darswin.train.tasks`.
"""

import contextlib
import logging
import re
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn, get_args

import torch
import yaml
from lightning.fabric.strategies.launchers.subprocess_script import _ChildProcessObserver
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar, TQDMProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.strategies.launchers import _SubprocessScriptLauncher
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from darswin.cli.announce import (
    Announce,
    EpochLines,
    how_to_resume,
    say,
    say_stopped,
    say_the_end,
)
from darswin.cli.arguments import with_lists
from darswin.cli.options import (
    ALL,
    FIRST_TASK,
    check_free,
    format_help,
    last_of,
    presets,
    with_nearest_of_run,
)
from darswin.data.lens_distributions import parse_sweep
from darswin.data.splits import SPLITS
from darswin.models.saving import model_of_run, read_card
from darswin.train.finetuning import settle, weights_file
from darswin.train.results import WriteResults
from darswin.train.runs import (
    BestCheckpoint,
    LastCheckpoint,
    SafeCheckpointIO,
    StopOnSignals,
    check_changes,
)
from darswin.train.tasks import TASKS
from darswin.utils.files import locked, remove_partial_files, replace_file
from darswin.utils.malloc import keep_freed_memory
from darswin.utils.parameters import check
from darswin.utils.processes import end_with_failed_process
from darswin.utils.tasks import Task
from darswin.utils.text import read_text
from darswin.utils.words import counted

# What the libraries of several processes say if one of them has gone.
_LOST = r"Connection (closed|reset) by|gloo|NCCL|TCPStore|Broken pipe"


def run(argv: list[str], task: Task) -> None:
    """Runs `fit`, `validate` or `test`, the first of `argv`, with the others as its options."""
    if argv[0] == "fit":
        keep_freed_memory()
    numbers = ("data.mean", "data.std", "model.class_weights", "model.zones")
    argv = with_lists(argv, numbers, words=("data.test_paths",))
    for name in ("lightning.pytorch", "lightning.fabric"):  # we say ourselves what a run does
        logging.getLogger(name).setLevel(logging.WARNING)
    parser = WholeHelpParser if ALL in argv else RunParser
    argv = ["--help" if word == ALL else word for word in argv]
    with StopOnSignals() as signals:
        try:
            RunCLI(
                signals,
                task,
                model_class=TASKS[task].module,
                datamodule_class=TASKS[task].data,
                args=argv,
                seed_everything_default=0,
                auto_configure_optimizers=False,
                save_config_callback=None,
                trainer_defaults=dict(
                    accelerator="auto",
                    use_distributed_sampler=False,
                    num_sanity_val_steps=0,
                    enable_model_summary=False,
                ),
                parser_class=parser,
                parser_kwargs=dict(prog="darswin"),
            )
        except MisconfigurationException as error:
            raise ValueError(str(error)) from error
        except (KeyboardInterrupt, SystemExit):
            if signals.number is None:
                raise
            # Another process of the run must not end with an error: Lightning kills the first then.
            other = rank_zero_only.rank  # type: ignore[attr-defined]  # Lightning adds it as it runs
            raise SystemExit(0 if other else 128 + signals.number) from None
        except (MemoryError, RuntimeError) as error:
            if re.search(_LOST, str(error)):
                time.sleep(1)  # `end_with_failed_process` may know which one it was
                if rank_zero_only.rank:  # type: ignore[attr-defined]
                    raise SystemExit(1) from error
                raise SystemExit("darswin: another process of this run has ended") from error
            # Torch's own exception class is for GPUs. On Linux, the system kills a worker instead.
            lack = re.search("can't allocate memory|DataLoader worker .*: Killed", str(error))
            if not (lack or isinstance(error, MemoryError | torch.OutOfMemoryError)):
                raise
            raise MemoryError(
                "not enough memory: a smaller --data.batch_size or model, or "
                "--model.grad_checkpointing true, needs less "
                f"({str(error).strip().splitlines()[-1]})"
            ) from error


class RunParser(LightningArgumentParser):
    """Names options in its errors as people type them, and ours first in its help."""

    whole_help = False

    def format_help(self) -> str:
        command = self.prog.split()[-1]
        if command not in RunCLI.subcommands():
            return super().format_help()
        formatter = self._get_formatter()
        return format_help(self._actions, formatter, command, self.whole_help)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        message = re.sub(r'Parser key "([\w.]+)":', r"--\1:", message)
        message = re.sub(
            r"Subcommand '\w+' does not accept option '", "there is no option '--", message
        )
        parser = getattr(ex, "subcommand_parser", None) or self
        command = parser.prog.replace(" [options]", "")
        if "arguments are required" in message:
            if required := re.search(r"\b(fit|validate|test)\.", message):
                command = f"darswin {required[1]}"
            message = re.sub(r"\b(fit|validate|test)\.", "--", message)
        message = " ".join(message.split())
        if not self.exit_on_error:
            super().error(message, ex)
        names = [name for action in parser._actions for name in action.option_strings]
        message = with_nearest_of_run(message, names)
        self.exit(2, f"error: {message}; `{command} --help` lists the options\n")


class WholeHelpParser(RunParser):
    """A parser whose help shows all options."""

    whole_help = True


class RunCLI(LightningCLI):
    """Lightning's command line with `--run`, `--resume` and `--xi`."""

    def __init__(self, signals: StopOnSignals, task: Task, **options):
        self.signals, self.task, self.typed = signals, task, options["args"]
        super().__init__(**options)

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        commands = LightningCLI.subcommands()
        return {name: commands[name] for name in ("fit", "validate", "test")}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        (config,) = (action for action in parser._actions if action.dest == "config")
        config.help = f"a preset ({presets()}) or a YAML file of options; the last one wins"
        parser.add_argument("--run", type=str, required=True, help="the folder of the run")
        text = "fit: continue from the last checkpoint of the run"
        parser.add_argument("--resume", type=bool, default=False, help=text)
        text = "fit: the number of steps between checkpoints"
        parser.add_argument("--checkpoint_steps", type=int, default=200, help=text)
        text = f"one of {', '.join(get_args(Task))}; `--task TASK --help` lists its options"
        parser.add_argument("--task", type=Task, default=self.task, help=text)
        if self.task == FIRST_TASK:
            text = "test: the same as --data.test_lenses; 0:1:0.1 tests ξ = 0, 0.1, …, 1"
            parser.add_argument("--xi", type=str, help=text)
        parser.add_argument("--devices", type=int, help="the same as --trainer.devices")
        parser.link_arguments("seed_everything", "data.seed", compute_fn=int)
        parser.link_arguments("seed_everything", "model.seed", compute_fn=int)

    def _parse_ckpt_path(self) -> None:
        """Lightning would look for options in the checkpoint; a run keeps them in config.yaml."""

    def before_instantiate_classes(self) -> None:
        """Completes the configuration, and checks it before anything is built."""
        config = self.config[str(self.subcommand)]
        self.folder = Path(config.run)
        config.trainer.default_root_dir = str(self.folder)
        # Absolute paths let the run continue from any folder.
        for name in ("path", "classes", "splits", "lens", "label_map"):
            if config.data.get(name) and Path(config.data[name]).exists():
                config.data[name] = str(Path(config.data[name]).resolve())
        if self.task == FIRST_TASK:
            self._check_lenses(config)
            if config.xi is not None:
                config.data.test_lenses = parse_sweep(config.xi)
        elif config.data.test_paths:
            config.data.test_paths = [str(Path(path).resolve()) for path in config.data.test_paths]
        if config.devices is not None:
            config.trainer.devices = config.devices
        if config.trainer.overfit_batches:
            raise ValueError("--trainer.overfit_batches shuffles otherwise: take --data.limit")
        steps = config.checkpoint_steps
        check("checkpoint_steps", steps, steps >= 1, "at least 1")
        if self.subcommand != "fit":
            config.ckpt_path = config.ckpt_path or str(model_of_run(self.folder, ".ckpt"))
            return
        weights = config.model.weights
        if weights is not None and Path(weights).exists():
            weights = config.model.weights = str(Path(weights).resolve())
        if weights is not None and not (config.resume and last_of(self.folder).exists()):
            card = read_card(weights_file(weights))
            model, data = settle(card, weights, self.task, config.model, config.data)
            for group, settled in ((config.model, model), (config.data, data)):
                for name, value in settled.items():
                    group[name] = value
        if config.resume and last_of(self.folder).exists():
            before = yaml.safe_load(read_text(self.folder / "config.yaml"))
            now = yaml.safe_load(self._recorded(config))
            for name, change in check_changes(before, now).items():
                say(f"--{name} {change}")

    def _check_lenses(self, config) -> None:
        """ValueError for lenses to warp to, typed beside those that took the pictures."""
        typed = {word.partition("=")[0] for word in self.typed}
        for name in ("--xi", "--data.test_lenses", "--data.train_lenses"):
            if name in typed and config.data.lens is not None:
                raise ValueError(
                    f"{name} warps pictures through lenses, and --data.lens says which lens took "
                    "them: give one, or --data.lens null"
                )

    def _recorded(self, config) -> str:
        """The content of config.yaml: all options but those of this call alone."""
        config = config.clone()
        for name in ("config", "resume", "xi", "devices", "ckpt_path", "trainer.default_root_dir"):
            config.pop(name, None)
        return self._parser("fit").dump(config, skip_none=False)

    def instantiate_trainer(self, **kwargs) -> Trainer:
        config = self.config_init[str(self.subcommand)]
        given = config.trainer
        kwargs["plugins"] = [SafeCheckpointIO(), *(given.plugins or [])]
        if given.logger is None:
            kwargs["logger"] = False  # BeginRun adds the run's own loggers
        again = f": `{how_to_resume(self.folder)}` goes on" if self.subcommand == "fit" else ""
        callbacks = [WatchProcesses(again), *(given.callbacks or [])]
        if given.enable_progress_bar is not False and not any(
            isinstance(c, ProgressBar) for c in callbacks
        ):
            terminal = sys.stdout.isatty() or given.enable_progress_bar
            callbacks.append(RunProgressBar() if terminal else EpochLines())
            kwargs["enable_progress_bar"] = bool(terminal)
        if self.subcommand == "fit":
            callbacks = self._fit_callbacks(callbacks, config)
        elif self.subcommand == "test":
            callbacks.append(WriteResults(self.folder))
        return super().instantiate_trainer(**kwargs, callbacks=callbacks)

    def _fit_callbacks(self, others: list[Callback], config) -> list[Callback]:
        loggers = [] if config.trainer.logger is not None else [
            # A new version each time: nothing is overwritten.
            CSVLogger(self.folder, name="csv", flush_logs_every_n_steps=1),
            TensorBoardLogger(self.folder, name="", version="tensorboard"),
        ]  # fmt: skip
        record = self.config["fit"].clone()
        for name in ("size", "channels"):  # where the pictures decide on them
            record.data[name] = getattr(self.datamodule, name)
        last = last_of(self.folder)
        monitor, mode = TASKS[self.task].module.monitor
        return [
            BeginRun(self.folder, self._recorded(record), loggers),
            Announce(),
            *others,
            self.signals,
            BestCheckpoint(
                last.parent, "best", monitor=monitor, mode=mode, save_on_train_epoch_end=False,
                enable_version_counter=False,
            ),
            LastCheckpoint(last, config.checkpoint_steps),  # after all that may stop the run
        ]  # fmt: skip

    def _run_subcommand(self, subcommand: str) -> None:
        super()._run_subcommand(subcommand)
        if broken := self.datamodule.broken():
            print(f"left out, because they cannot be read: {counted(broken, 'picture')}")

    def fit(self, **options) -> None:
        """Trains, holding the lock of the run's folder; Lightning calls it."""
        config, last = self.config_init["fit"], last_of(self.folder)
        try:
            with self._locked() if self.trainer.is_global_zero else contextlib.nullcontext():
                start = config.ckpt_path
                if not config.resume:
                    check_free(self.folder)
                elif last.exists():
                    start = start or str(last)
                else:
                    say(f"{last} is not there yet: starting from the beginning")
                if self.trainer.is_global_zero:  # before it starts other processes
                    validates = self.trainer.limit_val_batches
                    self.datamodule.check(SPLITS[: 2 if validates else 1])
                if start is not None:
                    self.model.weights = None  # the checkpoint has its own
                self.trainer.fit(**options | {"ckpt_path": start})
        except BlockingIOError:
            raise FileExistsError(f"another `darswin fit` is at work in {self.folder}") from None
        except (KeyboardInterrupt, SystemExit):
            if (self.folder / "config.yaml").exists():
                say_stopped(self.trainer, self.folder)
            raise
        if self.trainer.global_step < self.model.steps:
            say_stopped(self.trainer, self.folder)
            if self.signals.number is not None:
                raise SystemExit
        elif not self.trainer.fast_dev_run:  # type: ignore[attr-defined]
            say_the_end(self.trainer, self.folder)

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Holds the lock of the run's folder, and removes a new folder if nothing else is in it."""
        is_new = not self.folder.exists()
        with locked(self.folder / ".lock"):
            try:
                yield
            finally:
                if is_new and [path.name for path in self.folder.iterdir()] == [".lock"]:
                    shutil.rmtree(self.folder)


class BeginRun(Callback):
    """Writes config.yaml and starts the loggers once training begins.

    Before that the checkpoint may still be refused, and the folder stays as it is.
    """

    def __init__(self, folder: Path, config: str, loggers: list):
        self.folder, self.config, self.loggers = folder, config, loggers

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        # A short epoch has its line in the logs, too. Lightning adds these two as it runs.
        most = trainer.log_every_n_steps  # type: ignore[attr-defined]
        trainer.log_every_n_steps = min(most, pl_module.steps_per_epoch)  # type: ignore[attr-defined]
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        if trainer.is_global_zero:
            remove_partial_files(self.folder)
            replace_file(self.folder / "config.yaml", self.config)
        trainer.loggers = trainer.loggers or self.loggers


class WatchProcesses(Callback):
    """Ends the run with one line if one of the processes that Lightning started fails."""

    def __init__(self, hint: str):
        self.hint = hint

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        if isinstance(launcher := trainer.strategy.launcher, _SubprocessScriptLauncher):
            for thread in threading.enumerate():
                if isinstance(thread, _ChildProcessObserver):
                    thread._child_processes = []  # it would kill this process without a word
            end_with_failed_process(launcher.procs, self.hint)


class RunProgressBar(TQDMProgressBar):
    """Lightning's progress bar without the version number of the logs."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict:
        shown = super().get_metrics(trainer, pl_module)
        shown.pop("v_num", None)
        return shown
