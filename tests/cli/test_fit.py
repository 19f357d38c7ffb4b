"""What goes wrong is said in one line, before any work."""

import json
import re
import resource

import cv2
import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file
from scenes import write_plain

from darswin.cli.main import COMMANDS, main
from darswin.cli.options import PRESETS, complete
from darswin.layers import linear
from darswin.models import load_model

DIGITS = ["--config", "minutes", "--data.path", "digits", "--trainer.logger", "false"]


def error(capsys, *argv) -> str:
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in argv])
    assert caught.value.code != 0
    return said(caught.value, capsys)


def said(end: SystemExit, capsys) -> str:
    """All that a command which failed printed: Python prints a code that is no number."""
    return f"{'' if isinstance(end.code, int) else end.code}{capsys.readouterr().err}"


def test_help_names_every_command(capsys):
    main(["--help"])
    shown = capsys.readouterr().out
    assert all(re.search(rf"^  {name} ", shown, re.M) for name in COMMANDS)
    main(["models"])
    assert "darswin_a_small" in capsys.readouterr().out.split()


def test_unknown_things(capsys, tmp_path):
    assert "no command 'train'" in error(capsys, "train")
    run = ["fit", "--run", tmp_path / "r"]
    assert "model.speed" in error(capsys, *run, *DIGITS, "--model.speed", "9")
    assert "unknown model 'resnet'" in error(capsys, *run, *DIGITS, "--model.name", "resnet")
    assert "model.matmul_backend" in error(capsys, *run, *DIGITS, "--model.matmul_backend", "mkl")
    assert "lenses must be one of" in error(capsys, *run, *DIGITS, "--data.train_lenses", "odd")
    assert "no folder" in error(capsys, *run, *DIGITS, "--data.path", tmp_path / "nothing")
    assert "run" in error(capsys, "fit", *DIGITS)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--data.limit -1", "--data.limit must be at least 1, got -1"),
        ("--data.batch_size 0", "--data.batch_size must be at least 1"),
        ("--data.workers -1", "--data.workers at least 0"),
        ("--data.holdout 0", "--data.holdout 0 leaves no pictures for 'val'"),
        ("--model.learning_rate 0", "--model.learning_rate must be above 0, got 0"),
        ("--model.learning_rate .nan", "--model.learning_rate must be above 0, got nan"),
        ("--model.reference_batch 0", "--model.reference_batch must be above 0"),
        ("--model.weight_decay -1", "--model.weight_decay must be at least 0"),
        ("--model.warmup_epochs .inf", "--model.warmup_epochs must be at least 0"),
        ("--model.options {foo: 1}", "--model.options {'foo': 1}: "),
        ("--model.options {embed_dim: a}", "--model.options {'embed_dim': 'a'}: "),
        ("--model.options {num_classes: 3}", "--model.options cannot set num_classes"),
        ("--model.options {embed_dim: 1099511627776}", "not enough memory: a smaller --data."),
        ("--trainer.overfit_batches 2", "--trainer.overfit_batches"),
        ("--checkpoint_steps 0", "--checkpoint_steps must be at least 1"),
        ("--trainer.max_epochs many", "error: --trainer.max_epochs: "),
        ("--devices many", "error: --devices: "),
    ],
)
def test_wrong_options_are_named_in_one_line(capsys, tmp_path, options, message):
    run = ["--run", tmp_path / "r", *DIGITS, "--data.limit", "96", "--data.workers", "0"]
    said = error(capsys, "fit", *run, *options.split(" ", 1))
    assert message in said and re.match("darswin: |error: ", said.splitlines()[-1])
    assert {p.name for p in (tmp_path / "r").glob("*")} <= {".lock"}


def test_what_is_missing_is_named_as_people_type_it(capsys, tmp_path):
    assert "required: --data.path, --run" in error(capsys, "fit", "--config", "minutes")
    (tmp_path / "c.yaml").write_text("model: {speed: 3}")
    message = error(capsys, "fit", "--run", tmp_path, *DIGITS, "--config", tmp_path / "c.yaml")
    assert "no option '--model.speed'" in message


def test_a_list_of_splits_holds_paths(capsys, tmp_path):
    write_pictures(tmp_path / "p" / "a", 12)
    splits = tmp_path / "splits.json"
    for text in ('{"train": [1, 2]}', '{"train": 3}', "[]"):
        splits.write_text(text)
        options = ["--data.path", tmp_path / "p", "--data.splits", splits]
        assert "must hold" in error(capsys, "fit", "--run", tmp_path / "r", *DIGITS, *options)


def test_a_disk_that_is_full_from_the_start(capsys, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    fit = ["fit", "--run", tmp_path, "--config", "minutes", "--data.path", "digits"]
    fit += ["--data.limit", "96"]
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))  # the configuration needs more
    try:
        message = error(capsys, *fit, "--data.workers", "0")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert re.search(r"^darswin: .*cannot write it.*config\.yaml'$", message, re.M)
    assert [p.name for p in tmp_path.rglob("*")] == [".lock"]


def test_a_run_is_not_overwritten(capsys, tmp_path):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").write_bytes(b"")
    assert "holds a run already" in error(capsys, "fit", "--run", tmp_path, *DIGITS)


def test_the_matmul_backend_and_checkpointing_are_options(tmp_path):
    linear._measured.clear()
    fit = ["fit", "--run", tmp_path, *DIGITS, "--trainer.max_steps", "1", "--data.limit", "48"]
    fit += ["--trainer.enable_progress_bar", "false", "--data.workers", "0"]
    fit += ["--model.matmul_backend", "autotune", "--model.grad_checkpointing", "true"]
    main([str(a) for a in fit])
    assert {shape.product for shape in linear.autotune_results()} == set(linear._WAYS)
    saved = yaml.safe_load((tmp_path / "config.yaml").read_text())["model"]
    assert saved["matmul_backend"] == "autotune" and saved["grad_checkpointing"] is True


def test_a_checkpoint_of_another_model(capsys, tmp_path):
    fit = ["fit", "--run", tmp_path, *DIGITS, "--trainer.max_steps", "1"]
    fit += ["--data.limit", "48", "--trainer.enable_progress_bar", "false", "--data.workers", "0"]
    main([str(a) for a in fit])
    before = (tmp_path / "checkpoints" / "last.ckpt").read_bytes()
    message = error(capsys, "test", "--run", tmp_path, "--model.options", "{embed_dim: 12}")
    assert "another model" in message and "embed_dim None there, 12 here" in message
    assert (tmp_path / "checkpoints" / "last.ckpt").read_bytes() == before
    torch.save({"state_dict": {}}, tmp_path / "other.ckpt")
    message = error(capsys, "test", "--run", tmp_path, "--ckpt_path", tmp_path / "other.ckpt")
    assert "no checkpoint of `darswin fit`" in message
    (tmp_path / "other.ckpt").write_bytes(b"\x80\x02cos\nsystem\n(S'touch owned'\ntR.")
    error(capsys, "test", "--run", tmp_path, "--ckpt_path", tmp_path / "other.ckpt")
    assert "no checkpoint" in error(capsys, "test", "--run", tmp_path, "--ckpt_path", "none.ckpt")


def test_a_run_is_not_overwritten_by_a_launcher(capsys, tmp_path, monkeypatch):
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").write_bytes(b"")
    monkeypatch.setenv("LOCAL_RANK", "0")
    assert "holds a run already" in error(capsys, "fit", "--run", tmp_path)


def test_what_is_missing_is_named(capsys, tmp_path):
    nowhere = tmp_path / "nowhere"
    assert f"no run in {nowhere}" in error(capsys, "test", "--run", nowhere)
    assert "the presets are iccv2023, minutes, scenes_minutes, two_cores" in error(
        capsys, "fit", "--run", nowhere, "--config", "minute"
    )
    (tmp_path / "config.yaml").write_text("data: {path: digits}\n")
    assert f"no model in {tmp_path} yet" in error(capsys, "test", "--run", tmp_path)


@pytest.mark.parametrize("workers", ["0", "1"])
def test_a_broken_picture_is_named_in_one_line(capsys, tmp_path, workers):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for k in range(6):
            (tmp_path / name / f"{k}.jpg").write_bytes(b"no picture")
    options = ["--data.batch_size", "4", "--data.workers", workers]
    message = error(
        capsys, "fit", "--run", tmp_path / "r", *DIGITS, "--data.path", tmp_path, *options
    ).splitlines()[0]
    assert re.search(r"cannot read .*\.jpg: no image .*--data\.skip_broken true", message)


def test_what_folders_leave_out_is_said_once_in_one_line(capsys, tmp_path):
    for name in ("a", "b"):
        write_pictures(tmp_path / name, 12)
    write_pictures(tmp_path, 1)
    fit = ["fit", "--run", tmp_path / "r", *DIGITS, "--data.path", tmp_path]
    fit += ["--trainer.max_steps", "1", "--data.batch_size", "4", "--data.workers", "0"]
    main([str(a) for a in (*fit, "--trainer.enable_progress_bar", "false")])
    said = [line for line in capsys.readouterr().err.splitlines() if "left out" in line]
    assert said == [
        f"darswin: {tmp_path} holds pictures in no class's folder (1, e.g. {tmp_path}/0.png): "
        "left out"
    ]
    again = [*fit, "--run", tmp_path / "again", "--data.limit", "-1"]
    assert "--data.limit must be at least 1, got -1" in error(capsys, *again)


def test_one_class_is_not_enough(capsys, tmp_path):
    write_pictures(tmp_path / "only", 12)
    message = error(capsys, "fit", "--run", tmp_path / "r", *DIGITS, "--data.path", tmp_path)
    assert "needs two classes" in message


def write_pictures(folder, count):
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((8, 8), 20 * k, np.uint8))


def test_skipped_pictures_are_counted(capsys, tmp_path):
    write_pictures(tmp_path / "p" / "a", 12)
    write_pictures(tmp_path / "p" / "b", 12)
    (tmp_path / "p" / "a" / "0.png").write_bytes(b"broken")
    (tmp_path / "p" / "b" / "1.png").write_bytes(b"broken")
    fit = ["fit", "--run", tmp_path / "r", *DIGITS, "--data.path", tmp_path / "p"]
    fit += ["--data.skip_broken", "true", "--data.holdout", "0", "--data.batch_size", "8"]
    fit += ["--trainer.max_epochs", "1", "--trainer.limit_val_batches", "0"]
    main([str(a) for a in fit])
    assert "2 pictures could not be read" in capsys.readouterr().out


def test_presets_and_a_run_s_own_configuration(tmp_path):
    preset = str(PRESETS / "iccv2023.yaml")
    assert complete(["fit", "--config", "iccv2023", "--run", "r", "--x", "1"])[0] == [
        "fit", f"--config={preset}", "--x", "1", "--run", "r",
    ]  # fmt: skip
    own = tmp_path / "config.yaml"
    own.write_text("")
    run = ["--run", str(tmp_path)]
    assert complete(["test", *run])[0] == ["test", f"--config={own}", *run]
    assert complete(["fit", *run])[0] == ["fit", *run]
    assert complete(["fit", *run, "--resume"])[0] == [
        "fit", f"--config={own}", *run, "--resume=true",
    ]  # fmt: skip


def test_the_paper_s_preset_holds_the_recipe():
    preset = yaml.safe_load((PRESETS / "iccv2023.yaml").read_text())
    model, data = preset["model"], preset["data"]
    assert preset["trainer"] == {"max_epochs": 600, "gradient_clip_val": 5.0}
    assert (model["learning_rate"], model["warmup_rate"], model["final_rate"]) == (5e-4, 5e-7, 5e-6)
    assert (model["warmup_epochs"], model["weight_decay"]) == (20, 0.05)
    assert (model["mixup"], model["cutmix"], model["label_smoothing"]) == (0.8, 1.0, 0.1)
    assert (data["batch_size"], data["erasing"], data["size"]) == (128, 0.25, 64)


FIVE = ["darswin_a_nano", "darswin_ra_nano", "swin_nano", "swin_undis_nano", "dat_nano"]


@pytest.mark.parametrize("name", FIVE)
def test_each_of_the_five_models_trains_and_tests(name, tmp_path, capsys):
    run = ["--run", tmp_path]
    fit = [*DIGITS, "--model.name", name, "--trainer.max_steps", "3", "--data.limit", "96"]
    quiet = ["--data.workers", "0", "--trainer.enable_progress_bar", "false"]
    main([str(a) for a in ("fit", *run, *fit, *quiet, "--model.mixup", "0.8")])
    main([str(a) for a in ("test", *run, *quiet, "--xi", "0.1,polynomial")])
    rows = json.loads((tmp_path / "test.json").read_text())
    assert rows["model"] == name and [r["lenses"] for r in rows["results"]] == ["0.1", "polynomial"]
    assert (tmp_path / "test.png").exists()


def test_convert(tmp_path, capsys):
    torch.save({"model": {"a": torch.ones(2)}, "epoch": 3}, tmp_path / "a.pth")
    main(["convert", str(tmp_path / "a.pth"), str(tmp_path / "a.safetensors")])
    assert load_file(tmp_path / "a.safetensors")["a"].tolist() == [1, 1]
    torch.save([1, 2], tmp_path / "b.pth")
    assert "no state dict" in error(capsys, "convert", tmp_path / "b.pth", tmp_path / "b")
    assert not (tmp_path / "b").exists()


def presets(task):
    """Those whose task it is."""
    said = {path.stem: yaml.safe_load(path.read_text()) for path in PRESETS.glob("*.yaml")}
    return sorted(name for name, preset in said.items() if preset.get("task") == task)


@pytest.mark.parametrize("preset", presets(None))
def test_every_preset_trains(preset, tmp_path):
    small = ["--model.name", "darswin_a_nano", "--data.limit", "8", "--data.batch_size", "4"]
    steps = ["--trainer.max_steps", "2", "--data.workers", "0", "--trainer.logger", "false"]
    main(
        ["fit", "--run", str(tmp_path), "--config", preset, "--data.path", "digits", *small, *steps]
    )
    model, card = load_model(tmp_path / "checkpoints" / "last.safetensors")
    assert card.model == "darswin_a_nano" and model.num_classes == 10


@pytest.mark.parametrize("preset", presets("segmentation"))
@pytest.mark.parametrize("task", [None, "distance"])
def test_every_preset_of_scenes_trains(preset, task, tmp_path):
    scenes = write_plain(tmp_path / "scenes", 8, size=(45, 60))
    few = ["--trainer.max_steps", "1", "--data.batch_size", "4", "--data.workers", "0"]
    few += ["--trainer.logger", "false", "--data.path", str(scenes)]
    run = tmp_path / "run"
    main(["fit", "--run", str(run), "-c", preset, *few, *(["--task", task] if task else [])])
    model, card = load_model(run / "checkpoints" / "last.safetensors")
    assert card.model == "darswin_unet_a_nano" and card.size == 128
    assert model.task == card.task == (task or "segmentation")


def test_the_task_is_said_once(tmp_path, capsys):
    config = tmp_path / "config.yaml"
    config.write_text("task: distance\n")
    run = ["--run", str(tmp_path / "run")]
    assert complete(["fit", *run])[1] == "classification"
    assert complete(["fit", "-c", str(config), *run])[1] == "distance"
    both = ["fit", "-c", str(config), "--task", "segmentation", *run]
    assert complete(both)[1] == "segmentation"
    own = ["test", "--run", str(tmp_path)]
    assert complete(own)[1] == "distance"
    assert "is a run of --task distance, not of segmentation" in error(
        capsys, *own, "--task", "segmentation"
    )
    config.write_text("data: {path: digits}\n")  # of a run before there were tasks
    assert complete(own)[1] == "classification"
    assert "--task must be one of classification, segmentation, distance, got 'odd'" in error(
        capsys, "fit", *run, "--task", "odd"
    )
