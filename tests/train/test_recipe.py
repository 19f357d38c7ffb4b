import pytest
import torch

from darswin import create_model
from darswin.train.recipe import learning_rate, parameter_groups


def test_rates_at_the_corners():
    rate = dict(peak=1e-3, warmup=1e-6, final=1e-5, warmup_steps=100, steps=1000)
    assert learning_rate(0, **rate) == pytest.approx(1e-6)
    assert learning_rate(50, **rate) == pytest.approx((1e-6 + 1e-3) / 2)
    # The cosine counts from step 0: a little below the peak where it takes over.
    assert learning_rate(100, **rate) == pytest.approx(1e-5 + 9.9e-4 * 0.9755283, rel=1e-6)
    assert learning_rate(500, **rate) == pytest.approx((1e-3 + 1e-5) / 2)
    assert learning_rate(1000, **rate) == learning_rate(2000, **rate) == pytest.approx(1e-5)
    assert learning_rate(0, **(rate | dict(warmup_steps=0))) == pytest.approx(1e-3)


def test_matrices_decay_and_nothing_else():
    model = create_model("darswin_a_nano", num_classes=4)
    decayed, others = parameter_groups(model, 0.05, model.no_weight_decay())
    assert decayed["weight_decay"] == 0.05 and others["weight_decay"] == 0
    assert all(p.dim() == 2 for p in decayed["params"])
    names = {id(p): name for name, p in model.named_parameters()}
    kept = {names[id(p)] for p in others["params"]}
    assert kept == {
        name
        for name, p in model.named_parameters()
        if p.dim() < 2 or name.endswith(".bias") or ".position_bias." in name
    }
    assert len(decayed["params"]) + len(kept) == len(names)
    with_biases, _ = parameter_groups(model, 0.05, ())
    assert len(with_biases["params"]) > len(decayed["params"])


def test_frozen_parameters_are_left_out():
    layer = torch.nn.Linear(2, 2)
    layer.weight.requires_grad_(False)
    assert [len(g["params"]) for g in parameter_groups(layer, 0.1, ())] == [0, 1]
