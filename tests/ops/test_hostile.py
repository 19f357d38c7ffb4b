"""Calls of the operators with unchecked arguments, without the public functions. Each call returns
or raises, and never accesses foreign memory; `make test-asan` and `make fuzz` detect accesses."""

import contextlib
import math
import tempfile
from pathlib import Path

import pytest
import torch
from cases import SMALL, raw_calls
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

ops = torch.ops.darswin
# The call that is running. After a crash, this file is the only trace of it.
LAST_CALL = Path(tempfile.gettempdir()) / "darswin_last_hostile_call.txt"

HUGE = (2**31, 2**53, 2**62, 2**63 - 1)
INTS = st.sampled_from([-(2**63), -(2**31), -1, 0, 1, 2, 3, 5, 64, *HUGE])
FLOATS = st.sampled_from([0.0, -0.0, 0.5, -1.0, 2.0, 1e308, 1e-320, math.nan, math.inf, -math.inf])
DTYPES = (
    torch.float32, torch.float64, torch.bfloat16, torch.float16, torch.uint8, torch.int64,
    torch.bool, torch.complex64,
)  # fmt: skip


def valid(name: str) -> list:
    """The arguments of a valid call of an operator."""
    if name == "_norm":
        return [torch.rand(3, 4), torch.rand(2, 4), 1e-5]
    if name == "_polar_to_image_plan":
        return valid("polar_to_image")[:7]
    public = name.removesuffix("_backward")
    case = "polar_to_image, points" if name == "polar_to_image_backward" else public
    _, arguments = raw_calls(SMALL[case]())[public != name]
    arguments = [list(a) if isinstance(a, tuple) else a for a in arguments]
    return [a.detach() if isinstance(a, Tensor) else a for a in arguments]


PUBLIC = ("polar_sample", "window_attention", "polar_to_image")
PRIVATE = ("_norm", "_polar_to_image_plan")
NAMES = [*PUBLIC, *(f"{name}_backward" for name in PUBLIC), *PRIVATE]


@st.composite
def tensors(draw, like: Tensor) -> Tensor | None:
    """A replacement for a tensor, often an invalid one."""
    if like.numel() > 10**6:
        return like
    kind = draw(st.sampled_from(
        ["dtype", "shape", "cut", "huge", "strides", "meta", "values", "grad", "none", "turned"]
    ))  # fmt: skip
    if kind == "dtype":
        return like.to(draw(st.sampled_from(DTYPES)))
    if kind == "shape":
        shape = draw(st.lists(st.sampled_from([0, 1, 2, 3, 4, 6]), max_size=6))
        return torch.rand(shape).to(like.dtype)
    if kind == "cut" and like.dim():
        axis = draw(st.integers(0, like.dim() - 1))
        return like.narrow(axis, 0, draw(st.integers(0, like.shape[axis])))
    if kind == "huge" and like.dim():
        # One number in memory, expanded to a huge size.
        axis, size = draw(st.integers(0, like.dim() - 1)), draw(st.sampled_from([2**53, 2**62]))
        shape = [size if a == axis else min(n, 3) for a, n in enumerate(like.shape)]
        if draw(st.booleans()):
            shape[(axis + 1) % like.dim()] = 0
        return like.new_ones([1] * like.dim()).expand(shape)
    if kind == "strides" and like.dim():
        first = like.narrow(0, 0, min(like.shape[0], 1))
        strides = [draw(st.sampled_from([0, 1, 2**40, 2**62])) if n == 1 else s
                   for n, s in zip(first.shape, first.stride(), strict=True)]  # fmt: skip
        return first.as_strided(first.shape, strides)
    if kind == "meta":
        return like.to("meta")
    if kind == "values" and like.is_floating_point():
        return like * draw(FLOATS)
    if kind == "grad" and like.is_floating_point():
        return like.clone().requires_grad_()
    if kind == "none":
        return None
    return like.mT if like.dim() > 1 else like


@st.composite
def hostile(draw, name: str) -> list:
    """A call with one to three of its arguments replaced."""
    arguments = valid(name)
    if draw(st.integers(0, 3)) == 0 and name.startswith("polar"):
        arguments = [a.double() if isinstance(a, Tensor) and a.dtype == torch.float32 else a
                     for a in arguments]  # fmt: skip
    for _ in range(draw(st.integers(1, 3))):
        index = draw(st.integers(0, len(arguments) - 1))
        value = arguments[index]
        if isinstance(value, Tensor):
            with contextlib.suppress(RuntimeError):  # torch itself refuses to create some tensors
                arguments[index] = draw(tensors(value))
        elif isinstance(value, bool):
            arguments[index] = not value
        elif isinstance(value, list):
            of = FLOATS if not value else INTS
            size = 3 if draw(st.booleans()) else len(value)
            mixed = st.sampled_from(value) | of if value else of
            arguments[index] = draw(st.lists(mixed, min_size=min(size, 2), max_size=size))
        elif isinstance(value, float):
            arguments[index] = draw(FLOATS)
    return arguments


def describe(value) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype}{tuple(value.shape)}/{value.stride()} on {value.device}"
    return repr(value)


@pytest.mark.parametrize("name", NAMES)
def test_valid_calls_are_valid(name):
    with torch.no_grad():
        getattr(ops, name)(*valid(name))


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=3 * settings().max_examples)
@given(data=st.data())
def test_a_hostile_call_returns_or_raises(name, data):
    arguments = data.draw(hostile(name))
    LAST_CALL.write_text(f"{name}({', '.join(map(describe, arguments))})\n")
    try:
        result = getattr(ops, name)(*arguments)
    except Exception:
        return
    for tensor in result if isinstance(result, (tuple, list)) else [result]:
        if tensor is not None and tensor.device.type == "cpu":
            tensor.double().sum().item()  # reads all of the memory
