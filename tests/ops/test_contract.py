"""The contract of the public operators: properties that hold for every operator.

test_properties.py has random arguments, test_library.py the derivatives that the operators lack,
and test_errors.py wrong arguments."""

import pytest
import torch
from cases import (
    CASES,
    SMALL,
    assert_accurate,
    assert_equal_results,
    assert_rounded_once,
    assert_same_bits_on_any_number_of_threads,
    bf16,
    draws_for,
    elsewhere,
    f32,
    f64,
    raw_calls,
    results,
)
from torch._dynamo.testing import CompileCounterWithBackend

from darswin.ops import use_reference

every_case = pytest.mark.parametrize("case", CASES, ids=": ".join)
small_cases = pytest.mark.parametrize("name", SMALL)
# The reference is PyTorch alone.
references = pytest.mark.parametrize(
    "reference", [False, pytest.param(True, marks=pytest.mark.unsanitized)]
)


# -- values, on every path of the kernels ----------------------------------------------------------


@every_case
def test_equals_the_reference_in_float64(case):
    made = CASES[case](dtype=f64)
    expected = results(made, is_reference=True, masked=False)
    assert_equal_results(results(made, masked=False), expected, 1e-11)


@pytest.mark.unsanitized  # it calls what the next test calls
@every_case
def test_accuracy_rule(case):
    assert_accurate(CASES[case], draws_for(case))


@every_case
def test_same_bits_for_any_number_of_threads(case):
    every = CASES[case]()
    first = next(iter(every.inputs))
    # One image is cut into bands, one per thread. Here gradients need no mask where they jump.
    for made in (every, every.first_image())[: 1 + (len(every.inputs[first]) > 1)]:
        # The gradient of only the first input takes another path through the kernels.
        for only in ([], [first]):
            assert_same_bits_on_any_number_of_threads(
                lambda c=made, o=only: results(c, only=o, masked=False)
            )


@every_case
def test_bfloat16_is_float32_rounded_once(case):
    # The sums in attention may run in another order.
    narrow, ours, expected = assert_rounded_once(CASES[case](), case[0] != "window_attention")
    # The incoming gradient is rounded to bfloat16 as well.
    for name, tensor in narrow.inputs.items():
        want = expected[name]
        size = want.abs().max().item() if want.numel() else 0.0
        assert ours[name].dtype == tensor.dtype
        torch.testing.assert_close(ours[name].float(), want, rtol=0.02, atol=0.02 * size)


EXTREME = [("window_attention", "DarSwin-RA"), ("polar_sample", "cells, circular")]


@pytest.mark.parametrize("case", EXTREME, ids=": ".join)
@pytest.mark.parametrize("scale", [1e-30, 1e-20, 30.0, 1e30])
def test_accuracy_rule_at_extreme_values(case, scale):
    def scaled():
        made = CASES[case]()
        name, values = next(iter(made.inputs.items()))
        # Logits of 1e60 would be infinite. A scale of 30 is enough for a sharp softmax.
        return made.replace(**{name: values * (min(scale, 30.0) if name == "qkv" else scale)})

    assert_accurate(scaled)


# -- arguments in memory ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["gaps", "turned"])
@small_cases
def test_strides_do_not_matter(name, kind):
    made = SMALL[name](dtype=f64)
    strided = made.replace(**{name: elsewhere(t, kind) for name, t in made.inputs.items()})
    if "azimuths" in made.settings:
        made.settings["azimuths"] = elsewhere(made.settings["azimuths"], "gaps")
    assert any(not t.is_contiguous() for t in strided.inputs.values())
    assert_equal_results(results(strided), results(made), 1e-12)
    assert torch.equal(results(strided)["out"], results(made)["out"])


@small_cases
def test_gradients_may_arrive_expanded(name):
    made = SMALL[name]()
    leaves = {name: t.requires_grad_() for name, t in made.inputs.items()}
    # The gradient of a sum arrives with stride 0.
    from_sum = torch.autograd.grad(made.run(**leaves).sum(), leaves.values())
    out = made.run(**leaves)
    from_ones = torch.autograd.grad(out, leaves.values(), torch.ones_like(out))
    assert all(torch.equal(a, b) for a, b in zip(from_sum, from_ones, strict=True))


@small_cases
def test_only_the_gradients_asked_for(name):
    made = SMALL[name]()
    every = results(made)
    for one in made.inputs:
        assert_equal_results(results(made, only=[one]), {one: every[one]})


# -- torch's own machinery -------------------------------------------------------------------------


@references
@small_cases
def test_gradcheck(name, reference):
    made = SMALL[name](dtype=f64)
    leaves = [t.requires_grad_() for t in made.inputs.values()]
    with use_reference(reference):
        assert torch.autograd.gradcheck(
            lambda *tensors: made.run(**dict(zip(made.inputs, tensors, strict=True))), leaves
        )


@pytest.mark.unsanitized
@pytest.mark.parametrize("dtype", [f32, bf16])
@small_cases
def test_opcheck(name, dtype):
    made = SMALL[name]()
    first = next(iter(made.inputs))
    made = made.replace(**{first: made.inputs[first].to(dtype)})
    (operator, arguments), (backward, of_backward) = raw_calls(made)
    assert sum(torch.is_tensor(a) and a.requires_grad for a in arguments) == len(made.inputs)
    for wanted in (False, True):
        given = [
            a.detach().requires_grad_(wanted) if torch.is_tensor(a) and a.requires_grad else a
            for a in arguments
        ]
        torch.library.opcheck(operator, given)
    names = [argument.name for argument in backward._schema.arguments]
    bools = range(names.index("grad_out") + 1, len(names))
    for one in (None, *bools):  # all gradients, then each group alone
        given = [one in (None, k) if k in bools else a for k, a in enumerate(of_backward)]
        found = backward(*given)
        fake = backward(*(a.to("meta") if isinstance(a, torch.Tensor) else a for a in given))
        assert [(t.shape, t.dtype) for t in found] == [(t.shape, t.dtype) for t in fake]
        if sum(t.numel() == 0 for t in found) < 2:  # opcheck takes two empty tensors for one
            checks = ("test_schema", "test_faketensor")
            torch.library.opcheck(backward, given, test_utils=checks)


@small_cases
def test_no_second_derivative(name):
    made = SMALL[name]()
    leaf = next(iter(made.inputs.values())).requires_grad_()
    for reference in (True, False):
        with use_reference(reference):
            out = made.run(**made.inputs)
        (grad,) = torch.autograd.grad(out.square().sum(), leaf, create_graph=True)
        if reference:
            grad.sum().backward()
            continue
        with pytest.raises(NotImplementedError, match="no second derivative"):
            grad.sum().backward()


@pytest.mark.slow
@pytest.mark.unsanitized
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
@small_cases
def test_compile_fullgraph(name, backend):
    torch._dynamo.reset()
    made, counter = SMALL[name](), CompileCounterWithBackend(backend)
    run, expected = made.run, results(made)
    made.run = torch.compile(
        lambda **inputs: run(**{n: t * 1 for n, t in inputs.items()}) * 1,
        fullgraph=True, backend=counter,
    )  # fmt: skip
    for _ in range(2):  # one graph for training, and one for inference
        assert_equal_results(results(made), expected, 1e-5)
        torch.testing.assert_close(made.run(**made.inputs), expected["out"], rtol=1e-5, atol=1e-5)
    assert counter.frame_count == 2


@pytest.mark.slow
@pytest.mark.unsanitized
@small_cases
def test_compiles_for_any_batch(name):
    torch._dynamo.reset()
    made = SMALL[name]()
    compiled = torch.compile(made.run, fullgraph=True, dynamic=True, backend="aot_eager")
    images = ("image", "qkv", "x")
    for count in (1, 2):
        many = {n: t.repeat(count, *[1] * (t.dim() - 1)) if n in images else t[:1]
                if n not in ("weight", "bias") else t for n, t in made.inputs.items()}  # fmt: skip
        if "qkv" in many:
            many["bias"] = made.inputs["bias"][:1]
        assert torch.equal(compiled(**many), made.run(**many))


@pytest.mark.slow
@pytest.mark.unsanitized
@small_cases
def test_export(name):
    class Module(torch.nn.Module):
        def forward(self, inputs):
            return made.run(**inputs)

    made = SMALL[name]()
    first = next(iter(made.inputs))
    program = torch.export.export(Module(), (made.inputs,))
    other = {n: torch.rand_like(t) if n == first else t for n, t in made.inputs.items()}
    assert torch.equal(program.module()(other), made.run(**other))


@pytest.mark.unsanitized
@every_case
def test_the_reference_in_graphs_for_other_runtimes(case, monkeypatch):
    """They have a fast operator that samples, whose coordinates are rounded between -1 and 1."""
    made, calls = CASES[case](), []
    with torch.no_grad(), use_reference():
        expected = made.run(**made.inputs)
        grid_sample = torch.nn.functional.grid_sample
        monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
        monkeypatch.setattr(torch.nn.functional, "grid_sample",
                            lambda *a, **k: (calls.append(a), grid_sample(*a, **k))[1])  # fmt: skip
        found = made.run(**made.inputs)
    first = next(iter(made.inputs.values()))
    sides = {"image": first.shape[2:], "x": first.shape[1:3]}.get(next(iter(made.inputs)), (0,))
    odd = "x" in made.inputs and first.shape[2] % 2
    assert len(calls) == (min(sides) > 0 and max(sides) <= 256 and not odd)
    assert_equal_results(dict(out=found), dict(out=expected), 1e-5)


def on_meta(made):
    """The case on another device."""
    made = made.to(torch.device("meta"))
    if "azimuths" in made.settings:
        made.settings["azimuths"] = made.settings["azimuths"].to("meta")
    return made


@small_cases
def test_other_devices_run_the_reference(name):
    made = SMALL[name]()
    out, there = made.run(**made.inputs), on_meta(made)
    found = there.run(**{n: t.requires_grad_() for n, t in there.inputs.items()})
    assert found.shape == out.shape and found.dtype == out.dtype and found.device.type == "meta"
    assert f"{name.split(',')[0]}Backward" not in type(found.grad_fn).__name__


@pytest.mark.slow
@pytest.mark.unsanitized
@small_cases
def test_the_reference_compiles(name):
    torch._dynamo.reset()
    made = SMALL[name]()
    run, expected = made.run, results(made, is_reference=True)
    made.run = torch.compile(run, fullgraph=True, backend="aot_eager")
    assert_equal_results(results(made, is_reference=True), expected, 1e-5)
    there = on_meta(made)
    assert there.run(**there.inputs).shape == expected["out"].shape


# -- types -----------------------------------------------------------------------------------------


@references
@small_cases
def test_autocast(name, reference):
    made = SMALL[name]()
    samples = name.startswith("polar_sample")
    expected = results(made)
    run = made.run

    def autocast(**inputs):
        with torch.autocast("cpu", dtype=bf16):
            return run(**inputs)

    made.run = autocast
    with use_reference(reference):
        ours = results(made, is_reference=reference)
        assert ours["out"].dtype == (bf16 if samples else f32)
        for key, want in expected.items():
            size = want.abs().max().item()
            assert key in ("out", "grad") or ours[key].dtype == f32
            torch.testing.assert_close(ours[key].float(), want, rtol=0.02, atol=0.02 * size)
        assert autocast(**SMALL[name](dtype=f64).inputs).dtype == f64 or samples


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("where", ["cpu", "meta", "reference"])
@pytest.mark.parametrize("name", ["polar_sample, circular", "window_attention", "polar_to_image"])
def test_float16_is_refused_on_every_device(name, where, autocast):
    made = SMALL[name]()
    first, values = next(iter(made.inputs.items()))
    half = made.replace(**{first: values.half()})
    half = half.to(torch.device("meta")) if where == "meta" else half
    with (
        use_reference(where == "reference"),
        torch.autocast("cpu", dtype=torch.float16, enabled=autocast),
        pytest.raises(TypeError, match=f"{first} must be .*bfloat16.*, got torch.float16"),
    ):
        half.run(**half.inputs)


@references
def test_a_bias_may_be_bfloat16(reference):
    made = SMALL["window_attention"](dtype=bf16)
    narrow = made.replace(bias=made.inputs["bias"].to(bf16))
    wide = narrow.replace(bias=narrow.inputs["bias"].float())
    with use_reference(reference):
        ours, expected = (results(c, is_reference=reference) for c in (narrow, wide))
    assert torch.equal(ours["out"], expected["out"])
    assert ours["bias"].dtype == bf16
    torch.testing.assert_close(ours["bias"], expected["bias"].to(bf16), rtol=2**-7, atol=1e-3)


@references
def test_the_reference_rounds_bfloat16_once(reference):
    """Also compares with the operators under an autocast that has narrowed a bias."""
    for name in ("window_attention", "polar_to_image", "polar_sample", "polar_sample, circular"):
        made = SMALL[name]()
        first = next(iter(made.inputs))
        made = made.replace(**{first: made.inputs[first].to(bf16)})
        with torch.autocast("cpu", dtype=bf16, enabled=reference):
            ours, expected = results(made), results(made, is_reference=True)
        for key, want in expected.items():
            assert ours[key].dtype == want.dtype
            size = want.abs().max().item()
            torch.testing.assert_close(ours[key], want, rtol=2**-7, atol=2**-7 * size)
