"""What the operators share: which of two runs, autocast, and the derivatives that there are not."""

import functools
import inspect
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad
from torch.func import vmap

from darswin import ops
from darswin.layers.polar import PolarGrid, PolarSample
from darswin.ops import (
    polar_embed,
    polar_sample,
    polar_to_image,
    reference,
    use_reference,
    window_attention,
)
from darswin.ops._inference import add_norm_, transpose_sum

image, radii = torch.randn(1, 3, 8, 8), torch.linspace(0.5, 3, 4)[None]
azimuths, center = torch.linspace(0, 6, 8), torch.tensor([[3.5, 3.5]])
qkv, bias = torch.randn(1, 2, 4, 3, 1, 4), torch.randn(1, 1, 1, 7)
weight = torch.randn(5, 12)

# A function of one tensor for each operator, and the tensor.
CALLS = {
    "polar_sample": (lambda x: polar_sample(x, radii, azimuths, center, samples=(2, 2)), image),
    "polar_embed": (
        lambda x: polar_embed(image, radii, azimuths, center, x, samples=(2, 2)), weight,
    ),
    "polar_to_image": (
        lambda x: polar_to_image(x, radii, center, (8, 8)), torch.randn(1, 4, 8, 3),
    ),
    "window_attention": (lambda x: window_attention(x, bias, window=(1, 4)), qkv),
}  # fmt: skip
operators = pytest.mark.parametrize("name", CALLS)


def dual(run, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(run(forward_ad.make_dual(x, torch.ones_like(x)))).tangent


def schemas():
    """Name → schema of every compiled operator."""
    names = {s.name for s in torch._C._jit_get_all_schemas() if s.name.startswith("darswin::")}
    operators = {name.removeprefix("darswin::") for name in names}
    return {name: getattr(torch.ops.darswin, name).default._schema for name in sorted(operators)}


def test_every_compiled_operator_is_public_a_backward_or_private():
    public = {name for name in schemas() if not name.startswith("_") and "_backward" not in name}
    switches = {"cpu_capability", "reference_in_use", "use_reference"}
    assert public == set(ops.__all__) - switches == set(CALLS)
    backward = {name for name in schemas() if name.endswith("_backward")}
    assert backward == {f"{name}_backward" for name in public}


@operators
def test_a_public_operator_has_a_twin_with_its_parameters_and_a_test_against_it(name):
    names = []
    for parameter in inspect.signature(getattr(reference, name)).parameters.values():
        fields = getattr(parameter.annotation, "_fields", (parameter.name,))
        names.extend(fields)
    assert names == [argument.name for argument in schemas()[name].arguments]
    tests = Path(__file__).with_name(f"test_{name}.py").read_text()
    assert "assert_accurate(" in tests and "opcheck(" in tests


@operators
def test_use_reference_reaches_every_public_operator(name, monkeypatch):
    run, x = CALLS[name]
    calls, twin = [], getattr(reference, name)

    @functools.wraps(twin)
    def spy(*arguments):
        calls.append(arguments)
        return twin(*arguments)

    monkeypatch.setattr(reference, name, spy)
    run(x)
    assert not calls
    with use_reference():
        run(x)
    assert len(calls) == 1


DERIVATIVES = {
    "forward mode": dual,
    "jvp": lambda run, x: torch.func.jvp(run, (x,), (torch.ones_like(x),))[1],
    "grad": lambda run, x: torch.func.grad(lambda x: run(x).sum())(x),
    "vjp": lambda run, x: torch.func.vjp(run, x)[1](torch.ones_like(run(x)))[0],
    "grad of vmap": lambda run, x: torch.func.grad(lambda x: vmap(run)(x).sum())(x[None]),
}


@operators
@pytest.mark.parametrize("kind", DERIVATIVES)
def test_derivatives_that_there_are_not_are_refused(name, kind):
    run, x = CALLS[name]
    with pytest.raises(NotImplementedError, match=rf"{name} has no .*use_reference"):
        DERIVATIVES[kind](run, x)


@pytest.mark.unsanitized
@pytest.mark.parametrize("fullgraph", [False, True])
@pytest.mark.parametrize("kind", ["forward mode", "jvp"])
@operators
def test_a_compiled_function_refuses_forward_mode(name, kind, fullgraph):
    torch._dynamo.reset()
    run, x = CALLS[name]
    compiled = torch.compile(
        lambda x: DERIVATIVES[kind](lambda x: run(x * 2), x), fullgraph=fullgraph, backend="eager"
    )
    with pytest.raises(RuntimeError, match=rf"{name} has no .*use_reference"):
        compiled(x)
    assert forward_ad._current_level == -1


@pytest.mark.unsanitized
@pytest.mark.parametrize("kind", ["grad", "vjp", "grad of vmap"])
@operators
def test_a_compiled_function_fails_with_other_derivatives(name, kind):
    torch._dynamo.reset()
    run, x = CALLS[name]
    with pytest.raises(RuntimeError):
        torch.compile(lambda x: DERIVATIVES[kind](run, x), backend="eager")(x)


@pytest.mark.unsanitized
@pytest.mark.parametrize("kind", ["forward mode", "jvp"])
@operators
def test_a_compiled_function_may_differentiate_other_tensors(name, kind):
    torch._dynamo.reset()
    run, x = CALLS[name]
    compiled = torch.compile(
        lambda x, scale: DERIVATIVES[kind](lambda scale: run(x) * scale, scale),
        fullgraph=True, backend="eager",
    )  # fmt: skip
    torch.testing.assert_close(compiled(x, torch.ones(())), run(x))


@pytest.mark.unsanitized
@operators
def test_a_compiled_function_may_map_over_the_operator(name):
    torch._dynamo.reset()
    run, x = CALLS[name]
    images = torch.stack((x, 2 * x))
    compiled = torch.compile(vmap(run), fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(images), torch.stack([run(image) for image in images]))


@pytest.mark.unsanitized
@operators
def test_one_graph_for_inference_and_one_for_training(name):
    from torch._dynamo.testing import CompileCounter

    torch._dynamo.reset()
    counter = CompileCounter()
    run, x = CALLS[name]
    compiled = torch.compile(run, fullgraph=True, backend=counter)
    for inputs in (x, x.clone().requires_grad_()):
        for _ in range(3):
            compiled(inputs)
    assert counter.frame_count == 2


AZIMUTHS = {
    "polar_sample": lambda azimuths: polar_sample(
        image, radii, azimuths, center, samples=(2, 2), jitter=0.5, seed=3
    ),
    "polar_embed": lambda azimuths: polar_embed(
        image, radii, azimuths, center, weight, samples=(2, 2)
    ),
    "PolarSample": lambda azimuths: polar_sample(
        **PolarSample(2, 4, (2, 2)).arguments(image, PolarGrid(radii, azimuths, center, radii))
    ),
}
takes_azimuths = pytest.mark.parametrize("name", AZIMUTHS)


@takes_azimuths
def test_azimuths_that_require_a_gradient_are_refused(name):
    run, wanted = AZIMUTHS[name], azimuths.clone().requires_grad_()
    with pytest.raises(NotImplementedError, match="azimuths require a gradient"):
        run(wanted)
    with torch.no_grad():
        assert torch.equal(run(wanted), run(azimuths))


@pytest.mark.unsanitized
@takes_azimuths
def test_a_compiled_function_refuses_azimuths_that_require_a_gradient(name):
    torch._dynamo.reset()
    compiled = torch.compile(AZIMUTHS[name], backend="eager")
    with pytest.raises(NotImplementedError, match="azimuths require a gradient"):
        compiled(azimuths.clone().requires_grad_())


@pytest.mark.parametrize("jitter", [0.0, 0.5])
@pytest.mark.parametrize("operator", [polar_sample, polar_embed])
def test_the_reference_differentiates_azimuths(operator, jitter):
    images, distances, middle, rows = (tensor.double() for tensor in (image, radii, center, weight))
    layer = (rows,) if operator is polar_embed else ()

    def run(angles):
        return operator(
            images, distances, angles, middle, *layer, samples=(2, 2), jitter=jitter, seed=3
        )

    with use_reference():
        assert torch.autograd.gradcheck(run, azimuths.double().requires_grad_())


@operators
def test_backward_has_none_of_them_either(name):
    run, x = CALLS[name]
    out = run(x.clone().requires_grad_())
    with forward_ad.dual_level(), pytest.raises(NotImplementedError, match=f"{name}'s backward"):
        out.backward(forward_ad.make_dual(torch.ones_like(out), torch.ones_like(out)))


@pytest.mark.parametrize("kind", ["forward mode", "jvp", "grad"])
def test_operators_without_a_reference_refuse_them_too(kind):
    ones, zeros = torch.ones(4), torch.zeros(4)
    with pytest.raises(NotImplementedError, match="transpose_sum has no"):
        DERIVATIVES[kind](lambda x: transpose_sum(x)[1], torch.rand(3, 4))
    with pytest.raises(NotImplementedError, match="add_norm_ has no"):
        DERIVATIVES[kind](lambda x: add_norm_(x * 1, x * 2, ones, zeros, 1e-5), torch.rand(3, 4))


@pytest.mark.parametrize("kind", ["forward mode", "jvp", "grad", "vjp"])
@operators
def test_the_reference_has_them(name, kind):
    run, x = CALLS[name]
    with use_reference():
        derivative = DERIVATIVES[kind](run, x)
    assert derivative.isfinite().all() and derivative.count_nonzero() > 0


@operators
def test_transforms_of_other_tensors_are_none_of_their_business(name):
    run, x = CALLS[name]
    scale = torch.ones(())
    grad = torch.func.grad(lambda scale: (scale * run(x)).sum())(scale)
    torch.testing.assert_close(grad, run(x).sum())
    assert vmap(run)(x[None]).shape == run(x)[None].shape
    with forward_ad.dual_level():
        assert torch.equal(run(x), run(x.clone()))


@pytest.mark.unsanitized
@pytest.mark.filterwarnings("ignore")  # torch.jit is deprecated, and warns of every shape
@operators
def test_jit_trace(name):
    run, x = CALLS[name]
    traced = torch.jit.trace(run, x)
    other = torch.randn_like(x)
    assert torch.equal(traced(other), run(other))


@pytest.mark.unsanitized
@operators
def test_a_graph_asks_nothing_that_dynamo_of_torch_2_10_cannot_trace(name, monkeypatch):
    monkeypatch.setattr(
        torch.amp, "is_autocast_available", torch.compiler.disable(torch.amp.is_autocast_available)
    )
    torch._dynamo.reset()
    run, x = CALLS[name]
    compiled = torch.compile(run, fullgraph=True, backend="eager")
    assert torch.equal(compiled(x), run(x))


@pytest.mark.unsanitized
def test_one_graph_for_any_jitter():
    from torch._dynamo.testing import CompileCounter

    torch._dynamo.reset()
    counter = CompileCounter()

    @torch.compile(fullgraph=True, backend=counter)
    def run(jitter):
        seed = torch.tensor(1)
        return polar_sample(
            image, radii, azimuths, center, samples=(2, 2), jitter=jitter, seed=seed
        )

    for jitter in (0.1, 0.2, 0.3, 0.4, 0.5):
        expected = polar_sample(
            image, radii, azimuths, center, samples=(2, 2), jitter=jitter, seed=1
        )
        assert torch.equal(run(jitter), expected)
    assert counter.frame_count == 2  # the first one keeps its value, as Dynamo does with any float


def test_numpy_numbers_are_taken():
    one, two, four = np.int64(1), np.int32(2), np.uint8(4)
    expected = polar_sample(image, radii, azimuths, center, samples=(2, 2), jitter=0.5, seed=4)
    got = polar_sample(image, radii, azimuths, center, samples=(two, two), jitter=np.float32(0.5),
                       seed=four)  # fmt: skip
    assert torch.equal(got, expected)
    expected = window_attention(qkv, bias, window=(1, 4), shift=(1, 2))
    assert torch.equal(window_attention(qkv, bias, window=(one, four), shift=(one, two)), expected)
    layer = PolarSample(four, np.int64(8), samples=(two, one), jitter=np.float64(0.5))
    assert repr(layer.spec).startswith("PolarGridSpec(rings=4, sectors=8, samples=(2, 1),")
    frames = torch.randint(256, (1, 8, 8, 3), dtype=torch.uint8)
    means = [np.float32(0.5), 0.5]
    first, second = (
        polar_sample(frames, radii, azimuths, center, samples=(2, 2), mean=mean) for mean in means
    )
    assert torch.equal(first, second)


@pytest.mark.parametrize("bad", [2.0, np.float64(2), True, torch.tensor(2), "2", None])
def test_what_is_no_int_is_no_size(bad):
    with pytest.raises(TypeError, match="samples must be a pair of ints"):
        polar_sample(image, radii, azimuths, center, samples=(bad, 2))


@pytest.mark.parametrize("bad", [2.0, np.float64(2), True, "2", None])
def test_what_is_no_int_is_no_seed(bad):
    with pytest.raises(TypeError, match="seed must be an int"):
        polar_sample(image, radii, azimuths, center, samples=(2, 2), jitter=0.5, seed=bad)
