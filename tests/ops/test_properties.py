"""Properties of the operators for all arguments, tested on arguments that hypothesis draws.

`make test` draws a few dozen arguments for each test, always the same. `make fuzz` draws 2,000
other ones.
"""

import math
from collections.abc import Callable

import pytest
import strategies
import torch
from cases import (
    Case,
    assert_rounded_once,
    assert_same_bits_on_any_number_of_threads,
    f32,
    f64,
    results,
    sampling_call,
)
from hypothesis import given, note
from hypothesis import strategies as st
from torch import Tensor

from darswin.ops import use_reference

pytestmark = pytest.mark.filterwarnings("error")


def assert_accurate(ours: Tensor, base: Tensor, exact: Tensor, size: float) -> None:
    """The accuracy rule: the error is at most twice that of the reference in the same dtype. Up to
    16 roundings of `size` are always allowed, because the reference may be exact by chance."""
    assert ours.shape == exact.shape and ours.dtype == base.dtype
    if exact.numel() == 0:
        return
    assert ours.isfinite().all()
    error, own = ((t.double() - exact).abs().max().item() for t in (ours, base))
    allowed = 2 * own + 16 * torch.finfo(ours.dtype).eps * size
    assert error <= allowed, f"error {error:.3g}, allowed {allowed:.3g}"


def largest(tensor: Tensor) -> float:
    return tensor.abs().max().item() if tensor.numel() else 0.0


# Functions that map the name of a result to the size of the numbers that are added up for it.


def sampling_size(case: Case) -> Callable[[str], float]:
    exact = case.to(f64)
    sizes = results(exact, is_reference=True, absolute=["image"])
    # For the lens: the sum over all samples, each times the difference of two pixels, times the
    # longest radius.
    lens = sizes["grad"].sum().item() * 2 * largest(exact.inputs["image"])
    lens *= max(1.0, largest(exact.inputs["radii"]))
    # Positions are computed in float64. In a float64 call their rounding matters, in proportion to
    # their distance from 0 in pixels. The reference itself has no more digits.
    places = 1.0
    if case.inputs["image"].dtype == f64:
        stretch = largest(exact.inputs["affine"]) if "affine" in exact.inputs else 1.0
        turns = 1 + largest(case.settings["azimuths"])
        places += 4 * largest(exact.inputs["radii"]) * max(stretch, 1.0) * turns + 100
    known = ("out", "grad", "image")
    return lambda name: places * (largest(sizes[name]) if name in known else lens)


def attention_size(case: Case) -> Callable[[str], float]:
    qkv, head_dim = largest(case.inputs["qkv"]), case.inputs["qkv"].shape[-1]
    tokens = math.prod(case.settings["window"])
    pair = 4.0 * qkv * head_dim  # the gradient of a logit
    windows = case.inputs["qkv"].numel() / max(3 * head_dim * tokens, 1)
    sizes = dict(out=qkv, bias=pair * windows * tokens)
    return lambda name: sizes.get(name, pair * max(qkv, 1.0))


def map_size(case: Case) -> Callable[[str], float]:
    exact = case.to(f64)
    sizes = results(exact, is_reference=True, absolute=["x"])
    x, radii = exact.inputs["x"], exact.inputs["radii"]
    # For the lens: the sum over all pixels, each times the difference of two tokens. The narrowest
    # ring is the worst case, or the azimuth half a pixel from the pole. The lever of the matrix is
    # as long as the image is wide.
    steps = torch.cat((2 * radii[:, :1], radii.diff(dim=1)), 1)
    narrow = steps[steps > 0].min().item() if (steps > 0).any() else 1.0
    # A weight is as accurate as the rounding of a position, in units of a ring or of a sector.
    weights = (1 + max(case.settings["size"])) * (1 / narrow + x.shape[2])
    lens = sizes["grad"].sum().item() * 2 * largest(x) * weights
    known = ("out", "grad", "x")
    return lambda name: weights * (largest(sizes[name]) if name in known else lens)


# Operator → the strategy that draws its calls, and the function for the sizes of their results.
CALLS = {
    "polar_sample": (strategies.sampling, sampling_size),
    "window_attention": (strategies.attention, attention_size),
    "polar_to_image": (strategies.polar_maps, map_size),
}


def draw(data: st.DataObject, name: str, **options) -> Case:
    case = data.draw(CALLS[name][0](**options))
    note(repr(case))
    return case


@pytest.mark.parametrize("name", CALLS)
@given(data=st.data())
def test_equals_the_reference(name, data):
    case = draw(data, name)
    size_of = CALLS[name][1](case)
    exact = results(case.to(f64), is_reference=True)
    base, ours = results(case, is_reference=True), results(case)
    for key in exact:
        assert_accurate(ours[key], base[key], exact[key], size_of(key))
    assert_same_bits_on_any_number_of_threads(lambda: results(case, masked=False))


@pytest.mark.parametrize("name", CALLS)
@given(data=st.data())
def test_bfloat16_is_float32_rounded_once(name, data):
    case = draw(data, name, dtypes=(f32,))
    narrow, ours, _ = assert_rounded_once(case, same_order=name != "window_attention")
    values = next(iter(narrow.inputs.values()))
    with torch.no_grad(), use_reference():
        exact = case.run(**narrow.to(f64).inputs)
    size = largest(values) * (1 + largest(case.inputs.get("weight", values))) * values.shape[1]
    torch.testing.assert_close(ours["out"].double(), exact, rtol=2**-7, atol=1e-3 * (1 + size))
    assert_same_bits_on_any_number_of_threads(lambda: results(narrow, masked=False))


@given(strategies.sampling(dtypes=(f32,)), st.booleans())
def test_uint8_pixels_are_sampled_as_what_they_stand_for(case, frames):
    note(repr(case))
    image = (case.inputs["image"] * 50 + 128).clamp(0, 255).to(torch.uint8)
    mean, std = 0.4, 0.25
    norm = dict(mean=mean, std=std, channels_last=frames)
    raw = sampling_call(case.inputs, **case.settings, **norm)
    given = image.permute(0, 2, 3, 1) if frames else image
    ours = raw.run(**case.inputs | dict(image=given))
    with use_reference():
        wide = case.to(f64).inputs | dict(image=(image.double() / 255 - mean) / std)
        exact = case.run(**wide)
    torch.testing.assert_close(ours.double(), exact, rtol=1e-5, atol=1e-5)


@given(data=st.data())
def test_norm_is_as_accurate_as_torch(data):
    x, parameters = data.draw(strategies.norms())
    note(f"{x.shape} {x.storage_offset()}")

    def run():
        return dict(norm=torch.ops.darswin._norm(x, parameters, 1e-5))

    assert_same_bits_on_any_number_of_threads(run)
    if x.numel() == 0:
        return
    base = torch.layer_norm(x, x.shape[-1:], *parameters, 1e-5)
    exact = torch.layer_norm(x.double(), x.shape[-1:], *parameters.double(), 1e-5)
    assert_accurate(run()["norm"], base, exact, largest(exact) + largest(parameters[1]))


# -- values that are not finite, or nearly overflow ------------------------------------------------


def spoiled(tensor: Tensor, value: float, share: float) -> Tensor:
    """A copy in which about a `share` of the numbers, but at least one, is `value`."""
    hit = torch.rand(tensor.shape) < share
    if tensor.numel():
        hit.view(-1)[torch.randint(tensor.numel(), ())] = True
    return tensor.masked_fill(hit, value)


def assert_same_kinds(ours: Tensor, exact: Tensor, atol: float) -> None:
    """Asserts equal numbers, with NaN and the infinities in the same places."""
    torch.testing.assert_close(ours.double(), exact.double(), rtol=1e-4, atol=atol, equal_nan=True)


bad_values = st.sampled_from([math.nan, math.inf, -math.inf])


@given(strategies.sampling(), bad_values, st.data())
def test_a_lens_that_is_not_finite_samples_nothing_there(case, bad, data):
    note(repr(case))
    names = [name for name in ("radii", "center", "affine", "offsets") if name in case.inputs]
    name = data.draw(st.sampled_from([*names, "azimuths"]))
    place = case.settings if name == "azimuths" else case.inputs
    place[name] = spoiled(place[name], bad, 0.2)
    exact = results(case.to(f64), is_reference=True)
    ours = results(case)
    lever = 1e-3 * (1 + exact["out"].numel()) * (1 + largest(case.inputs["image"]))
    for key, value in ours.items():
        assert value.isfinite().all()
        assert_same_kinds(value, exact[key], atol=1e-3 if key in ("out", "image") else lever)
    assert_same_bits_on_any_number_of_threads(lambda: results(case, masked=False))


@pytest.mark.parametrize("name", ["polar_sample", "polar_to_image"])
@given(data=st.data())
def test_pixels_and_tokens_that_are_not_finite_spoil_what_touches_them(name, data):
    case, bad = draw(data, name), data.draw(bad_values)
    smooth = case.smooth() > 0
    first, values = next(iter(case.inputs.items()))
    case = case.replace(**{first: spoiled(values, bad, 0.02)})
    with torch.no_grad():
        ours = case.run(**case.inputs)
        with use_reference():
            exact = case.run(**case.to(f64).inputs)
    # On the border of a pixel or in the middle of a token, the weight is 0 or a rounding error.
    # There NaN and infinity may differ.
    atol = 1e-3 if name == "polar_sample" else 1e-2
    assert_same_kinds(torch.where(smooth, ours, 0), torch.where(smooth, exact, 0), atol=atol)


@given(strategies.sampling(), bad_values)
def test_gradients_that_are_not_finite_reach_the_pixels_that_were_touched(case, bad):
    note(repr(case))
    if case.inputs["image"].numel() == 0:
        return
    mask = case.smooth().expand(case.run(**case.inputs).shape)
    grad = torch.randn(mask.shape, dtype=f64) * mask
    grad = torch.where(mask > 0, spoiled(grad, bad, 0.02), grad)
    grads = []
    for c, is_reference in ((case, False), (case.to(f64), True)):
        leaf = c.inputs["image"].detach().requires_grad_()
        with use_reference(is_reference):
            out = c.run(**dict(c.inputs, image=leaf))
        grads += torch.autograd.grad(out, leaf, grad.to(out.dtype))
    assert_same_kinds(*grads, atol=1e-3 * (1 + len(case.settings["azimuths"])))


@given(strategies.sampling(dtypes=(f32,)), st.sampled_from([3e38, -3e38]))
def test_huge_pixels_do_not_overflow(case, huge):
    note(repr(case))
    image = torch.where(case.inputs["image"] > 0, huge, -huge)
    inputs = dict(case.inputs, image=image)
    with torch.no_grad():
        ours = case.run(**inputs)
        with use_reference():
            exact = case.run(**{name: t.double() for name, t in inputs.items()})
    assert ours.isfinite().all()
    torch.testing.assert_close(ours.double(), exact, rtol=1e-4, atol=1e-5 * 3e38)


@given(strategies.polar_maps(), bad_values, st.data())
def test_pixels_that_lie_nowhere_on_the_map_are_zero(case, bad, data):
    names = [name for name in ("center", "affine", "points") if name in case.inputs]
    name = data.draw(st.sampled_from(names))
    case.inputs[name] = spoiled(case.inputs[name], bad, 0.2)
    note(repr(case))
    exact = results(Case(case.run, case.to(f64).inputs), is_reference=True)
    ours = results(Case(case.run, case.inputs))
    for key in ("out", "x"):
        assert ours[key].isfinite().all()
        assert_same_kinds(ours[key], exact[key], atol=1e-2 * (1 + largest(exact[key])))


@given(strategies.attention(), bad_values)
def test_a_token_that_is_not_finite_spoils_its_window_alone(case, bad):
    note(repr(case))
    qkv = spoiled(case.inputs["qkv"], bad, 0.01)
    settings = case.settings
    # Marks all tokens of the map whose window contains such a token.
    hit = (~qkv.isfinite()).flatten(3).any(3).roll([-s for s in settings["shift"]], (1, 2))
    (mr, ma), (batch, rings, sectors) = settings["window"], hit.shape
    windows = hit.view(batch, rings // mr, mr, sectors // ma, ma).amax((2, 4), keepdim=True)
    hit = windows.expand(-1, -1, mr, -1, ma).reshape(hit.shape).roll(settings["shift"], (1, 2))
    spoilt = Case(case.run, dict(case.inputs, qkv=qkv))
    ours, clean = (results(c) for c in (spoilt, case))
    exact = results(spoilt.to(f64), is_reference=True)
    for name in ("out", "qkv"):
        keep = ~hit.reshape(*hit.shape, *(1,) * (ours[name].dim() - 3))
        assert torch.equal(torch.where(keep, ours[name], 0), torch.where(keep, clean[name], 0))
    assert torch.equal(ours["out"].isfinite(), exact["out"].isfinite())
