import torch
from torch import nn
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR

from darswin import create_model
from darswin.train.task import Schedule, parameter_groups


def rates(schedule_of, steps):
    """The learning rate of each step, of AdamW with a peak of 1e-3."""
    optimizer = torch.optim.AdamW([nn.Parameter(torch.zeros(1))], lr=1e-3)
    schedule = schedule_of(optimizer)
    found = []
    for _ in range(steps):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return found


def test_a_line_up_then_torch_s_cosine_from_step_0():
    steps, warmup = 200, 20
    ours = dict(peak=1e-3, warmup=1e-6, final=1e-5, warmup_steps=warmup, steps=steps)
    found = rates(lambda optimizer: Schedule(optimizer, **ours), steps + 10)
    line = rates(lambda optimizer: LinearLR(optimizer, 1e-3, total_iters=warmup), warmup)
    cosine = rates(lambda optimizer: CosineAnnealingLR(optimizer, steps, 1e-5), steps)
    torch.testing.assert_close(found[:warmup], line)
    torch.testing.assert_close(found[warmup:steps], cosine[warmup:])
    torch.testing.assert_close(found[steps:], [1e-5] * 10)  # the end stays
    without = rates(lambda optimizer: Schedule(optimizer, **ours | dict(warmup_steps=0)), steps)
    torch.testing.assert_close(without, cosine)


def test_matrices_decay_and_nothing_else():
    model = create_model("darswin_a_nano", num_classes=4)
    decayed, others = parameter_groups(model, 0.05, model.no_weight_decay())
    assert decayed["weight_decay"] == 0.05 and others["weight_decay"] == 0
    matrices = {id(m.weight) for m in model.modules() if isinstance(m, nn.Linear | nn.Conv2d)}
    assert {id(p) for p in decayed["params"]} == matrices
    assert len(decayed["params"]) + len(others["params"]) == len(list(model.parameters()))
    with_biases, _ = parameter_groups(model, 0.05, ())
    assert len(with_biases["params"]) > len(decayed["params"])


def test_frozen_parameters_are_left_out():
    layer = nn.Linear(2, 2)
    layer.weight.requires_grad_(False)
    assert [len(g["params"]) for g in parameter_groups(layer, 0.1, ())] == [0, 1]
