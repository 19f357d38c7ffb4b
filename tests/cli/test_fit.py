"""`fit`, `validate` and `test`: their options, their help, and errors in one line."""

import inspect
import re
from typing import get_args

import cv2
import numpy as np
import pytest
import torch
import yaml
from helpers import ended
from runs import QUIET, error, fit
from scenes import write_plain

from darswin.cli.main import COMMANDS, main
from darswin.cli.options import PRESETS, complete, flag_of
from darswin.models import load_model
from darswin.utils.tasks import Task

DIGITS = ["--config", "minutes", "--data.path", "digits", "--trainer.logger", "false", *QUIET]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    return write_plain(tmp_path_factory.mktemp("data") / "scenes", 8, size=(45, 60))


# -- errors -----------------------------------------------------------------------------------


def test_flags_of_parameters():
    flags = dict(limit="data.limit", xi="xi", name="model.name", max_epochs="trainer.max_epochs",
                 crop="data.crop", zones="model.zones", task="task")  # fmt: skip
    assert {name: flag_of(name).removeprefix("--") for name in flags} == flags


def test_a_run_is_not_overwritten_by_a_launcher(capsys, tmp_path, monkeypatch):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").write_bytes(b"")
    monkeypatch.setenv("LOCAL_RANK", "0")
    assert "holds a run already: continue it" in error(capsys, "fit", "--run", tmp_path)


@pytest.mark.slow
def test_a_run_s_options_and_checkpoints_of_other_models(capsys, tmp_path):
    memory = ["--model.grad_checkpointing", "true"]
    fit(tmp_path, *DIGITS, "--trainer.max_steps", "1", "--data.limit", "48", *memory)
    saved = yaml.safe_load((tmp_path / "config.yaml").read_text())["model"]
    assert saved["grad_checkpointing"] is True
    test = ["test", "--run", tmp_path]
    message = error(capsys, *test, "--model.options", "{embed_dim: 12}")
    assert "another model" in message and "embed_dim None there, 12 here" in message
    torch.save({"state_dict": {}}, tmp_path / "other.ckpt")
    message = error(capsys, *test, "--ckpt_path", tmp_path / "other.ckpt")
    assert "not a checkpoint of `darswin fit`" in message
    (tmp_path / "other.ckpt").write_bytes(b"\x80\x02cos\nsystem\n(S'touch owned'\ntR.")
    error(capsys, *test, "--ckpt_path", tmp_path / "other.ckpt")
    assert "no checkpoint" in error(capsys, *test, "--ckpt_path", "none.ckpt")


@pytest.mark.slow
def test_a_broken_picture_is_named_in_one_line(capsys, tmp_path):
    for file in (tmp_path / name / f"{k}.jpg" for name in "ab" for k in range(6)):
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(b"no picture")
    options = ["--data.path", tmp_path, "--data.batch_size", "4", "--data.workers", "1"]
    message = error(capsys, "fit", "--run", tmp_path / "r", *DIGITS, *options).splitlines()[0]
    assert re.search(r"cannot read .*\.jpg: no image .*--data\.skip_broken true", message)


def test_all_broken_files_are_named_before_the_training(capsys, tmp_path):
    for k in range(24):
        file = tmp_path / "photos" / "ab"[k % 2] / f"{k}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), np.full((16, 16), 10 * k, np.uint8))
        if k < 16:
            file.write_bytes(file.read_bytes()[:300])
    options = [*DIGITS, "--data.path", tmp_path / "photos", "--data.holdout", "0"]
    options += ["--trainer.limit_val_batches", "0"]
    message = error(capsys, "fit", "--run", tmp_path / "run", *options)
    assert "16 of 24 pictures cannot be used:" in message and "and 6 more" in message
    assert message.count("cannot read ") == 10 and "set --data.skip_broken true" in message
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_each_split_is_checked_once(tmp_path, monkeypatch):
    checked = []
    monkeypatch.setattr(
        "darswin.train.data.check_files",
        lambda parts: checked.extend(parts) or dict.fromkeys(parts, 0),
    )
    options = [*DIGITS, "--trainer.max_steps", "1", "--data.limit", "48"]
    fit(tmp_path / "a", *options, "--trainer.limit_val_batches", "1")
    assert checked == ["the pictures of 'train'", "the pictures of 'val'"]
    checked.clear()
    main(["test", "--run", str(tmp_path / "a"), "--xi", "0", "--trainer.limit_test_batches", "1"])
    assert not checked
    fit(tmp_path / "b", *options, "--trainer.limit_val_batches", "0")
    assert checked == ["the pictures of 'train'"]


def test_our_warnings_are_one_line_once(capsys, tmp_path):
    for name in ("a", "b", "."):
        (tmp_path / name).mkdir(exist_ok=True)
        for k in range(12):
            cv2.imwrite(str(tmp_path / name / f"{k}.png"), np.full((8, 8), 20 * k, np.uint8))
    options = [*DIGITS, "--data.path", tmp_path, "--trainer.max_steps", "1"]
    fit(tmp_path / "r", *options, "--data.batch_size", "4")
    (said,) = (line for line in capsys.readouterr().err.splitlines() if "left out" in line)
    assert said.startswith(
        f"darswin: {tmp_path} holds pictures outside the folders of classes (12, e.g. "
    )


# -- presets and configurations ---------------------------------------------------------------


def test_presets_and_a_run_s_own_configuration(tmp_path, capsys):
    preset = str(PRESETS / "iccv2023.yaml")
    assert complete(["fit", "--config", "iccv2023", "--run", "r", "--x", "1"]) == (
        ["fit", f"--config={preset}", "--x", "1", "--run", "r"], "classification",
    )  # fmt: skip
    own, run = tmp_path / "config.yaml", ["--run", str(tmp_path)]
    own.write_text("task: distance\n")
    assert complete(["test", *run]) == (["test", f"--config={own}", *run], "distance")
    assert complete(["fit", *run]) == (["fit", *run], "classification")
    resumed = ["fit", f"--config={own}", *run, "--resume=true"]
    assert complete(["fit", *run, "--resume"]) == (resumed, "distance")
    other = ["fit", "-c", str(own), "--run", "r"]
    assert complete(other)[1] == "distance"
    assert complete([*other, "--task", "segmentation"])[1] == "segmentation"
    own.write_text("data: {path: digits}\n")  # of a run before there were tasks
    assert complete(["test", *run])[1] == "classification"


def test_the_presets_of_the_paper_hold_its_recipe_and_its_own_rate():
    code, paper = (
        yaml.safe_load((PRESETS / f"{name}.yaml").read_text())
        for name in ("iccv2023", "iccv2023_paper")
    )
    model, data = code["model"], code["data"]
    assert code["trainer"] == {"max_epochs": 600, "gradient_clip_val": 5.0}
    assert (model["learning_rate"], model["warmup_rate"], model["final_rate"]) == (5e-4, 5e-7, 5e-6)
    assert (model["warmup_epochs"], model["weight_decay"]) == (20, 0.05)
    assert (model["mixup"], model["cutmix"], model["label_smoothing"]) == (0.8, 1.0, 0.1)
    assert (data["batch_size"], data["erasing"], data["size"]) == (128, 0.25, 64)
    rates = ("learning_rate", "warmup_rate", "final_rate")
    code_at_128 = {rate: code["model"].pop(rate) * 128 / 512 for rate in rates}
    at_128 = {rate: paper["model"].pop(rate) for rate in rates}
    assert paper["model"].pop("reference_batch") == paper["data"]["batch_size"] == 128
    assert paper == code
    assert at_128 == code_at_128 | {"learning_rate": 1e-3}


@pytest.mark.parametrize("preset", sorted(path.stem for path in PRESETS.glob("*.yaml")))
def test_every_preset_trains(preset, tmp_path, scenes):
    few = ["--trainer.max_steps", "1", "--data.batch_size", "4", "--trainer.logger", "false"]
    dense = preset == "scenes_minutes"
    more = ["--data.path", scenes, "--task", "distance"]
    if not dense:
        more = ["--data.path", "digits", "--model.name", "darswin_a_nano", "--data.limit", "8"]
    fit(tmp_path, "-c", preset, *few, *QUIET, *more)
    model, card = load_model(tmp_path / "checkpoints" / "last.safetensors")
    if dense:
        assert card.model == "darswin_unet_a_nano" and card.size == 128
        assert model.task == card.task == "distance"
    else:
        assert card.model == "darswin_a_nano" and model.num_classes == 10


# -- help -------------------------------------------------------------------------------------


def options_in(text):
    return re.findall(r"^  (?:-c, |-c CONFIG, )?--([\w.]+)", text, re.M)


def own(task):
    """All options of the data and of the model: those of their classes and of the bases."""
    from darswin.train.tasks import TASKS  # imports Lightning

    for group, made in (("data", TASKS[task].data), ("model", TASKS[task].module)):
        for part in (c for c in made.__mro__ if c.__module__.startswith("darswin.")):
            for name, parameter in inspect.signature(part).parameters.items():
                if parameter.kind is not parameter.VAR_KEYWORD and name != "seed":
                    yield f"{group}.{name}"


@pytest.mark.parametrize("task", get_args(Task))
def test_our_options_come_first_and_none_is_missing(capsys, task):
    text = ended(capsys, 0, main, ["fit", "--task", task, "--help"]).out
    lines, names = text.splitlines(), options_in(text)
    assert len(lines) <= 150 and max(map(len, lines)) < 120
    assert names[:3] == ["config", "run", "resume"] and len(set(names)) == len(names)
    assert set(own(task)) <= set(names) and "task" in names
    assert ("xi" in names) == ("model.mixup" in names) == (task == "classification")
    assert ("data.max_distance" in names) == (task == "distance")
    last = max(k for k, name in enumerate(names) if not name.startswith("trainer."))
    assert 5 < len(names) - last - 1 < 20  # then the trainer's, a handful
    assert "darswin fit --help.all" in lines[-1]
    assert " None [" not in text and "SUPPRESS" not in text.upper()  # each option has a text
    text = " ".join(text.split())
    assert "the folder of the run [required]" in text
    assert "a preset (few, iccv2023, iccv2023_paper, minutes, scenes_minutes, two_cores)" in text
    count = 128 if task == "classification" else 16
    assert f"--data.batch_size images in a batch of one process [{count}]" in text


def test_all_has_everything(capsys):
    from lightning.pytorch import Trainer

    texts = [ended(capsys, 0, main, ["test", flag]).out for flag in ("--help", "--help.all")]
    few, every = map(options_in, texts)
    assert texts[0].startswith("usage: darswin test --run RUN [options]")
    assert "have no effect [from the run]" in " ".join(texts[0].split())
    assert every[: len(few)] == few
    trainer = {f"trainer.{name}" for name in inspect.signature(Trainer).parameters}
    assert trainer - set(every) <= {"trainer.default_root_dir"}
    assert {"print_config", "weights_only"} <= set(every)


def test_help_names_every_command(capsys):
    main(["--help"])
    text = capsys.readouterr().out
    assert all(re.search(rf"^  {name} ", text, re.M) for name in COMMANDS)
    main(["models"])
    text = capsys.readouterr().out
    assert "darswin_a_small" in text.split()
    assert "digits: darswin_a_nano for classification, 10 classes, images of 32×32 with 1 " in text
    assert "mean 0.0, std 1.0" in text
