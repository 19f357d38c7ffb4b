"""What the tests of runs share: training in this process, kills, and what a run left."""

import itertools
from pathlib import Path

import pytest
import torch

from darswin.cli.main import main
from darswin.train.task import Task


def fit(run: Path, *options: str) -> None:
    main(["fit", "--run", str(run), *options])


def error(capsys, run: Path, *options: str) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        fit(run, *options)
    code = caught.value.code  # which Python prints if it is no number
    return f"{'' if isinstance(code, int) else code}{capsys.readouterr().err}"


def checkpoint(run: Path, name: str = "last") -> dict:
    return torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True)


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def assert_same(run: Path, other: Path) -> None:
    ours, theirs = checkpoint(run), checkpoint(other)
    assert ours["global_step"] == theirs["global_step"]
    assert ours["state_dict"].keys() == theirs["state_dict"].keys()
    for name, tensor in theirs["state_dict"].items():
        assert torch.equal(ours["state_dict"][name], tensor), name
    a, b = (c["optimizer_states"][0]["state"] for c in (ours, theirs))
    assert (
        all(torch.equal(a[k][key], b[k][key]) for k in b for key in b[k]) and a.keys() == b.keys()
    )


class KilledError(BaseException):
    """Nothing that the program knows, as a kill is."""


STEP = Task.training_step


def patch_batch(monkeypatch, number: int, action) -> None:
    """The n-th batch of the next `fit` begins with an action, which may give it another loss."""
    counts = itertools.count(1)

    def acting(self, batch, batch_idx):
        other = action(self) if next(counts) == number else None
        return STEP(self, batch, batch_idx) if other is None else other

    monkeypatch.setattr(Task, "training_step", acting)


def killed(self):
    raise KilledError
