"""Which code an operator runs, the derivatives that it lacks, and numbers of NumPy."""

import contextlib
import functools
import inspect
import subprocess
import sys
from unittest import mock

import numpy as np
import pytest
import torch
from torch._subclasses import FakeTensorMode
from torch.autograd import forward_ad
from torch.func import vmap

from darswin import ops
from darswin.ops import (
    _library,
    polar_embed,
    polar_sample,
    polar_to_image,
    reference,
    reference_in_use,
    triton,
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


def compiles(test):
    """The mark of a test that compiles graphs; it starts without any."""
    test = pytest.mark.slow(pytest.mark.unsanitized(test))
    return pytest.mark.usefixtures("no_graphs")(test)


@pytest.fixture
def no_graphs():
    torch._dynamo.reset()


# -- which code runs -------------------------------------------------------------------------------


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
def test_a_public_operator_has_a_twin_with_its_parameters(name):
    names = []
    for parameter in inspect.signature(getattr(reference, name)).parameters.values():
        names.extend(getattr(parameter.annotation, "_fields", (parameter.name,)))
    assert names == [argument.name for argument in schemas()[name].arguments]


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


def on_kernels(run, installed=True, capability=(8, 0)):
    """Whether a call on a CUDA device runs a kernel, on fake tensors."""
    with (
        mock.patch.object(triton, "INSTALLED", installed),
        mock.patch.object(torch.cuda, "get_device_capability", return_value=capability),
        mock.patch.object(_library, "call") as call,
        contextlib.ExitStack() as stack,
        FakeTensorMode(),
    ):
        twins = [
            stack.enter_context(mock.patch.object(reference, name, autospec=True)) for name in CALLS
        ]
        run()
    assert call.called != any(twin.called for twin in twins)
    return call.called


def on_cuda(*shape, dtype=torch.float32):
    return torch.empty(shape, device="cuda", dtype=dtype)


def attend(window=(1, 16), head_dim=32, dtype=torch.float32):
    real = dtype if dtype == torch.float64 else torch.float32
    table = on_cuda(1, 2, 2 * window[0] - 1, 2 * window[1] - 1, dtype=real)
    window_attention(on_cuda(2, *window, 3, 2, head_dim, dtype=dtype), table, window=window)


def sample(embed=False, dtype=torch.float32, channels=3, size=8):
    real = dtype if dtype == torch.float64 else torch.float32
    pixels = on_cuda(2, channels, size, size, dtype=dtype)
    lens = [on_cuda(*shape, dtype=real) for shape in ((1, 4), (8,), (1, 2))]
    if embed:
        lens.append(on_cuda(5, 4 * channels, dtype=real))
    options = dict(samples=(2, 2), jitter=1.0, channels_last=False)
    (polar_embed if embed else polar_sample)(pixels, *lens, **options)


def bring_back(size=8, dtype=torch.float32):
    real = dtype if dtype == torch.float64 else torch.float32
    lens = on_cuda(1, 4, dtype=real), on_cuda(1, 2, dtype=real)
    polar_to_image(on_cuda(2, 4, 8, 3, dtype=dtype), *lens, (size, size))


BY_KERNELS = [
    (attend, dict()), (attend, dict(dtype=torch.bfloat16)), (attend, dict(dtype=torch.float16)),
    (attend, dict(window=(8, 8))), (attend, dict(window=(1, 1), head_dim=1)),
    (attend, dict(window=(2, 16), head_dim=64)),
    *((sample, dict(embed=embed) | options) for embed in (False, True) for options in (
        dict(), dict(dtype=torch.bfloat16), dict(dtype=torch.uint8), dict(channels=300),
        dict(dtype=torch.uint8, channels=16))),
    (bring_back, dict()), (bring_back, dict(dtype=torch.float16)),
]  # fmt: skip
BY_THE_REFERENCE = [
    (attend, dict(window=(5, 13), head_dim=16)), (attend, dict(window=(8, 8), head_dim=33)),
    (attend, dict(window=(1, 1), head_dim=65)), (attend, dict(dtype=torch.float64)),
    *((sample, dict(embed=embed) | options) for embed in (False, True) for options in (
        dict(dtype=torch.uint8, channels=17), dict(dtype=torch.float64), dict(size=50_000))),
    (bring_back, dict(size=50_000)), (bring_back, dict(dtype=torch.float64)),
]  # fmt: skip


@pytest.mark.parametrize(("run", "options"), BY_KERNELS)
def test_a_cuda_device_runs_the_kernels(run, options):
    assert on_kernels(lambda: run(**options))
    if options.get("dtype") == torch.float16:
        return
    assert not on_kernels(lambda: run(**options), installed=False)
    assert not on_kernels(lambda: run(**options), capability=(7, 5))
    with use_reference():
        assert not on_kernels(lambda: run(**options))
    with mock.patch.object(torch.compiler, "is_exporting", return_value=True):
        assert not on_kernels(lambda: run(**options))  # an exported graph runs without this package


@pytest.mark.parametrize(("run", "options"), BY_THE_REFERENCE)
def test_the_reference_runs_what_the_kernels_do_not_take(run, options):
    assert not on_kernels(lambda: run(**options))


@pytest.mark.parametrize("run", [attend, bring_back])
def test_without_kernels_there_is_no_float16(run):
    with pytest.raises(TypeError, match=r"got torch.float16"):
        on_kernels(lambda: run(dtype=torch.float16), installed=False)


@pytest.mark.slow
def test_the_kernels_are_imported_by_the_first_call_alone():
    code = (
        "import sys, torch, darswin\n"
        "from darswin.ops import triton\n"
        "assert not any(name.startswith('darswin.ops.triton.') for name in sys.modules)\n"
        "for name in triton.LAUNCHERS:\n"
        "    there = torch._C._dispatch_has_kernel_for_dispatch_key(f'darswin::{name}', 'CUDA')\n"
        "    assert there == triton.INSTALLED\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


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
@pytest.mark.parametrize("fullgraph", [False, True])
@forward_modes
@operators
def test_a_compiled_function_refuses_forward_mode(name, kind, fullgraph):
    run, x = CALLS[name]
    compiled = torch.compile(
        lambda x: DERIVATIVES[kind](lambda x: run(x * 2), x), fullgraph=fullgraph, backend="eager"
    )
    with pytest.raises(RuntimeError, match=rf"{name} has no .*use_reference"):
        compiled(x)
    assert forward_ad._current_level == -1


@compiles
@pytest.mark.parametrize("kind", ["grad", "vjp", "grad of vmap"])
@operators
def test_a_compiled_function_fails_with_other_derivatives(name, kind):
    run, x = CALLS[name]
    with pytest.raises(RuntimeError):
        torch.compile(lambda x: DERIVATIVES[kind](run, x), backend="eager")(x)


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
    grad = torch.func.grad(lambda scale: (scale * run(x)).sum())(scale)
    torch.testing.assert_close(grad, run(x).sum())
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


@pytest.mark.parametrize("kind", ["forward mode", "jvp", "grad"])
def test_operators_without_a_reference_refuse_them_too(kind):
    ones, zeros = torch.ones(4), torch.zeros(4)
    with pytest.raises(NotImplementedError, match="transpose_sum has no"):
        DERIVATIVES[kind](lambda x: transpose_sum(x)[1], torch.rand(3, 4))
    with pytest.raises(NotImplementedError, match="add_norm_ has no"):
        DERIVATIVES[kind](lambda x: add_norm_(x * 1, x * 2, ones, zeros, 1e-5), torch.rand(3, 4))


# -- azimuths have a gradient in the reference alone -----------------------------------------------


def of_azimuths(embed, jitter, dtype=torch.float32):
    """The sampling as a function of its azimuths."""
    given = [t.to(dtype) for t in (image, radii, center, weight)]
    layer = given[3:] if embed else []
    operator = polar_embed if embed else polar_sample
    return lambda angles: operator(
        *given[:2], angles, given[2], *layer, samples=(2, 2), jitter=jitter, seed=3
    )


@pytest.mark.parametrize("embed", [False, True])
def test_azimuths_that_require_a_gradient_are_refused(embed):
    run, wanted = of_azimuths(embed, 0.5), azimuths.clone().requires_grad_()
    with pytest.raises(NotImplementedError, match="azimuths require a gradient"):
        run(wanted)
    with torch.no_grad():
        assert torch.equal(run(wanted), run(azimuths))


@compiles
@pytest.mark.parametrize("embed", [False, True])
def test_a_compiled_function_refuses_azimuths_that_require_a_gradient(embed):
    compiled = torch.compile(of_azimuths(embed, 0.5), backend="eager")
    with pytest.raises(NotImplementedError, match="azimuths require a gradient"):
        compiled(azimuths.clone().requires_grad_())


@pytest.mark.parametrize("jitter", [0.0, 0.5])
@pytest.mark.parametrize("embed", [False, True])
def test_the_reference_differentiates_azimuths(embed, jitter):
    run = of_azimuths(embed, jitter, torch.float64)
    with use_reference():
        assert torch.autograd.gradcheck(run, azimuths.double().requires_grad_())


# -- graphs, and numbers of NumPy ------------------------------------------------------------------


@compiles
@pytest.mark.filterwarnings("ignore")  # torch.jit is deprecated, and warns of every shape
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
    one, two, four = np.int64(1), np.int32(2), np.uint8(4)
    frames = torch.randint(256, (1, 8, 8, 3), dtype=torch.uint8)

    def run(pair, jitter, seed, mean):
        return polar_sample(
            frames, radii, azimuths, center, samples=pair, jitter=jitter, seed=seed, mean=mean
        )

    expected = run((2, 2), 0.5, 4, 0.5)
    assert torch.equal(run((two, two), np.float32(0.5), four, np.float32(0.5)), expected)
    expected = window_attention(qkv, bias, window=(1, 4), shift=(1, 2))
    assert torch.equal(window_attention(qkv, bias, window=(one, four), shift=(one, two)), expected)
