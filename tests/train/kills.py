"""Kills runs at random moments, 20 times each, and compares what they end with, bit for bit.

`make kills` runs it: with accumulated gradients, with worker processes, and with two processes; and
for each of the dense tasks.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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
CASES = {
    "accumulation": [*CLASSES, "--trainer.accumulate_grad_batches", "3"],
    "workers": [*CLASSES, "--data.workers", "2"],
    "processes": [*CLASSES, "--devices", "2", "--data.batch_size", "8"],
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


def final(run: Path) -> dict[str, torch.Tensor]:
    """All tensors that a run ends with: weights and the optimizer's moments."""
    checkpoint = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    tensors = checkpoint["state_dict"]
    for number, state in checkpoint["optimizer_states"][0]["state"].items():
        tensors |= {f"{number}.{name}": tensor for name, tensor in state.items()}
    return tensors


def kill_at_random(run: Path, options: list[str], kills: int, span: float, chance) -> int:
    """How often a run was killed before it ended; each time after up to `span` seconds of steps."""
    for done in range(kills):
        # A kill may leave a run before it wrote its configuration.
        begun = (run / "config.yaml").exists()
        process = start(run, "--resume", *([] if begun else options))
        wait_for_steps(run, process)
        time.sleep(chance.uniform(0, span))
        if process.poll() is not None:
            finish(run, process)
            return done
        # The first process alone, whose companions then end by themselves, or all at one time.
        (os.kill if chance.random() < 0.5 else os.killpg)(process.pid, signal.SIGKILL)
        process.wait()
    finish(run, start(run, "--resume"))
    return kills


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
            expected, kills, runs = final(whole), 0, 0
            while kills < arguments.kills:
                run = Path(folder) / f"killed-{runs}"
                kills += kill_at_random(run, options, arguments.kills - kills, span, chance)
                runs += 1
                found = final(run)
                same = sum(torch.equal(found[name], expected[name]) for name in expected)
                tensors = f"{same} of {len(expected)} tensors are those of the undisturbed run"
                print(f"{case}: {kills} kills, {tensors}", flush=True)
                if same < len(found) or found.keys() != expected.keys():
                    raise SystemExit(1)


if __name__ == "__main__":
    main()
