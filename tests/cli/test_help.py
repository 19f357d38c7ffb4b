"""The help of the commands that train and test."""

import inspect
import re

import pytest
from lightning.pytorch import Trainer

from darswin.cli.main import main
from darswin.train.classification import Classification
from darswin.train.wide_angle import WideAngleData


def shown(capsys, *argv):
    with pytest.raises(SystemExit) as end:
        main(list(argv))
    assert end.value.code == 0
    return capsys.readouterr().out


def options(text):
    return re.findall(r"^  (?:-c, |-c CONFIG, )?--([\w.]+)", text, re.M)


def own():
    """All options of the data and of the model: those of their classes and of the bases."""
    for group, made in (("data", WideAngleData), ("model", Classification)):
        for part in (c for c in made.__mro__ if c.__module__.startswith("darswin.")):
            for name, parameter in inspect.signature(part).parameters.items():
                if parameter.kind is not parameter.VAR_KEYWORD and name != "seed":
                    yield f"{group}.{name}"


@pytest.mark.parametrize("command", ["fit", "validate", "test"])
def test_ours_come_first_and_none_is_missing(capsys, command):
    text = shown(capsys, command, "--help")
    lines, names = text.splitlines(), options(text)
    assert len(lines) <= 150 and max(map(len, lines)) < 120
    assert names[:3] == ["config", "run", "resume"] and len(set(names)) == len(names)
    assert set(own()) <= set(names)
    last = max(k for k, name in enumerate(names) if not name.startswith("trainer."))
    assert 5 < len(names) - last - 1 < 20  # then the trainer's, a handful
    assert "SUPPRESS" not in text.upper() and f"darswin {command} --help.all" in lines[-1]


def test_all_has_everything(capsys):
    few, every = (options(shown(capsys, "fit", flag)) for flag in ("--help", "--help.all"))
    assert every[: len(few)] == few
    trainer = inspect.signature(Trainer).parameters
    skipped = {"default_root_dir"}
    assert {f"trainer.{name}" for name in trainer} - set(every) <= {
        f"trainer.{name}" for name in skipped
    }
    assert {"print_config", "weights_only"} <= set(every)


def test_defaults_are_said(capsys):
    text = " ".join(shown(capsys, "fit", "--help").split())
    assert "the folder of the run [required]" in text
    assert "--data.batch_size of one process [128]" in text
    assert "a preset (iccv2023, minutes, two_cores)" in text
