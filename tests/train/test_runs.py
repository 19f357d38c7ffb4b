"""Whole runs of the command line in processes of their own, as a user starts them."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from darswin.cli.main import main
from darswin.models.saving import load_model

SMALL = """
    --config minutes --data.path digits --trainer.max_epochs 2 --data.limit 160 --data.batch_size 16
    --checkpoint_steps 4 --trainer.log_every_n_steps 1 --trainer.enable_progress_bar false
    --model.mixup 0.8 --model.cutmix 1.0 --data.randaugment true --data.erasing 0.25
""".split()  # noqa: SIM905


def start(command: str, run: Path, *options: str) -> subprocess.Popen:
    run.parent.mkdir(parents=True, exist_ok=True)
    log = open(f"{run}.log", "a")  # noqa: SIM115  the process keeps it
    return subprocess.Popen(
        [sys.executable, "-m", "darswin", command, "--run", str(run), *options],
        stdout=log,
        stderr=subprocess.STDOUT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )


def finish(process: subprocess.Popen, run: Path) -> None:
    assert process.wait(timeout=300) == 0, Path(f"{run}.log").read_text()[-3000:]


def checkpoint(run: Path) -> dict:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)


def losses(run: Path) -> dict[int, str]:
    """The training loss of each step, as it was logged; every restart has its own file."""
    found = {}
    for file in sorted(run.glob("csv/*/metrics.csv")):
        with file.open() as lines:
            rows = list(csv.DictReader(lines))
        found |= {int(row["step"]): row["train/loss"] for row in rows if row["train/loss"]}
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("runs") / "whole"
    finish(start("fit", run, *SMALL), run)
    return run


def test_a_run_leaves_everything_in_its_folder(whole):
    names = {p.relative_to(whole).as_posix() for p in whole.rglob("*") if p.is_file()}
    kept = {f"checkpoints/{n}.{e}" for n in ("best", "last") for e in ("ckpt", "safetensors")}
    assert kept | {"config.yaml", "csv/version_0/metrics.csv"} <= names
    assert any("events.out.tfevents" in name for name in names)
    model, card = load_model(whole / "checkpoints" / "last.safetensors")
    state = checkpoint(whole)["state_dict"]
    assert all(torch.equal(t, state[f"net.{name}"]) for name, t in model.state_dict().items())
    assert card.classes == [str(k) for k in range(10)] and card.size == 32
    assert len(losses(whole)) == 20


def test_a_killed_run_goes_on_bit_for_bit(whole, tmp_path):
    run = tmp_path / "killed"
    last = run / "checkpoints" / "last.ckpt"
    process = start("fit", run, *SMALL)
    while not last.exists() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert 0 < checkpoint(run)["global_step"] < 20
    finish(start("fit", run, "--resume"), run)

    ours, theirs = checkpoint(run), checkpoint(whole)
    assert ours["global_step"] == theirs["global_step"] == 20
    for name, tensor in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], tensor), name
    for key in ("exp_avg", "exp_avg_sq"):
        a, b = (c["optimizer_states"][0]["state"] for c in (ours, theirs))
        assert all(torch.equal(a[k][key], b[k][key]) for k in b) and a.keys() == b.keys()
    best, other = (load_model(r / "checkpoints" / "best.safetensors")[0] for r in (run, whole))
    assert all(
        torch.equal(a, b) for a, b in zip(best.parameters(), other.parameters(), strict=True)
    )
    again, expected = losses(run), losses(whole)
    assert all(again[step] == expected[step] for step in again) and len(again) >= 15


def test_a_run_told_to_stop_says_so(tmp_path):
    run = tmp_path / "stopped"
    process = start("fit", run, *SMALL, "--trainer.max_epochs", "1000")
    while not (run / "checkpoints" / "last.ckpt").exists() and process.poll() is None:
        time.sleep(0.005)
    process.terminate()
    assert process.wait(timeout=60) == 128 + signal.SIGTERM
    assert f"`darswin fit --run {run} --resume` goes on" in Path(f"{run}.log").read_text()


def test_two_processes_train_as_one(tmp_path):
    still = [
        *SMALL,
        "--model.options",
        "{jitter: 0, drop_path_rate: 0}",
        "--trainer.max_epochs",
        "1",
    ]
    one, two = tmp_path / "one", tmp_path / "two"
    main(["fit", "--run", str(one), *still])
    pair = ["--devices", "2", "--trainer.accelerator", "cpu", "--data.batch_size", "8"]
    finish(start("fit", two, *still, *pair), two)
    a, b = losses(one), losses(two)
    assert len(a) == len(b) == 10
    for step in a:
        assert float(a[step]) == pytest.approx(float(b[step]), rel=1e-5)
    for name, tensor in checkpoint(one)["state_dict"].items():
        torch.testing.assert_close(
            checkpoint(two)["state_dict"][name], tensor, rtol=1e-3, atol=1e-5
        )


def test_one_test_over_all_distortions(whole, capsys):
    main(["test", "--run", str(whole), "--xi", "0:1:0.5"])
    rows = json.loads((whole / "test.json").read_text())["results"]
    assert [row["lenses"] for row in rows] == ["0", "0.5", "1"]
    with (whole / "test.csv").open() as lines:
        table = list(csv.DictReader(lines))
    assert [float(r["top1"]) for r in table] == [row["top1"] for row in rows]
    assert all(0 < row["top1"] <= row["top5"] <= 1 and row["loss"] > 0 for row in rows)
    assert (whole / "test.png").read_bytes().startswith(b"\x89PNG")
    assert "top1 (%)" in capsys.readouterr().out
    finish(
        start("test", whole, "--devices", "2", "--trainer.accelerator", "cpu", "--xi", "0:1:0.5"),
        whole,
    )
    both = json.loads((whole / "test.json").read_text())["results"]
    for a, b in zip(rows, both, strict=True):
        assert a["top1"] == pytest.approx(b["top1"]) and a["loss"] == pytest.approx(
            b["loss"], rel=1e-4
        )
