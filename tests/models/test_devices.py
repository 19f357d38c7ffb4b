"""Models on the device "meta": they launch few kernels, and no forward pass and no step waits.

Reading a value fails on "meta". A copy between host and device fails in `Launches`.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import create, product, refused
from launches import Launches, launches

from darswin import lens
from darswin.lens import cat, distorted, solve
from darswin.train.classification import Classification
from darswin.train.distance import Distance
from darswin.train.segmentation import Segmentation

SPHERICAL = lens.Spherical.from_fov(xi=[0.3, 0.5], fov=2.0, radius=32.0)
LENSES = {
    "spherical": SPHERICAL,
    "of an image size": lens.Spherical(SPHERICAL.xi, SPHERICAL.focal, 1.0, image_size=(64, 64)),
    "curves": cat([SPHERICAL, lens.Equidistant([20.0], 1.2)])[1:],
    "tangential": lens.KannalaBrandt(
        [20.0, 21.0], [0.01, 0.002], tangential=[1e-3, 2e-3], theta_max=1.0
    ),
    "affine": lens.Equidistant([20.0, 21.0], 1.2, affine=[[1.0, 0.01], [0.0, 1.1]]),
}
MODELS = {
    "darswin_a_nano": {},
    "darswin_ra_nano": dict(spacing="g", sample_spacing="radius"),
    "darswin_a_micro": dict(position_bias="polar", spacing="tan"),
    "swin_nano": dict(image_size=64),
    "swin_nano perspective": dict(image_size=64),
    "dat_nano": dict(image_size=64),
    "darswin_unet_a_nano": dict(task="distance"),
    "swin_unet_nano perspective": dict(task="distance", image_size=64),
    "conv_unet_nano": dict(task="distance", view="mercator", size=48),
    "swin_unet_nano": dict(image_size=64, view=dict(name="equirectangular", fov=2.6)),
}


def network(name, **options):
    with torch.device("meta"):
        return create(name, **options)


def images(dtype=torch.float32, size=64):
    return torch.empty(2, 3, size, size, device="meta", dtype=dtype)


@pytest.mark.parametrize(
    ("name", "kind", "dtype"), product(MODELS, LENSES, [torch.float32, torch.uint8])
)
def test_no_model_waits_in_a_step(name, kind, dtype, monkeypatch):
    # All steps of Newton's method are alike, so three of them are enough.
    monkeypatch.setattr(solve, "_STEPS", 3)
    monkeypatch.setattr(distorted, "newton", lambda *a, rounds=0: solve.newton(*a, rounds=3))
    model = network(name, mean=[0.4, 0.5, 0.6], std=0.2, **MODELS[name])
    lenses = LENSES[kind].to("meta")
    with Launches():
        model(images(dtype), lenses).square().mean().backward()


def attach(task, net, monkeypatch, **data):
    """Gives a task the attributes that Lightning and the data module set."""
    trainer = SimpleNamespace(
        global_step=0, log_every_n_steps=50,
        optimizers=[SimpleNamespace(param_groups=[dict(lr=0.1)])],
        datamodule=SimpleNamespace(**data),
    )  # fmt: skip
    monkeypatch.setattr(type(task), "trainer", trainer, raising=False)
    monkeypatch.setattr(task, "log", lambda *arguments, **options: None)
    task.net = net
    return task


@pytest.mark.parametrize("pairs", [False, True])
def test_a_classifiers_task_does_not_wait(pairs, monkeypatch):
    data = dict(calibrations=object() if pairs else None, pair_lenses=pairs)
    net = network("darswin_a_nano", num_classes=3, depths=(1,), num_heads=(1,))
    task = attach(Classification("darswin_a_nano"), net, monkeypatch, classes="abc", **data)
    task.card = SimpleNamespace(classes="abc")
    labels = torch.empty(2, device="meta", dtype=torch.int64)
    batch = images(), SPHERICAL.to("meta"), labels
    with Launches():
        for step in range(4):
            task.training_step(batch, step).backward()


@pytest.mark.parametrize("weighted", [False, True])
def test_the_dense_tasks_do_not_wait_in_a_step(weighted, monkeypatch):
    labels = torch.empty(2, 64, 64, device="meta", dtype=torch.int64)
    batch, rng = (images(), SPHERICAL.to("meta")), np.random.default_rng(0)
    tasks = (
        (Segmentation("darswin_unet_a_nano", class_weights=[1.0, 2.0, 3.0],
                      solid_angle_weights=weighted), dict(task="segmentation", num_classes=3)),
        (Distance("darswin_unet_a_nano", solid_angle_weights=weighted), dict(task="distance")),
    )  # fmt: skip
    for task, options in tasks:
        shallow = dict(depths=(1, 1), num_heads=(1, 2))
        attach(task, network("darswin_unet_a_nano", **options, **shallow), monkeypatch)
        target = labels if options["task"] == "segmentation" else labels.float()
        with Launches():
            task._loss((*batch, target), rng).backward()


def test_a_loss_that_is_not_finite_is_told_where_lightning_logs(monkeypatch):
    task = attach(Classification("darswin_a_nano"), torch.nn.Identity(), monkeypatch)
    loss = torch.tensor(torch.nan)
    monkeypatch.setattr(task, "_loss", lambda batch, rng: loss)
    with pytest.raises(FloatingPointError, match="the loss is nan in epoch 0, batch 3"):
        task.training_step(([0],), 3)
    # On a device, the loss is read only when Lightning reads it too.
    monkeypatch.setattr("darswin.train.task.readable", lambda value: False)
    every = task.trainer.log_every_n_steps
    for step in range(2 * every):
        task.trainer.global_step = step
        if (step + 1) % every:
            assert task.training_step(([0],), step).isnan()
        else:
            refused(f"batch {step}", task.training_step, ([0],), step, error=FloatingPointError)


@pytest.mark.slow
def test_launches_of_darswin_a_small():
    model, lenses = network("darswin_a_small", num_classes=10), SPHERICAL.to("meta")
    with torch.no_grad():
        forward = launches(model.eval(), images(), lenses)
    step = launches(lambda: model.train()(images(), lenses).sum().backward())
    assert forward.total() <= 1060 and step.total() <= 2530, (forward.total(), step.total())
    # A stage computes the position biases of all its blocks at once.
    assert forward["aten::sin"] <= 11 and forward["aten::cat"] <= 40, forward
