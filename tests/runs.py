"""Shared by the tests of runs: tiny runs of each task in this process, kills, and their files."""

import csv
import itertools
import json
from pathlib import Path

import pytest
import torch

from darswin.cli.main import main

QUIET = """--data.workers 0 --trainer.enable_progress_bar false
    --trainer.enable_model_summary false""".split()  # noqa: SIM905
UNET = "{embed_dim: 8, depths: [1, 1, 1], rings: 8, sectors: 32, samples: [2, 2]}"
# 12 batches an epoch, in steps of 5, 5 and 2; few are validated.
DIGITS = [
    *("--config", "minutes", "--data.path", "digits", "--data.limit", "96"),
    *("--data.batch_size", "8", "--trainer.max_epochs", "2", "--checkpoint_steps", "1", *QUIET),
    *("--trainer.accumulate_grad_batches", "5", "--trainer.log_every_n_steps", "1"),
    *("--model.options", "{embed_dim: 8, depths: [1, 1, 1]}", "--model.mixup", "0.8"),
    *("--data.randaugment", "true", "--trainer.limit_val_batches", "3"),
]
PIXELS = [
    *("--data.size", "32", "--data.batch_size", "8", "--model.name", "darswin_unet_a_nano"),
    *("--model.options", UNET, "--model.learning_rate", "1e-2", "--model.reference_batch", "8"),
    *("--checkpoint_steps", "1", *QUIET),
]


def fit(run: Path, *options) -> None:
    main(["fit", "--run", str(run), *map(str, options)])


def test(run: Path, *options) -> list[dict]:
    main(["test", "--run", str(run), "--trainer.enable_progress_bar", "false", *map(str, options)])
    return json.loads((run / "test.json").read_text())["results"]


test.__test__ = False


def error(capsys, *argv) -> str:
    """All that a command which fails prints: Python prints an exit code that is no number."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main([str(word) for word in argv])
    code = caught.value.code
    assert code != 0
    return f"{'' if isinstance(code, int) else code}{capsys.readouterr().err}"


def checkpoint(run: Path, name: str = "last") -> dict:
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


def table(file: Path) -> list[dict[str, str]]:
    with file.open() as lines:
        return list(csv.DictReader(lines))


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def assert_same(run: Path, other: Path) -> None:
    ours, theirs = checkpoint(run), checkpoint(other)
    assert ours["global_step"] == theirs["global_step"]
    assert ours["state_dict"].keys() == theirs["state_dict"].keys()
    for name, tensor in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], tensor), name
    a, b = (c["optimizer_states"][0]["state"] for c in (ours, theirs))
    assert a.keys() == b.keys()
    assert all(torch.equal(a[k][key], b[k][key]) for k in b for key in b[k])


class KilledError(BaseException):
    """Nothing that the program knows, as a kill is."""


def patch_batch(monkeypatch, number: int, action) -> None:
    """The n-th batch of the next `fit` begins with an action, which may give it another loss."""
    from darswin.train.task import TaskModule  # takes seconds

    counts, step = itertools.count(1), TaskModule.training_step

    def acting(self, batch, batch_idx):
        other = action(self) if next(counts) == number else None
        return step(self, batch, batch_idx) if other is None else other

    monkeypatch.setattr(TaskModule, "training_step", acting)


def killed_fit(monkeypatch, run: Path, number: int, *options) -> None:
    """A `fit` that is killed in its n-th batch."""

    def kill(self):
        raise KilledError

    with monkeypatch.context() as patch, pytest.raises(KilledError):
        patch_batch(patch, number, kill)
        fit(run, *options)
