"""Kills and stops runs at random, 20 times each, and compares what they end with, bit for bit.

`make kills` runs it: with accumulated gradients, with worker processes, and with two processes; and
for each of the dense tasks. Cases named "stops" also end runs by a limit of steps, by a limit of
time, and by signals at the borders of epochs.
"""

import argparse
import csv
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from scenes import write_plain

ALL = [
    *("--data.workers", "0", "--checkpoint_steps", "2", "--trainer.log_every_n_steps", "1"),
    *("--trainer.enable_progress_bar", "false", "--trainer.accelerator", "cpu"),
    *("--data.randaugment", "true"),
]
CLASSES = [
    *("--config", "minutes", "--data.path", "digits", "--data.limit", "160"),
    *("--data.batch_size", "16", "--trainer.max_epochs", "24", *ALL),
    *("--model.mixup", "0.8", "--model.cutmix", "1.0"),
    *("--data.erasing", "0.25", "--model.options", "{embed_dim: 8}"),
]
SCENES = [
    *("--model.name", "darswin_unet_a_nano", "--data.size", "32", "--data.batch_size", "4"),
    *("--model.options", "{embed_dim: 8, depths: [1, 1, 1], rings: 8, sectors: 32}"),
    *("--data.flip", "true", "--data.rotate_deg", "180", "--data.crop", "0.5"),
    *("--data.lens_augmentation", "0..1", "--trainer.max_epochs", "12", *ALL),
]
# The rate is the same at each step, because a limit of steps moves the end of the schedule.
STEADY = ["--model.warmup_epochs", "0", "--model.final_rate", "3e-3"]
NO_LIMIT = ["--trainer.max_steps", "-1", "--trainer.max_time", "null"]
CASES = {
    "accumulation": [*CLASSES, "--trainer.accumulate_grad_batches", "3"],
    "workers": [*CLASSES, "--data.workers", "2"],
    "processes": [*CLASSES, "--devices", "2", "--data.batch_size", "8"],
    "stops": [*CLASSES, *STEADY, "--data.workers", "2", "--trainer.accumulate_grad_batches", "3"],
    "stops of two": [*CLASSES, *STEADY, "--devices", "2", "--data.batch_size", "8"],
    "segmentation": ["--task", "segmentation", *SCENES, "--data.workers", "2"],
    "distance": ["--task", "distance", *SCENES, "--devices", "2", "--data.batch_size", "2"],
}


def start(run: Path, *options: str) -> subprocess.Popen:
    with open(f"{run}.log", "a") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "darswin", "fit", "--run", str(run), *options],
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )


def wait_for_steps(run: Path, process: subprocess.Popen) -> None:
    """Until a process of a run has logged a step, into a file of its own."""
    logs = set(run.glob("csv/*/metrics.csv"))
    while process.poll() is None and set(run.glob("csv/*/metrics.csv")) == logs:
        time.sleep(0.01)


def finish(run: Path, process: subprocess.Popen) -> None:
    if process.wait():
        raise SystemExit(f"{run} failed: {Path(f'{run}.log').read_text()[-3000:]}")


def wait_for_validation(run: Path, process: subprocess.Popen) -> None:
    """Until a process of a run has logged a validation."""
    before = validations(run)
    while process.poll() is None and validations(run) == before:
        time.sleep(0.005)


def validations(run: Path) -> int:
    """The number of validations in the logs of a run."""
    count = 0
    for file in run.glob("csv/*/metrics.csv"):
        with file.open() as lines:
            count += sum(bool(row.get("val/loss")) for row in csv.DictReader(lines))
    return count


def last(run: Path) -> dict[str, Any]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)


def final(run: Path) -> dict[str, torch.Tensor]:
    """All tensors that a run ends with: weights and the optimizer's moments."""
    checkpoint = last(run)
    tensors = checkpoint["state_dict"]
    for number, state in checkpoint["optimizer_states"][0]["state"].items():
        tensors |= {f"{number}.{name}": tensor for name, tensor in state.items()}
    return tensors


def step(run: Path) -> int:
    return last(run)["global_step"] if (run / "checkpoints" / "last.ckpt").exists() else 0


def interrupt_at_random(
    run: Path, options: list[str], count: int, span: float, chance: random.Random, steps: int
) -> int:
    """How often a run was interrupted before it ended at `steps`, at most `count` times.

    A kill comes after up to `span` seconds of steps. Runs with a steady rate also stop otherwise.
    """
    ways = ["kill", "steps", "time", "signal"] if STEADY[0] in options else ["kill"]
    seconds = 0  # Lightning adds up the time of the calls that have a limit
    for done in range(count):
        # A kill may leave a run before it wrote its configuration.
        given = ["--resume", *([] if (run / "config.yaml").exists() else options), *NO_LIMIT]
        way = chance.choice(ways)
        if way == "steps":
            given += ["--trainer.max_steps", str(step(run) + chance.randint(1, 9))]
        elif way == "time":
            seconds += 1
            given += ["--trainer.max_time", f"00:00:00:{seconds:02}"]
        process = start(run, *given)
        # The first process alone, whose companions then end by themselves, or all at one time.
        send = os.kill if chance.random() < 0.5 else os.killpg
        if way == "kill":
            wait_for_steps(run, process)
            time.sleep(chance.uniform(0, span))
        elif way == "signal":
            wait_for_validation(run, process)
            time.sleep(chance.uniform(0, 0.05))
        if way in ("kill", "signal") and process.poll() is None:
            number = signal.SIGKILL if way == "kill" else signal.SIGTERM
            send(process.pid, number)
            if process.wait() not in (0, -number, 128 + number):
                finish(run, process)
        else:
            finish(run, process)
        if step(run) == steps:
            return done
        print(f"  step {step(run)}: {way}", flush=True)
    finish(run, start(run, "--resume", *NO_LIMIT))
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    for case in arguments.cases:
        with tempfile.TemporaryDirectory() as folder:
            whole, options = Path(folder) / "whole", CASES[case]
            if "--task" in options:
                options = [*options, "--data.path", str(write_plain(Path(folder) / "scenes", 40))]
            process = start(whole, *options)
            wait_for_steps(whole, process)
            began = time.monotonic()
            finish(whole, process)
            span = 1.2 * (time.monotonic() - began) / arguments.kills
            expected, steps, kills, runs = final(whole), step(whole), 0, 0
            while kills < arguments.kills:
                run = Path(folder) / f"killed-{runs}"
                left = arguments.kills - kills
                kills += interrupt_at_random(run, options, left, span, chance, steps)
                runs += 1
                found = final(run)
                same = sum(torch.equal(found[name], expected[name]) for name in expected)
                tensors = f"{same} of {len(expected)} tensors are those of the undisturbed run"
                print(f"{case}: {kills} interruptions, {tensors}", flush=True)
                if same < len(found) or found.keys() != expected.keys():
                    raise SystemExit(1)


if __name__ == "__main__":
    main()
