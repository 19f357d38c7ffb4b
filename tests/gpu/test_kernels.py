"""The kernels for GPUs under the contract of the operators, with its cases; then what only they do.
Few and small cases, since a program takes 20 ms in the interpreter."""

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
    Case,
    assert_accurate,
    assert_equal_results,
    attention,
    elsewhere,
    polar_map,
    raw_calls,
    results,
    sampling,
)

from darswin.ops import _library, polar_sample, triton, use_reference

# NumPy, which the interpreter computes with, tells of every NaN and infinity.
pytestmark = pytest.mark.filterwarnings("ignore:(invalid value|overflow|divide):RuntimeWarning")

f64 = torch.float64
LARGE = ("one window of 1024", "windows without tables of pairs", "several chunks of windows")
OF_POINTS = ("plain", "one ring, one sector", "one point", "odd rows", "one pixel", "thin image",
             "empty batch", "no points", "no channels")  # fmt: skip
OF_TOKENS = ("no bias", "one token", "empty batch", "no rings", "no channels")
KERNELS = {
    f"{operator}: {name}": CASES[operator, name]
    for operator, names in {
        "polar_sample": [f"{name}, {kind}" for name in OF_POINTS for kind in ("jitter", "general")],
        "polar_embed": [
            f"{name}, {kind}" for name in OF_TOKENS for kind in ("circular", "general")
        ],
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
    # The more numbers there are, the fewer draws measure their rounding.
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
    tolerance = 1e-6 if "weight" in turned else 0  # torch's products depend on strides
    assert_equal_results(results(made.replace(**turned)), results(made), tolerance)
    leaves = {n: t.requires_grad_() for n, t in made.inputs.items()}
    out = made.run(**leaves)
    from_sum = torch.autograd.grad(out.sum(), leaves.values(), retain_graph=True)  # of stride 0
    from_ones = torch.autograd.grad(out, leaves.values(), torch.ones_like(out))
    assert all(torch.equal(a, b) for a, b in zip(from_sum, from_ones, strict=True))


@small_cases
def test_only_the_gradients_asked_for(name, device):
    made = SMALL[name]().to(device)
    every = results(made)
    for one in made.inputs:
        assert_equal_results(results(made, only=[one]), {one: every[one]})


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
    ["polar_sample", "polar_embed, circular", "window_attention", "polar_to_image", "odd windows"],
)
def test_types_of_16_bits_are_float32_rounded_once(name, dtype, device):
    if name.startswith(("polar_sample", "polar_embed")) and dtype == torch.float16:
        pytest.skip("these take no float16")
    wide = SMALL[name]() if name in SMALL else attention(1, 3, 14, 2, 5, (3, 7), 1, shift=(2, 5))
    wide = wide.to(device)
    first = next(iter(wide.inputs))
    narrow = wide.replace(**{first: wide.inputs[first].to(dtype)})
    wide = wide.replace(**{first: narrow.inputs[first].float()})
    with mock.patch.object(_library, "has_kernels", return_value=True):  # the interpreter's, too
        ours, expected = results(narrow), results(wide)
    assert ours["out"].dtype == ours[first].dtype == dtype
    # The interpreter cuts off the digits of bfloat16 that hardware rounds.
    for key, want in expected.items():
        eps = torch.finfo(dtype).eps if key == "out" else 0.02
        size = want.abs().max().item()
        torch.testing.assert_close(ours[key].float(), want, rtol=2 * eps, atol=eps * size)


@pytest.mark.parametrize("layout", ["tokens", "image"])
def test_camera_frames(layout, device):
    case = sampling(samples=(3, 4), layout=layout, mean=(0.4, 0.5, 0.6), std=(0.2, 0.3, 0.1),
                    channels_last=True)  # fmt: skip
    frames = torch.randint(256, (2, 17, 23, 3), dtype=torch.uint8)
    lens = {n: t for n, t in case.inputs.items() if n != "image"}

    def of(image):
        return Case(lambda **lens: case.run(image=image.to(lens["radii"].device), **lens), lens)

    expected = results(of(frames), is_reference=True)
    for image in (frames, frames.permute(0, 3, 1, 2).contiguous().permute(0, 2, 3, 1)):
        found = {n: t.cpu() for n, t in results(of(image).to(device)).items()}
        assert_equal_results(found, expected, 1e-4)


# -- sums in units ---------------------------------------------------------------------------------


def wide_range(*shape):
    """Numbers that cover 40 binary digits."""
    return torch.randn(shape) * 2.0 ** torch.randint(-40, 0, shape)


def test_the_gradient_of_an_image_does_not_depend_on_any_order(device):
    # All points fall into four pixels.
    case = sampling(1, rows=6, columns=16, samples=(1, 1), layout="image").to(device)
    radii, center = torch.linspace(0, 0.4, 6)[None], case.inputs["center"].round() + 0.5
    grad = wide_range(1, 3, 6, 16).to(device)

    def run(order):
        leaf = case.inputs["image"].detach().requires_grad_()
        out = case.run(leaf, radii[:, order].to(device), center)
        return torch.autograd.grad(out, leaf, grad[:, :, order])[0]

    plain, turned = run(torch.arange(6)), run(torch.tensor([5, 2, 3, 0, 4, 1]))
    assert torch.equal(plain, turned) and plain.count_nonzero() == 12


def test_the_gradient_of_a_map_does_not_depend_on_any_order(device):
    # All pixels lie between the same tokens.
    case = polar_map(1, 2, 4, 2, (70, 1), general="points").to(device)
    radii = torch.tensor([[1.0, 2.0]], device=device)
    points = (0.1 * torch.rand(1, 70, 1, 2) + torch.tensor([0.9, 1.1])).to(device)
    grad, order = wide_range(1, 2, 70, 1).to(device), torch.randperm(70)

    def run(order):
        leaf = case.inputs["x"].detach().requires_grad_()
        out = case.run(leaf, radii, points=points[:, order])
        return torch.autograd.grad(out, leaf, grad[:, :, order])[0]

    plain, turned = run(torch.arange(70)), run(order)
    assert torch.equal(plain, turned) and plain.count_nonzero() == 8


@pytest.fixture
def sampled(device):
    """An image of a batch of two, samples of it, and a random gradient of them."""
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
    # The smallest numbers of all have few digits.
    atol = 1e-6 * size + 1.5e-45
    torch.testing.assert_close(found.cpu(), want.float(), rtol=1e-5, atol=atol)


def test_images_of_a_batch_do_not_matter_to_each_other(sampled):
    """A gradient that is tiny beside another image's, or NaN there, is as exact as alone."""
    leaf, out, grad, _ = sampled
    (both,) = torch.autograd.grad(out, leaf, grad, retain_graph=True)
    for factor in (1e-15, math.nan, math.inf):
        scaled = torch.stack((grad[0] * factor, grad[1]))
        (found,) = torch.autograd.grad(out, leaf, scaled, retain_graph=True)
        assert torch.equal(found[1], both[1])
        if math.isfinite(factor):
            torch.testing.assert_close(found[0], both[0] * factor, rtol=1e-5, atol=1e-21)
        else:  # it is not hidden
            assert found[0].isnan().all()


def test_a_token_without_a_gradient_leaves_the_images_gradient_right(device):
    def make():
        case = sampling(rows=2, samples=(2, 2), features=7)
        mask = case.mask

        def others(**inputs):
            smooth = mask(**inputs)
            smooth.view(2, -1)[:, :2] = 0  # the first tokens of both images
            return smooth

        case.mask = others
        return case

    assert_accurate(make, device)


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


@pytest.mark.parametrize(
    ("rows", "jitter", "bad"), [(3, 0.0, math.inf), (1, 1.0, math.nan), (3, 1.0, -math.inf)]
)
def test_points_at_nan_or_infinity_sample_nothing(rows, jitter, bad, device):
    # In each image something else is bad, and one azimuth in all.
    case = sampling(4, 1, rows=rows, columns=4, samples=(1, 1), affine=True, offsets=True,
                    jitter=jitter, seed=4, layout="image")  # fmt: skip
    for b, tensor in enumerate(list(case.inputs.values())[1:]):
        tensor[b].view(-1)[0] = bad
    case.settings["azimuths"][2] = bad
    expected = results(case, is_reference=True)
    found = {n: t.cpu() for n, t in results(case.to(device)).items()}
    assert all(t.isfinite().all() for t in found.values())
    assert_equal_results(found, expected, 1e-4)
    assert not expected["out"][:, :, 0, 0].any() and not expected["out"][..., 2].any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_pixels_that_are_nan_or_infinite_count_where_they_are_touched(bad, device):
    image = torch.zeros(1, 3, 7, 7)
    image[0, 1, 3, 3] = bad
    case = sampling(1, rows=2, samples=(1, 1), layout="image").to(device)
    center, radii = (t.to(device) for t in (torch.full((1, 2), 3.25), torch.tensor([[0.25, 2.5]])))
    found = case.run(image.to(device), radii, center)
    assert not found[:, 0::2].any() and not found[0, 1, 1].any()
    assert not found[0, 1, 0].isfinite().any()
    # Points just outside of an image touch none of its pixels.
    spoilt = torch.full_like(image, bad).to(device)
    assert not case.run(spoilt, radii * 0, 0 * center - 1).any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_pixels_at_nan_or_infinity_are_zero(bad, device):
    case = polar_map(1, general="points", r_max=1e6)
    case.inputs["points"][0, 2, 3, 0] = case.inputs["points"][0, 4, 1, 1] = bad
    expected = results(case, is_reference=True)
    found = {n: t.cpu() for n, t in results(case.to(device)).items()}
    assert all(t.isfinite().all() for t in found.values())
    assert_equal_results(found, expected, 1e-4)
    assert not expected["out"][:, :, 2, 3].any() and not expected["out"][:, :, 4, 1].any()


def test_the_pole_and_the_axes(device):
    # Pixels at the pole, on the axes and the diagonals, where the pieces of the arctangent meet.
    case = polar_map(1, 3, 8, 2, (7, 7))
    case = case.replace(radii=torch.tensor([[0.5, 1.5, 3.0]]), center=torch.full((1, 2), 3.0))
    expected = results(case.to(f64), is_reference=True, masked=False)
    found = {n: t.cpu().double() for n, t in results(case.to(device), masked=False).items()}
    assert found.pop("center").isfinite().all() and len(expected.pop("center")) == 1
    assert_equal_results(found, expected, 1e-5)


# -- windows ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-20, 30.0], ids=["flat softmax", "sharp softmax"])
def test_attention_at_extreme_values(size, device):
    def make():
        case = attention(2, 8, 4, 1, 32, (4, 4), 2, shift=(2, 0))
        qkv = case.inputs["qkv"]
        if size > 1:
            # Pairs of keys between which a query's logits differ by about 1. Else almost every
            # probability is exactly 0 or 1, and the largest error is that of the few queries whose
            # two largest logits happen to be close: it depends on the draw and on the CPU.
            keys = qkv[:, ::2, :, 1]
            qkv[:, 1::2, :, 1] = keys + torch.randn_like(keys) / size**2
        return case.replace(qkv=qkv * size)

    assert_accurate(make, device)


@pytest.mark.parametrize("bias_rows", [1, 2])
def test_several_windows_a_program(bias_rows, device, monkeypatch):
    # As in large batches: here three of four windows.
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
    case.inputs["qkv"][0, 0, 1, :2] = bad  # in the window of the rings 3 and 0, apart by the seam
    out = case.run(**case.to(device).inputs)
    assert out[0, 1:].isfinite().all() and not out[0, 0].isfinite().all()


def test_minus_infinity_in_the_bias_hides_a_pair(device):
    case = attention(1, 1, 2, 1, 4, (1, 2)).to(device)
    qkv, bias = case.inputs.values()
    bias[..., 0] = -math.inf  # Δφ = -1: token 0 does not see token 1
    torch.testing.assert_close(case.run(qkv, bias)[0, 0, 0], qkv[0, 0, 0, 2, 0])
    bias[:] = -math.inf
    assert case.run(qkv, bias).isnan().all()
