"""The choice of an operator's code, the derivatives that it lacks, and NumPy's numbers."""

import functools
import os
import sys
from unittest import mock

import numpy as np
import pytest
import torch
from cases import SMALL, attention, f32, f64
from torch.autograd import forward_ad
from torch.func import vmap

from darswin import ops
from darswin.ops import polar_sample, polar_to_image, reference, use_reference, window_attention
from darswin.ops._library import reference_in_use

image, radii, center = SMALL["polar_sample, circular"]().inputs.values()
azimuths, samples = torch.linspace(0, 6, 6), (2, 3)
qkv, bias = attention().inputs.values()
ring_centers, middle = radii[:1], center[:1]

# For each operator, a function of one tensor and this tensor.
CALLS = {
    "polar_sample": (lambda x: polar_sample(x, radii, azimuths, center, samples=samples), image),
    "polar_to_image": (
        lambda x: polar_to_image(x, ring_centers, middle, (7, 8)), torch.randn(2, 4, 8, 3),
    ),
    "window_attention": (lambda x: window_attention(x, bias, window=(2, 4)), qkv),
}  # fmt: skip
operators = pytest.mark.parametrize("name", CALLS)


def compiles(test):
    """Marks a test that compiles graphs. The test starts without compiled graphs."""
    test = pytest.mark.slow(pytest.mark.unsanitized(test))
    return pytest.mark.usefixtures("no_graphs")(test)


@pytest.fixture
def no_graphs():
    torch._dynamo.reset()


# -- which code runs -------------------------------------------------------------------------------


def test_every_compiled_operator_is_public_a_backward_or_private():
    known = {schema.name for schema in torch._C._jit_get_all_schemas()}
    names = {n.removeprefix("darswin::") for n in known if n.startswith("darswin::")}
    no_operators = {"cpu_capability", "polar_to_image_plan", "use_reference"}
    public = set(ops.__all__) - no_operators
    assert public == set(CALLS)
    known = public | {"linear", "mlp"}  # of darswin.layers
    assert {n for n in names if n[0] != "_"} == known | {f"{n}_backward" for n in known}


@operators
def test_use_reference_reaches_every_public_operator(name, monkeypatch):
    run, x = CALLS[name]
    twin = getattr(reference, name)
    spy = mock.Mock(wraps=twin)
    monkeypatch.setattr(reference, name, functools.wraps(twin)(lambda *given: spy(*given)))
    run(x)
    with use_reference(), use_reference(False):
        assert not reference_in_use()
        run(x)
    assert spy.call_count == 0
    with use_reference():
        assert reference_in_use()
        run(x)
    assert spy.call_count == 1 and not reference_in_use()


# -- derivatives -----------------------------------------------------------------------------------


def dual(run, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(run(forward_ad.make_dual(x, torch.ones_like(x)))).tangent


DERIVATIVES = {
    "forward mode": dual,
    "jvp": lambda run, x: torch.func.jvp(run, (x,), (torch.ones_like(x),))[1],
    "grad": lambda run, x: torch.func.grad(lambda x: run(x).sum())(x),
    "vjp": lambda run, x: torch.func.vjp(run, x)[1](torch.ones_like(run(x)))[0],
    "grad of vmap": lambda run, x: torch.func.grad(lambda x: vmap(run)(x).sum())(x[None]),
}
forward_modes = pytest.mark.parametrize("kind", ["forward mode", "jvp"])


@operators
@pytest.mark.parametrize("kind", DERIVATIVES)
def test_derivatives_that_there_are_not_are_refused(name, kind):
    run, x = CALLS[name]
    with pytest.raises(NotImplementedError, match=rf"{name} has no .*use_reference"):
        DERIVATIVES[kind](run, x)
    if kind != "grad of vmap":
        with use_reference():
            derivative = DERIVATIVES[kind](run, x)
        assert derivative.isfinite().all() and derivative.count_nonzero() > 0


@compiles
@pytest.mark.parametrize(
    ("kind", "fullgraph"),
    [*((kind, True) for kind in DERIVATIVES), ("forward mode", False), ("jvp", False)],
)
@operators
def test_a_compiled_function_refuses_them_too(name, kind, fullgraph):
    run, x = CALLS[name]
    compiled = torch.compile(
        lambda x: DERIVATIVES[kind](lambda x: run(x * 2), x), fullgraph=fullgraph, backend="eager"
    )
    with pytest.raises(RuntimeError, match=rf"{name} has no .*use_reference"):
        compiled(x)
    assert forward_ad._current_level == -1


@compiles
@forward_modes
@operators
def test_a_compiled_function_may_differentiate_other_tensors(name, kind):
    run, x = CALLS[name]
    compiled = torch.compile(
        lambda x, scale: DERIVATIVES[kind](lambda scale: run(x) * scale, scale),
        fullgraph=True, backend="eager",
    )  # fmt: skip
    torch.testing.assert_close(compiled(x, torch.ones(())), run(x))


@compiles
@operators
def test_a_compiled_function_may_map_over_the_operator(name):
    run, x = CALLS[name]
    images = torch.stack((x, 2 * x))
    compiled = torch.compile(vmap(run), fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(images), torch.stack([run(image) for image in images]))


@operators
def test_transforms_of_other_tensors_are_allowed(name):
    run, x = CALLS[name]
    scale = torch.ones(())
    for factor in (1, 2):  # torch.func wraps the result of x * 2, but does not differentiate it
        grad = torch.func.grad(lambda scale, f=factor: (scale * run(x * f)).sum())(scale)
        torch.testing.assert_close(grad, run(x * factor).sum())
    assert torch.equal(vmap(run)(x[None])[0], run(x))
    with torch.no_grad():
        assert torch.equal(vmap(run)(x[None])[0], run(x))
    with forward_ad.dual_level():
        assert torch.equal(run(x), run(x.clone()))


@operators
def test_backward_has_none_of_them_either(name):
    run, x = CALLS[name]
    out = run(x.clone().requires_grad_())
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match=f"{name}'s backward"):
        out.backward(forward_ad.make_dual(torch.ones_like(out), torch.ones_like(out)))


# -- only the reference has a gradient for azimuths ------------------------------------------------


def of_azimuths(jitter, dtype=f32):
    """The sampling as a function of its azimuths."""
    pixels, *lens = (t.to(dtype) for t in (image, radii, center))
    options = dict(samples=samples, jitter=jitter, seed=3)
    return lambda angles: polar_sample(pixels, lens[0], angles, lens[1], **options)


def test_azimuths_that_require_a_gradient_are_refused():
    run, wanted = of_azimuths(0.5), azimuths.clone().requires_grad_()
    with pytest.raises(NotImplementedError, match="azimuths require a gradient"):
        run(wanted)
    with torch.no_grad():
        assert torch.equal(run(wanted), run(azimuths))
    with use_reference():
        run = of_azimuths(0.5, f64)
        assert torch.autograd.gradcheck(run, azimuths.double().requires_grad_())


@compiles
def test_a_compiled_function_refuses_azimuths_that_require_a_gradient():
    compiled = torch.compile(of_azimuths(0.5), backend="eager")
    with pytest.raises(NotImplementedError, match="azimuths require a gradient"):
        compiled(azimuths.clone().requires_grad_())


# -- small calls -----------------------------------------------------------------------------------


@pytest.mark.parametrize("recording", [False, True])
@operators
def test_a_call_takes_few_python_calls(name, recording):
    """The checks that explain wrong arguments run only after the operator has refused them."""
    run, x = CALLS[name]
    x = x.clone().requires_grad_(recording)
    calls = []

    def count(frame, event, argument):
        if event == "call" and f"{os.sep}darswin{os.sep}ops{os.sep}" in frame.f_code.co_filename:
            calls.append(frame.f_code.co_name)

    run(x)
    sys.setprofile(count)
    try:
        run(x)
    finally:
        sys.setprofile(None)
    assert len(calls) <= (10 if recording else 7), calls
    assert "check_tensor" not in calls


@pytest.mark.filterwarnings("ignore")  # torch.jit is deprecated, and warns about every shape
@operators
def test_the_gradient_is_recorded_by_the_operator_itself_in_a_trace(name):
    run, x = CALLS[name]
    graph = torch.jit.trace(run, x.clone().requires_grad_(), check_trace=False).graph
    assert f"darswin::{name}" in str(graph) and "PythonOp" not in str(graph)


# -- graphs, and NumPy numbers ---------------------------------------------------------------------


@compiles
@pytest.mark.filterwarnings("ignore")  # torch.jit is deprecated, and warns about every shape
@operators
def test_jit_trace(name):
    run, x = CALLS[name]
    traced = torch.jit.trace(run, x)
    other = torch.randn_like(x)
    assert torch.equal(traced(other), run(other))


@compiles
@operators
def test_a_graph_has_nothing_that_dynamo_of_torch_2_10_cannot_trace(name, monkeypatch):
    monkeypatch.setattr(
        torch.amp, "is_autocast_available", torch.compiler.disable(torch.amp.is_autocast_available)
    )
    run, x = CALLS[name]
    compiled = torch.compile(run, fullgraph=True, backend="eager")
    assert torch.equal(compiled(x), run(x))


def test_numpy_numbers_are_taken():
    one, two, three, four = np.int64(1), np.int32(2), np.int16(3), np.uint8(4)
    frames = torch.randint(256, (2, 7, 8, 3), dtype=torch.uint8)

    def run(pair, jitter, seed, mean):
        lens, options = (radii, azimuths, center), dict(jitter=jitter, seed=seed, mean=mean)
        return polar_sample(frames, *lens, samples=pair, **options)

    expected = run((2, 3), 0.5, 4, 0.5)
    assert torch.equal(run((two, three), np.float32(0.5), four, np.float32(0.5)), expected)
    expected = window_attention(qkv, bias, window=(2, 4), shift=(1, 2))
    assert torch.equal(window_attention(qkv, bias, window=(two, four), shift=(one, two)), expected)
