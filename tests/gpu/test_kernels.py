"""Tests of the GPU kernels: first the operators' contract, with its cases and some of its tests,
then properties of the kernels alone. Cases are few and small, since a program takes 20 ms in the
interpreter."""

import functools
import math
from unittest import mock

import pytest
import torch
from cases import (
    ATTENTION,
    CASES,
    MAPS,
    SMALL,
    assert_accurate,
    assert_equal_results,
    attention,
    elsewhere,
    polar_map,
    raw_calls,
    results,
    sampling,
)
from test_contract import (  # noqa: F401  # pytest runs them here on the device
    test_gradients_may_arrive_expanded,
    test_only_the_gradients_asked_for,
)
from test_polar_sample import (  # noqa: F401
    test_pixels_that_are_nan_or_infinite_count_where_they_are_touched,
    test_points_at_nan_or_infinity_sample_nothing,
    test_uint8_pixels_are_what_they_stand_for,
)
from test_polar_to_image import test_the_pole_and_the_axes  # noqa: F401
from test_window_attention import test_minus_infinity_in_the_bias_hides_a_pair  # noqa: F401

from darswin.ops import _library, polar_sample, triton, use_reference

# The interpreter computes with NumPy, which warns about every NaN and infinity.
pytestmark = pytest.mark.filterwarnings("ignore:(invalid value|overflow|divide):RuntimeWarning")

f64 = torch.float64
LARGE = ("one window of 1024", "windows without tables of pairs", "several chunks of windows")
OF_POINTS = ("plain", "shared lens", "one ring, one sector", "one point", "odd rows", "one pixel",
             "thin image", "empty batch", "no points", "no channels")  # fmt: skip
KERNELS = {
    f"{operator}: {name}": CASES[operator, name]
    for operator, names in {
        "polar_sample": [f"{name}, {kind}" for name in OF_POINTS for kind in ("jitter", "general")],
        "window_attention": [name for name in ATTENTION if name not in LARGE],
        "polar_to_image": list(MAPS),
    }.items()
    for name in names
} | {
    "many channels": functools.partial(sampling, 1, 6, rows=2, samples=(2, 4)),
    "many points": functools.partial(sampling, 1, 1, rows=2, columns=301, samples=(2, 7)),
    "Swin, 7×7": functools.partial(
        attention, 1, 14, 14, 1, 32, (7, 7), shift=(3, 3), periodic=(False, False)
    ),
    "Swin, 8×8": functools.partial(
        attention, 1, 8, 16, 1, 32, (8, 8), shift=(4, 4), periodic=(False, False)
    ),
}
small_cases = pytest.mark.parametrize("name", SMALL)


# -- the contract ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KERNELS)
def test_accuracy_rule(name, device):
    # With more numbers, fewer draws are needed to measure rounding.
    few = ("one point", "one pixel", "one token,", "many points")
    draws = 8 if any(kind in name for kind in few) else 2
    assert_accurate(KERNELS[name], device, draws)


@small_cases
def test_two_runs_give_the_same_bits(name, device):
    made = SMALL[name]().to(device)
    assert_equal_results(results(made), results(made))


@small_cases
def test_strides_do_not_matter(name, device):
    made = SMALL[name]().to(device)
    turned = {name: elsewhere(t, "turned") for name, t in made.inputs.items()}
    assert_equal_results(results(made.replace(**turned)), results(made))


@small_cases
def test_opcheck(name, device):
    (operator, arguments), (backward, of_backward) = raw_calls(SMALL[name]().to(device))
    checks = dict(test_utils=("test_schema", "test_faketensor"))
    with torch.no_grad():
        torch.library.opcheck(operator, arguments, **checks)
        found = backward(*of_backward)
    fake = backward(*(a.to("meta") if isinstance(a, torch.Tensor) else a for a in of_backward))
    assert [(t.shape, t.dtype) for t in found] == [(t.shape, t.dtype) for t in fake]


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize(
    "name",
    ["polar_sample", "window_attention", "polar_to_image", "odd windows"],
)
def test_types_of_16_bits_are_float32_rounded_once(name, dtype, device):
    if name == "polar_sample" and dtype == torch.float16:
        pytest.skip("it takes no float16")
    wide = SMALL[name]() if name in SMALL else attention(1, 3, 14, 2, 5, (3, 7), 1, shift=(2, 5))
    wide = wide.to(device)
    first = next(iter(wide.inputs))
    narrow = wide.replace(**{first: wide.inputs[first].to(dtype)})
    wide = wide.replace(**{first: narrow.inputs[first].float()})
    with mock.patch.object(_library, "has_kernels", return_value=True):  # also in the interpreter
        ours, expected = results(narrow), results(wide)
    assert ours["out"].dtype == ours[first].dtype == dtype
    # The interpreter truncates to bfloat16, where hardware rounds.
    for key, want in expected.items():
        eps = torch.finfo(dtype).eps if key == "out" else 0.02
        size = want.abs().max().item()
        torch.testing.assert_close(ours[key].float(), want, rtol=2 * eps, atol=eps * size)


# -- sums in units ---------------------------------------------------------------------------------


def wide_range(*shape):
    """Random numbers over 40 powers of two."""
    return torch.randn(shape) * 2.0 ** torch.randint(-40, 0, shape)


@pytest.mark.parametrize("name", ["polar_sample", "polar_to_image"])
def test_gradients_do_not_depend_on_any_order(name, device):
    count = 6 if name == "polar_sample" else 70
    grad = wide_range(1, 2, count, 16).to(device)
    if name == "polar_sample":  # all points fall into four pixels
        case = sampling(1, 2, rows=count, columns=16, samples=(1, 1), layout="image").to(device)
        radii, center = torch.linspace(0, 0.4, count)[None], case.inputs["center"].round() + 0.5
    else:  # all pixels lie between the same tokens
        case = polar_map(1, 2, 4, 2, (count, 16), general="points").to(device)
        radii = torch.tensor([[1.0, 2.0]], device=device)
        points = 0.1 * torch.rand(1, count, 16, 2) + torch.tensor([0.9, 1.1])

    def run(order):
        leaf = next(iter(case.inputs.values())).detach().requires_grad_()
        if name == "polar_sample":
            out = case.run(leaf, radii[:, order].to(device), center)
        else:
            out = case.run(leaf, radii, points=points[:, order].to(device))
        return torch.autograd.grad(out, leaf, grad[:, :, order])[0]

    plain, turned = run(torch.arange(count)), run(torch.randperm(count))
    assert torch.equal(plain, turned) and plain.count_nonzero() == 8


@pytest.fixture
def sampled(device):
    """A batch of two images, their samples, a random gradient of the samples, and the case."""
    case = sampling(rows=2, samples=(2, 4), shared=True).to(device)
    leaf = case.inputs["image"].requires_grad_()
    out = case.run(**case.inputs)
    return leaf, out, torch.rand(out.shape).to(device), case


@pytest.mark.parametrize("size", [0.0, 1e-44, 1e-38, 1e-30, 1e30, 3e38])
def test_gradients_of_any_size(size, sampled):
    leaf, out, grad, case = sampled
    (found,) = torch.autograd.grad(out, leaf, grad * size)
    exact = case.to(torch.device("cpu")).to(f64)
    exact.inputs["image"] = exact.inputs["image"].detach().requires_grad_()
    with use_reference():
        wide = exact.run(**exact.inputs)
    (want,) = torch.autograd.grad(wide, exact.inputs["image"], (grad * size).cpu().double())
    # Subnormal numbers have few digits.
    atol = 1e-6 * size + 1.5e-45
    torch.testing.assert_close(found.cpu(), want.float(), rtol=1e-5, atol=atol)


def test_images_of_a_batch_do_not_matter_to_each_other(sampled):
    """A gradient stays exact if another image's gradient is far larger or is not finite."""
    leaf, out, grad, _ = sampled
    (both,) = torch.autograd.grad(out, leaf, grad, retain_graph=True)
    for factor in (1e-15, math.nan, math.inf):
        scaled = torch.stack((grad[0] * factor, grad[1]))
        (found,) = torch.autograd.grad(out, leaf, scaled, retain_graph=True)
        assert torch.equal(found[1], both[1])
        if math.isfinite(factor):
            torch.testing.assert_close(found[0], both[0] * factor, rtol=1e-5, atol=1e-21)
        else:  # the bad image's own gradient shows it
            assert found[0].isnan().all()


# -- points and pixels -----------------------------------------------------------------------------


def test_a_seed_on_the_device(device):
    case = sampling(jitter=1.0).to(device)
    image, radii, center = case.inputs.values()
    found = [
        polar_sample(image, radii, case.settings["azimuths"].to(device), center, samples=(3, 4),
                     jitter=1.0, seed=seed)
        for seed in (7, torch.tensor(7), torch.tensor(7, device=device))
    ]  # fmt: skip
    assert all(torch.equal(found[0], other) for other in found[1:])


@pytest.mark.parametrize("angle", [100.0, -1e4, 1e6])
def test_azimuths_of_many_turns(angle, device):
    case = sampling(1, rows=2, samples=(1, 1))
    case.settings["azimuths"] += angle
    with use_reference():
        expected = case.run(**case.to(f64).inputs)
    found = case.run(**case.to(device).inputs).cpu()
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_pixels_at_nan_or_infinity_are_zero(bad, device):
    case = polar_map(1, general="points", r_max=1e6)
    case.inputs["points"][0, 2, 3, 0] = case.inputs["points"][0, 4, 1, 1] = bad
    expected = results(case, is_reference=True)
    found = {n: t.cpu() for n, t in results(case.to(device)).items()}
    assert all(t.isfinite().all() for t in found.values())
    assert_equal_results(found, expected, 1e-4)
    assert not expected["out"][:, :, 2, 3].any() and not expected["out"][:, :, 4, 1].any()


# -- windows ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-20, 30.0], ids=["flat softmax", "sharp softmax"])
def test_attention_at_extreme_values(size, device):
    def make():
        case = attention(2, 8, 4, 1, 32, (4, 4), 2, shift=(2, 0))
        qkv = case.inputs["qkv"]
        if size > 1:
            # Make pairs of keys for which a query's logits differ by about 1. Otherwise almost
            # every probability is exactly 0 or 1. Then the largest error comes from the few queries
            # whose two largest logits happen to be close, and depends on the draw and on the CPU.
            keys = qkv[:, ::2, :, 1]
            qkv[:, 1::2, :, 1] = keys + torch.randn_like(keys) / size**2
        return case.replace(qkv=qkv * size)

    assert_accurate(make, device)


@pytest.mark.parametrize("bias_rows", [1, 2])
def test_several_windows_a_program(bias_rows, device, monkeypatch):
    # With fewer programs, each handles several windows as in large batches, here three of four.
    monkeypatch.setitem(triton.launcher("window_attention").__globals__, "PROGRAMS", 2)
    assert_accurate(lambda: attention(2, 2, 6, 1, 4, (1, 3), bias_rows, shift=(0, 1)), device)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("window", [(2, 4), (3, 7)], ids=["8 tokens", "21 tokens"])
def test_a_bad_token_spoils_only_its_window(bad, window, device):
    case = attention(1, window[0], 2 * window[1], 1, 4, window)
    case.inputs["qkv"][0, 0, 0] = bad
    found = results(case.to(device))
    spoiled, rest = found["out"].split(window[1], 2)
    assert rest.isfinite().all() and not spoiled.isfinite().any()
    assert found["qkv"][:, :, window[1] :].isfinite().all()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_query_and_key_spoil_nothing_beyond_the_seam(bad, device):
    case = attention(1, 4, 4, 1, 4, (2, 4), shift=(1, 0))
    case.inputs["qkv"][0, 0, 1, :2] = bad  # the seam divides this window, between rings 3 and 0
    out = case.run(**case.to(device).inputs)
    assert out[0, 1:].isfinite().all() and not out[0, 0].isfinite().all()
