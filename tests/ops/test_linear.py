"""The operators `linear` and `mlp`. They compute in float32 alone, so their gradients are compared
with those of the reference in float64, by the accuracy rule."""

import copy
from functools import partial

import pytest
import torch
import torch.nn.functional as F
from cases import (
    Case,
    assert_accurate,
    assert_equal_results,
    assert_same_bits_on_any_number_of_threads,
    elsewhere,
    raw_calls,
    results,
)
from hypothesis import given
from hypothesis import strategies as st
from torch._dynamo.testing import EagerAndRecordGraphs
from torch.func import grad

from darswin.layers.linear import Linear
from darswin.layers.transformer import Mlp
from darswin.ops import linear as operators
from darswin.ops import reference
from darswin.ops.linear import linear, mlp

RAW = torch.ops.darswin


@pytest.fixture(autouse=True)
def ours(monkeypatch):
    """On Intel's CPUs, too."""
    monkeypatch.setattr(operators, "IS_FASTER", True)


def case(name, rows, dim, width, scale=1.0):
    sizes = dict(x=(*rows, dim), weight=(width, dim), bias=(width,))
    if name == "mlp":
        sizes = dict(x=(*rows, dim), weight1=(width, dim), bias1=(width,))
        sizes |= dict(weight2=(dim + 1, width), bias2=(dim + 1,))
    if name == "no bias":
        del sizes["bias"]
    inputs = {
        key: torch.randn(size) / size[-1] ** (len(key) > 5) / 2 for key, size in sizes.items()
    }
    inputs["x"] *= scale
    return Case(mlp if name == "mlp" else linear, inputs)


every_name = pytest.mark.parametrize("name", ["linear", "no bias", "mlp"])
SMALL = dict(rows=(2, 70), dim=5, width=7)


# One row of blocks and many, whole registers and rests, one part of the depth and several, one
# group of rows and several, and parts of the rows of a long map.
@every_name
@pytest.mark.parametrize(("rows", "dim", "width"), [
    ((128,), 1, 1), ((3, 5, 9), 33, 50), ((130,), 48, 96), ((1, 1100), 16, 49), ((170,), 300, 17),
    ((2, 2100), 20, 260), ((190,), 129, 385),
])  # fmt: skip
def test_accuracy_and_threads(name, rows, dim, width):
    assert_accurate(partial(case, name, rows, dim, width))
    call = case(name, rows, dim, width)
    assert_same_bits_on_any_number_of_threads(lambda: results(call))
    if width == 50:
        for only in call.inputs:
            assert_equal_results(results(call, only=[only]), {only: results(call)[only]})


@pytest.mark.parametrize("scale", [1e-30, 30.0])
def test_accuracy_of_small_and_large_numbers(scale):
    assert_accurate(lambda: case("mlp", (128,), 24, 32, scale))


@every_name
@pytest.mark.parametrize("kind", ["gaps", "turned"])
def test_layouts_of_inputs_and_gradients(name, kind):
    call = case(name, **SMALL)
    strided = call.replace(**{key: elsewhere(t, kind) for key, t in call.inputs.items()})
    assert_equal_results(results(strided), results(call))
    leaves = [t.requires_grad_() for t in call.inputs.values()]
    out = call.run(*leaves)
    from_ones = torch.autograd.grad(out, leaves, torch.ones_like(out), retain_graph=True)
    for a, b in zip(torch.autograd.grad(out.sum(), leaves), from_ones, strict=True):
        assert torch.equal(a, b)


@given(
    rows=st.integers(0, 70), dim=st.integers(1, 70), width=st.integers(1, 70),
    value=st.sampled_from([0.0, 1e30, float("inf"), float("nan")]), place=st.integers(0),
)  # fmt: skip
def test_random_sizes_and_numbers(rows, dim, width, value, place):
    torch.manual_seed(place % 1000)
    call = case("mlp", (rows,), dim, width)
    inputs = [*call.inputs.values()]
    if rows:
        inputs[0].view(-1)[place % inputs[0].numel()] = value
    out, hidden = RAW.mlp(*inputs)
    leaves = [t.requires_grad_() for t in inputs]
    want = reference.mlp(*leaves)
    torch.testing.assert_close(out, want.detach(), rtol=1e-4, atol=1e-5, equal_nan=True)
    gradients = RAW.mlp_backward(*[t.detach() for t in inputs], hidden, torch.ones_like(out))
    wanted = torch.autograd.grad(want.sum(), leaves)
    for got, expected in zip(gradients, wanted, strict=True):
        assert got.shape == expected.shape
        if value == 0:
            torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


@every_name
def test_opcheck(name):
    (operator, arguments), (backward, of_backward) = raw_calls(case(name, **SMALL))
    for wanted in (False, True):
        given = [
            a.detach().requires_grad_(wanted) if torch.is_tensor(a) and a.requires_grad else a
            for a in arguments
        ]
        torch.library.opcheck(operator, given)
    torch.library.opcheck(backward, of_backward, test_utils=("test_schema", "test_faketensor"))


@every_name
def test_wrong_arguments_are_refused(name):
    for operator, arguments in raw_calls(case(name, **SMALL)):
        for index, value in enumerate(arguments):
            if not isinstance(value, torch.Tensor):
                continue
            wrong = [value.double(), value[..., :-1], value[None]]
            # The x of a layer may have any number of axes.
            for other in wrong[: 2 if index == 0 and "backward" not in operator.name() else 3]:
                with pytest.raises(RuntimeError):
                    operator(*arguments[:index], other, *arguments[index + 1 :])


@every_name
def test_second_derivatives_are_refused(name):
    call = case(name, **SMALL)
    leaf = call.inputs["x"].requires_grad_()
    (first,) = torch.autograd.grad(call.run(**call.inputs).square().sum(), leaf, create_graph=True)
    with pytest.raises(NotImplementedError, match="no second derivative"):
        first.sum().backward()


@pytest.mark.slow
@every_name
def test_compiled_training_has_our_products(name):
    call = case(name, **SMALL)
    expected, run, recorded = results(call), call.run, EagerAndRecordGraphs()
    for backend in (recorded, "aot_eager", "inductor"):
        torch._dynamo.reset()
        call.run = torch.compile(run, fullgraph=True, backend=backend)
        assert_equal_results(results(call), expected, 1e-6)
    assert "torch.ops.darswin." in recorded.graphs[0].code


def test_where_torch_multiplies(monkeypatch):
    monkeypatch.setattr(operators, "_LINEAR", None)
    monkeypatch.setattr(operators, "_MLP", None)
    layers, x = Mlp(12, 20), torch.randn(128, 12)
    layer = layers.fc1
    with pytest.raises(TypeError):
        layer(x)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(x).dtype == layers(x).dtype == torch.bfloat16
    double = copy.deepcopy(layer).double()
    assert double(x.double()).dtype == torch.float64
    assert layer(x[:127]).shape == (127, 20) and layers(x[:0]).shape == (0, 12)
    torch.testing.assert_close(
        grad(lambda x: layer(x).sum())(x), layer.weight.sum(0).expand(128, 12)
    )
    torch.testing.assert_close(torch.func.jvp(layer, (x,), (x,))[1], x @ layer.weight.T)
    graph = torch.export.export(layers, (x,)).graph
    assert not any("darswin" in str(node.target) for node in graph.nodes)
    monkeypatch.setattr(operators, "IS_FASTER", False)
    torch.testing.assert_close(layer(x), F.linear(x, layer.weight, layer.bias))


def test_what_an_mlp_keeps_and_who_watches_it():
    layers, x = Mlp(12, 48), torch.randn(2, 70, 12)
    saved = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: saved.append(t) or t, lambda t: t):
        layers(x).sum().backward()
    kept = sum(t.numel() for t in saved if t.dim() == 3)
    assert kept == 140 * (12 + 48)  # x, and the input of the GELU
    seen = []
    layers.fc2.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    layers(x)
    torch.testing.assert_close(seen[0], F.gelu(layers.fc1(x)))
    assert isinstance(layers.fc1, Linear)
