"""What `fit` and the other commands say: sizes, shortfalls, ends, and nothing of other packages."""

import json
import os
import re
import subprocess
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from helpers import products, slow_but
from runs import DIGITS, checkpoint, fit, test


def write_stripes(folder, **counts):
    """Pictures of stripes in four directions, the classes; of random colours, widths and phases."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:64, :64]
    for split, count in counts.items():
        for k, name in enumerate(("flat", "rising", "steep", "falling")):
            (folder / split / name).mkdir(parents=True)
            across = x * np.sin(k * np.pi / 4) + y * np.cos(k * np.pi / 4)
            for n in range(count):
                wave = np.sin(across * rng.uniform(0.4, 0.8) + rng.uniform(0, 6.3))[..., None]
                image = rng.uniform(90, 160, 3) + wave * rng.uniform(40, 90, 3)
                image += rng.normal(0, 8, image.shape)
                file = folder / split / name / f"{n}.png"
                cv2.imwrite(str(file), image.clip(0, 255).astype(np.uint8))
    return folder


@pytest.mark.slow
@pytest.mark.products
def test_the_preset_few_learns_96_pictures_that_two_cores_does_not(tmp_path):
    pictures = write_stripes(tmp_path / "stripes", train=20, val=4, test=20)
    right = {}
    for preset in ("few", "two_cores"):
        options = ["--config", preset, "--data.path", pictures, "--data.workers", "0"]
        fit(tmp_path / preset, *options, "--trainer.enable_progress_bar", "false")
        right[preset] = np.mean([row["top1"] for row in test(tmp_path / preset, "--xi", "0.1,0.5")])
    assert right["few"] > 0.7 and right["two_cores"] < 0.5


@pytest.mark.slow
def test_the_size_of_a_training_its_end_and_what_is_next(tmp_path, capsys):
    run = tmp_path / "a run"
    fit(run, *DIGITS)
    said = capsys.readouterr().err.splitlines()
    sizes = "; 96 training and 96 validation pictures; 3 steps an epoch, 6 in all"
    assert said[0].endswith(sizes) and said[0].startswith("darswin_a_nano with ")
    assert said[1].startswith("darswin: 6 steps cannot teach a new model, which takes 100")
    best = checkpoint(run, "best")["callbacks"]
    (score,) = (state["best_model_score"] for name, state in best.items() if "val/top1" in name)
    assert (
        f"finished at step 6, best val/top1 {score:.4g}; next: `darswin test --run '{run}'`"
        in (said[-1])
    )
    # It has nothing left to do, and says what gives it more.
    fit(run, "--resume")
    said = capsys.readouterr().err
    assert "finished at step 6" in said and "with more --trainer.max_epochs" in said
    assert "cannot teach" not in said


def test_a_used_up_time_limit_is_named(tmp_path, capsys):
    fit(tmp_path, *DIGITS, "--trainer.max_steps", "1")
    capsys.readouterr()
    more = ["--trainer.max_steps", "-1", "--trainer.max_time", "00:00:00:00"]
    fit(tmp_path, "--resume", *more)
    said = capsys.readouterr().err
    assert "stopped at step 1: " in said and "--resume` with a longer --trainer.max_time" in said


@pytest.mark.parametrize(
    ("steps", "warmup", "said"),
    [
        (100, 5, []),
        (99, 0, ["99 steps cannot teach"]),
        (1000, 50, []),
        (1000, 50.1, ["the learning rate rises during 501 of 1,000 steps"]),
        (10, 20, ["10 steps cannot teach", "rises during 10 of 10 steps"]),
    ],
)
def test_schedules_that_are_too_short(steps, warmup, said):
    from darswin.cli.announce import shortfalls  # imports Lightning

    found = shortfalls(SimpleNamespace(steps=steps, warmup_epochs=warmup, steps_per_epoch=10))
    assert len(found) == len(said)
    assert all(part in text for part, text in zip(said, found, strict=True))


# -- nothing of other packages ----------------------------------------------------------------

COMMANDS = """
import json, sys
from darswin.cli.main import main
for words in json.loads(sys.argv[1]):
    main(words)
"""
NUMBER = r"[\d.,–-]+"
OURS = [
    r"epoch \d+, step \d+: train/loss ",
    rf"darswin_a_nano with {NUMBER} parameters; {NUMBER} training and {NUMBER} validation pictures",
    r"darswin: \d+ steps cannot teach a new model",
    r"darswin: the learning rate rises during 2 of 2 steps: ",
    r"--trainer\.max_steps -1 in place of 2$",
    r"finished at step [24], (best val/top1|no validation)",
    r"lenses +n +top1 \(%\) +95 % interval +top5 \(%\) +loss +most frequent class \(%\)$",
    rf"0(\.5)?( +{NUMBER}){{6}}$",
    r"On .*, the accuracy is not certainly above that of always answering",
    r"run/test\.csv, test\.json and test\.png$",
    r"─+$",
    r"Validate metric +DataLoader 0$",
    rf"val/(loss|top1|top5) +{NUMBER}$",
]


@pytest.mark.slow
@pytest.mark.parametrize("bar", slow_but([False, None, True], None, marks=products))
def test_fit_validate_and_test_print_only_our_own_lines(tmp_path, bar):
    shown = ["--trainer.enable_progress_bar", json.dumps(bar)]
    start = ["fit", "--run", "run", "--config", "minutes", "--data.path", "digits"]
    start += ["--data.limit", "96", "--trainer.max_epochs", "2", *shown]
    commands = [
        [*start, "--trainer.max_steps", "2"],
        ["fit", "--run", "run", "--resume", "--trainer.max_steps", "-1", *shown],
        ["validate", "--run", "run", *shown],
        ["test", "--run", "run", "--xi", "0,0.5", *shown],
    ]
    done = subprocess.run(
        [sys.executable, "-c", COMMANDS, json.dumps(commands)],
        capture_output=True, text=True, cwd=tmp_path, env=os.environ | {"COLUMNS": "100"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = [line.strip() for line in (done.stdout + done.stderr).splitlines()]
    assert any(line.startswith("epoch 2, step 4: train/loss ") for line in lines) == (bar is None)
    if bar:
        ends = r"(Training|Epoch \d+|Validation|Validation DataLoader \d|Testing|Testing DataLoader"
        lines = [re.split(r"(?<=.)\r", line)[-1] for line in lines]
        lines = [line for line in lines if not re.match(rf"{ends} \d):", line)]
        lines = [line for line in lines if line.strip("\x1b[A ")]
    strange = [line for line in lines if line and not any(re.match(o, line) for o in OURS)]
    assert strange == []
