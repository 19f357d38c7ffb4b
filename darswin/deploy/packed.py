"""The blocks of a stage by one operator of our own, and layers in place of others."""

import contextlib
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import handle_torch_function, has_torch_function_unary

from darswin.deploy.own import PackedBlocks
from darswin.deploy.program import Checked, Program, Weights


class OwnBlocks(PackedBlocks):
    """The blocks of a stage by one operator; weights: those of the whole model."""

    def __init__(self, blocks: Sequence[Any], weights: Weights):
        super().__init__(blocks)
        # The program of these blocks alone: a map and the position biases → the map.
        self.written = Program(weights)
        x = self.written.input(*self.map_shape)
        tables = [self.written.input(*shape) for shape in self.table_shapes]
        self.written.output(self.written.blocks(x, self, tables))

    @cached_property
    def program(self) -> Checked:
        """`written`, ready to run."""
        return self.written.checked()

    def __call__(self, x: Tensor, tables: Sequence[Tensor]) -> Tensor:
        if has_torch_function_unary(x):
            return handle_torch_function(OwnBlocks.__call__, (x,), self, x, tables)
        return self.program([x, *tables])[0]


class InPlaceOf(nn.Module):
    """A layer in place of another one, whose attributes it has for layers around it."""

    def __init__(self, module: nn.Module):
        super().__init__()
        self.module = module

    def __getattr__(self, name: str) -> Any:
        try:
            return super().__getattr__(name)
        except AttributeError:
            return getattr(super().__getattr__("module"), name)


class InFloat32(InPlaceOf):
    """Runs a module by torch in float32, also under autocast."""

    def forward(self, x: Tensor, *others: Tensor) -> Tensor:
        refuse_gradients(x)
        autocast: Any = contextlib.nullcontext()
        if torch.is_autocast_enabled("cpu"):
            autocast = torch.autocast("cpu", enabled=False)
        with autocast:
            return self.module(x.float(), *others)


def refuse_gradients(x: Tensor) -> None:
    """RuntimeError if what the network sees requires a gradient."""
    if torch.is_grad_enabled() and x.requires_grad:
        raise RuntimeError(
            "an optimized model has no gradients, but its images or its lens require one: call it "
            "under torch.no_grad(), or use the original model"
        )
