"""`darswin fit`, `validate` and `test`: Lightning's command line, with a folder for each run.

A run's folder holds everything of it: `config.yaml`, `checkpoints/{last,best}.{ckpt,safetensors}`,
the logs `csv/` and `tensorboard/`, and `test.{csv,json,png}`.
"""

import argparse
import signal
import warnings
from pathlib import Path

from lightning.pytorch import Trainer
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException, SIGTERMException

from darswin.data.lenses import parse_sweep
from darswin.files import remove_partial_files, replace_file
from darswin.models.saving import model_of_run
from darswin.train.checkpoints import RunCheckpoint, SafeCheckpointIO
from darswin.train.data import WideAngleData
from darswin.train.results import WriteResults
from darswin.train.task import Classification

PRESETS = Path(__file__).parent / "presets"


def run_command(argv: list[str]) -> None:
    """Runs `fit`, `validate` or `test`, the first of `argv`, with the others as its options."""
    # The arguments are the command line's own, with the run's configuration added.
    warnings.filterwarnings("ignore", "LightningCLI's args parameter")
    warnings.filterwarnings("ignore", r".*isinstance\(treespec, LeafSpec\)")  # Lightning's own
    warnings.filterwarnings("ignore", "Checkpoint directory .* exists and is not empty")
    try:
        _run(argv)
    except MisconfigurationException as error:
        raise ValueError(str(error)) from error
    except SIGTERMException:
        raise SystemExit(128 + signal.SIGTERM) from None


def _run(argv: list[str]) -> None:
    RunCLI(
        Classification,
        WideAngleData,
        args=with_configs(argv),
        seed_everything_default=0,
        auto_configure_optimizers=False,
        save_config_callback=SaveRunConfig,
        trainer_defaults=dict(
            accelerator="auto", use_distributed_sampler=False, num_sanity_val_steps=0
        ),
        parser_kwargs=dict(
            prog="darswin", description="Trains and tests models on wide-angle images."
        ),
    )


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
            if (Path(known.run) / "checkpoints" / "last.ckpt").exists():
                raise FileExistsError(
                    f"{known.run} holds a run already: go on with --resume, or choose another one"
                )
        elif own.exists():
            configs.insert(0, str(own))
        elif argv[0] != "fit" and not configs:
            raise FileNotFoundError(f"there is no run in {known.run}: it has no config.yaml")
    if known.resume:
        others.append("--resume=true")
    return [argv[0], *(f"--config={config}" for config in configs), *others]


def _config_file(name: str) -> str:
    preset = PRESETS / f"{name}.yaml"
    if Path(name).exists():
        return name
    if not preset.exists():
        presets = ", ".join(sorted(path.stem for path in PRESETS.glob("*.yaml")))
        raise ValueError(f"there is no file {name} and no such preset; the presets are {presets}")
    return str(preset)


class RunCLI(LightningCLI):
    """Lightning's command line with `--run`, `--resume` and `--xi`."""

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        commands = LightningCLI.subcommands()
        return {name: commands[name] for name in ("fit", "validate", "test")}

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--run", type=str, required=True, help="the folder of the run")
        parser.add_argument(
            "--resume", type=bool, default=False, help="fit: goes on from the run's last checkpoint"
        )
        parser.add_argument(
            "--checkpoint_steps", type=int, default=200, help="fit: steps between checkpoints"
        )
        parser.add_argument(
            "--xi", type=str, help="test: the same as --data.test_lenses, e.g. 0:1:0.1 for every ξ"
        )
        parser.add_argument("--devices", type=int, help="the same as --trainer.devices")
        parser.link_arguments("seed_everything", "data.seed", compute_fn=int)
        parser.link_arguments("seed_everything", "model.seed", compute_fn=int)

    def _parse_ckpt_path(self) -> None:
        """Lightning looks for options in checkpoints here; a run has them in its folder."""

    def before_instantiate_classes(self) -> None:
        config = self.config[self.subcommand]
        self.folder = Path(config.run)
        config.trainer.default_root_dir = str(self.folder)
        for name in ("path", "classes", "splits"):  # so that the run works from anywhere
            if config.data[name] and Path(config.data[name]).exists():
                config.data[name] = str(Path(config.data[name]).resolve())
        if config.xi is not None:
            config.data.test_lenses = parse_sweep(config.xi)
        if self.subcommand != "fit":
            config.ckpt_path = config.ckpt_path or str(model_of_run(self.folder, ".ckpt"))
            return
        remove_partial_files(self.folder)
        last = self.folder / "checkpoints" / "last.ckpt"
        if config.resume and last.exists():
            config.ckpt_path = str(last)
        elif config.resume:
            print(f"{last} is not there yet: starting from the beginning")

    def instantiate_trainer(self, **kwargs) -> Trainer:
        config = self.config_init[self.subcommand]
        given = config.trainer
        kwargs["plugins"] = [SafeCheckpointIO(), *(given.plugins or [])]
        if given.logger is None:
            kwargs["logger"] = self._loggers() if self.subcommand == "fit" else False
        if config.devices is not None:
            kwargs["devices"] = config.devices
        kwargs["callbacks"] = [*(given.callbacks or []), *self._callbacks(config.checkpoint_steps)]
        return super().instantiate_trainer(**kwargs)

    def _run_subcommand(self, subcommand: str) -> None:
        super()._run_subcommand(subcommand)
        if broken := self.datamodule.broken():
            print(f"{broken} pictures could not be read and were left out")

    def _loggers(self) -> list:
        return [
            # A new version each time: nothing is overwritten.
            CSVLogger(self.folder, name="csv", flush_logs_every_n_steps=1),
            TensorBoardLogger(self.folder, name="", version="tensorboard"),
        ]

    def _callbacks(self, steps: int) -> list:
        if self.subcommand != "fit":
            return [WriteResults(self.folder)] if self.subcommand == "test" else []
        kept = dict(dirpath=self.folder / "checkpoints", enable_version_counter=False)
        return [
            RunCheckpoint(
                filename="best",
                monitor="val/top1",
                mode="max",
                save_on_train_epoch_end=False,
                **kept,
            ),
            RunCheckpoint(filename="last", every_n_train_steps=steps, **kept),
            RunCheckpoint(filename="last", save_on_train_epoch_end=True, **kept),
        ]


class SaveRunConfig(SaveConfigCallback):
    """Writes the configuration of a `fit` to its run's folder."""

    def __init__(self, parser: LightningArgumentParser, config, **kwargs):
        super().__init__(parser, config, save_to_log_dir=False)

    def save_config(self, trainer: Trainer, pl_module: Classification, stage: str) -> None:
        if stage != "fit":
            return
        config = self.config.clone()
        for name in ("config", "resume", "xi", "devices", "ckpt_path"):  # of this call alone
            config.pop(name, None)
        text = self.parser.dump(config, skip_none=False)
        replace_file(Path(trainer.default_root_dir) / "config.yaml", text)
