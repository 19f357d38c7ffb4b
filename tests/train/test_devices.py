"""Runs on a GPU, as far as a machine without one can show: what is made where, and what moves."""

from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch.strategies import Strategy
from runs import assert_same, error, fit
from scenes import write_plain

from darswin import lens
from darswin.train.data import WideAngleData

FEW = """--trainer.max_steps 2 --data.batch_size 4 --data.size 32 --data.workers 1
    --trainer.logger false --trainer.enable_progress_bar false""".split()  # noqa: SIM905
TINY = "{embed_dim: 8, depths: [1, 1, 1], rings: 8, sectors: 32, samples: [2, 2]}"
DIGITS = ["--data.path", "digits", "--data.limit", "16", "--model.name", "darswin_a_nano"]
DENSE = ["--task", "segmentation", "--model.name", "darswin_unet_a_nano", "--model.options", TINY]


@pytest.mark.parametrize("task", ["classification", "segmentation"])
def test_with_a_gpu_as_lightnings_device_weights_and_data_are_the_same(task, tmp_path, monkeypatch):
    options = DIGITS
    if task == "segmentation":
        options = [*DENSE, "--data.path", str(write_plain(tmp_path / "scenes", 16, size=(45, 60)))]
    fit(tmp_path / "cpu", *options, *FEW)
    # What Lightning makes the default device as it calls `configure_model`.
    there = torch.device("meta")
    monkeypatch.setattr(Strategy, "tensor_init_context", lambda self, empty_init=None: there)
    fit(tmp_path / "gpu", *options, *FEW)
    assert_same(tmp_path / "gpu", tmp_path / "cpu")


@pytest.mark.parametrize("kind", ["cuda", "cpu"])
def test_memory_is_pinned_for_a_gpu_alone(kind):
    data = WideAngleData("digits", workers=0)
    strategy = SimpleNamespace(root_device=torch.device(kind))
    data.trainer = SimpleNamespace(strategy=strategy, global_rank=0, world_size=1)
    for loader in (data.train_dataloader(), data.val_dataloader()):
        assert loader.pin_memory == (kind == "cuda")


def test_a_batch_moves_with_its_lenses():
    batch = [torch.randn(2, 3, 8, 8), lens.Equidistant([20.0, 21.0], 1.2), torch.tensor([1, 2])]
    moved = WideAngleData("digits").transfer_batch_to_device(batch, torch.device("meta"), 0)
    images, lenses, labels = moved
    assert images.device.type == labels.device.type == lenses.theta_max.device.type == "meta"
    assert isinstance(lenses, lens.Equidistant) and len(lenses) == 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_said_in_one_line(tmp_path, capsys):
    said = error(capsys, tmp_path / "run", *DIGITS, *FEW, "--trainer.accelerator", "gpu")
    assert "darswin: No supported gpu backend found!" in said and "Traceback" not in said
