"""The optimiser, what it decays, and the learning rate over time."""

import math
from collections.abc import Iterable

from torch import nn


def parameter_groups(model: nn.Module, weight_decay: float, undecayed: Iterable[str]) -> list[dict]:
    """Two groups for an optimiser: weight decay for matrices, none for vectors, biases and
    `undecayed`.

    Args:
        undecayed: names of further parameters without decay.
    """
    undecayed = set(undecayed)
    groups = {True: [], False: []}
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
