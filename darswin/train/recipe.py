"""The optimiser, what it decays, and the learning rate over time."""

import math
from collections.abc import Iterable
from typing import Any

from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


def parameter_groups(model: nn.Module, weight_decay: float, undecayed: Iterable[str]) -> list[dict]:
    """Two groups for an optimiser: weight decay for matrices, none for vectors, biases and
    `undecayed`.

    Args:
        undecayed: names of further parameters without decay.
    """
    undecayed = set(undecayed)
    groups: dict[bool, list[nn.Parameter]] = {True: [], False: []}
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            decays = parameter.dim() > 1 and not name.endswith(".bias") and name not in undecayed
            groups[decays].append(parameter)
    return [
        {"params": groups[True], "weight_decay": weight_decay},
        {"params": groups[False], "weight_decay": 0.0},
    ]


def learning_rate(
    step: int, *, peak: float, warmup: float, final: float, warmup_steps: float, steps: int
) -> float:
    """Linear from `warmup` to `peak` over `warmup_steps`, then a cosine down to `final` at `steps`.

    The cosine counts from step 0, so that the rate falls a little where the two meet, as in the
    recipe of Swin and DarSwin.
    """
    if step < warmup_steps:
        return warmup + (peak - warmup) * step / warmup_steps
    return final + (peak - final) * (1 + math.cos(math.pi * min(step / max(steps, 1), 1))) / 2


class Schedule(LambdaLR):
    """AdamW's learning rate, each step. What a checkpoint brings back is the step alone.

    Rates and weight decay stay those that the optimizer and the schedule were made with, so that a
    run goes on with those of its options. The schedule is to be restored after the optimizer.

    Args:
        rates: of `learning_rate`, with its steps.
    """

    def __init__(self, optimizer: Optimizer, **rates: Any):
        super().__init__(optimizer, lambda step: learning_rate(step, **rates) / rates["peak"])
        optimizer.register_load_state_dict_pre_hook(_with_own_options)

    def state_dict(self) -> dict[str, Any]:
        """The step, and nothing else."""
        return {"last_epoch": self.last_epoch}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Goes on at the step, with this schedule's own rates."""
        self.last_epoch = state_dict["last_epoch"] - 1
        self._step_count = 0  # else torch takes this for a step before the optimizer's first
        self.step()


def _with_own_options(optimizer: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    theirs, own = state["param_groups"], optimizer.param_groups
    groups = [mine | {"params": group["params"]} for group, mine in zip(theirs, own, strict=True)]
    return state | {"param_groups": groups}
