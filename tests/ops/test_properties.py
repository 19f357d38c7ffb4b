"""Properties that hold for all arguments of the operators, on arguments that hypothesis draws.

A few dozen of each in `make test`, always the same; `make fuzz` draws 2,000 others of each.
"""

import math

import pytest
import strategies
import torch
from cases import (
    Case,
    assert_same_bits_on_any_number_of_threads,
    bf16,
    f32,
    f64,
    results,
)
from hypothesis import given, note
from hypothesis import strategies as st
from torch import Tensor

from darswin.ops import polar_sample, use_reference
from darswin.ops._inference import add_norm_, transpose_sum

pytestmark = pytest.mark.filterwarnings("error")


def assert_accurate(ours: Tensor, base: Tensor, exact: Tensor, size: float) -> None:
    """The accuracy rule: an error of at most twice the reference's own in the same type. A few
    numbers may be exact there by chance: up to 16 roundings of `size` are always allowed."""
    assert ours.shape == exact.shape and ours.dtype == base.dtype
    if exact.numel() == 0:
        return
    assert ours.isfinite().all()
    error, own = ((t.double() - exact).abs().max().item() for t in (ours, base))
    allowed = 2 * own + 16 * torch.finfo(ours.dtype).eps * size
    assert error <= allowed, f"error {error:.3g}, allowed {allowed:.3g}"


def assert_equals_reference(case: Case, size_of) -> None:
    """`size_of` a result's name: how large the numbers are that are added up for it."""
    note(repr(case))
    exact = results(case.to(f64), is_reference=True)
    base = results(case, is_reference=True)
    ours = results(case)
    for name in exact:
        assert_accurate(ours[name], base[name], exact[name], size_of(name))
    assert_same_bits_on_any_number_of_threads(lambda: results(case))


def largest(tensor: Tensor) -> float:
    return tensor.abs().max().item() if tensor.numel() else 0.0


def check_sampling(case: Case) -> None:
    exact = case.to(f64)
    linear = [name for name in ("image", "weight", "bias") if name in case.inputs]
    sizes = results(exact, is_reference=True, absolute=linear)
    grads = sizes["grad"]  # of the samples, and the same with the linear layer behind them
    if "weight" in linear:
        grads = grads @ exact.inputs["weight"].abs()
    # Of the lens: all samples, each by the difference of two pixels, at the longest radius.
    lens = grads.sum().item() * 2 * largest(exact.inputs["image"])
    lens *= max(1.0, largest(exact.inputs["radii"]))
    # Places are computed in float64. In a float64 call their rounding counts, of as many pixels as
    # they may be away from 0; the reference itself has no more digits.
    places = 1.0
    if case.inputs["image"].dtype == f64:
        stretch = largest(exact.inputs["affine"]) if "affine" in exact.inputs else 1.0
        turns = 1 + largest(case.settings["azimuths"])
        places += 4 * largest(exact.inputs["radii"]) * max(stretch, 1.0) * turns + 100
    assert_equals_reference(
        case,
        lambda name: places * (largest(sizes[name]) if name in ("out", "grad", *linear) else lens),
    )


@given(strategies.sampling())
def test_polar_sample_equals_the_reference(case):
    check_sampling(case)


@given(strategies.sampling(embed=True))
def test_polar_embed_equals_the_reference(case):
    check_sampling(case)


@given(strategies.attention())
def test_window_attention_equals_the_reference(case):
    qkv = largest(case.inputs["qkv"])
    head_dim = case.inputs["qkv"].shape[-1]
    tokens = math.prod(case.settings["window"])

    def size_of(name: str) -> float:
        if name == "out":
            return qkv
        pair = 4.0 * qkv * head_dim  # the gradient of a logit
        windows = case.inputs["qkv"].numel() / max(3 * head_dim * tokens, 1)
        return pair * windows * tokens if name == "bias" else pair * max(qkv, 1.0)

    assert_equals_reference(case, size_of)


def check_polar_map(case: Case) -> None:
    exact = case.to(f64)
    sizes = results(exact, is_reference=True, absolute=["x"])
    x, radii = exact.inputs["x"], exact.inputs["radii"]
    # Of the lens: all pixels, each by the difference of two tokens, at the narrowest ring or, half
    # a pixel from the pole, by the azimuth; a matrix has as long a lever as the image is wide.
    steps = torch.cat((2 * radii[:, :1], radii.diff(dim=1)), 1)
    narrow = steps[steps > 0].min().item() if (steps > 0).any() else 1.0
    lens = sizes["grad"].sum().item() * 2 * largest(x) * (1 / narrow + x.shape[2])
    lens *= 1 + max(case.settings["size"])
    # A weight is right to the rounding of a place, in units of a ring or of a sector.
    weights = (1 + max(case.settings["size"])) * (1 / narrow + x.shape[2])
    assert_equals_reference(
        case,
        lambda name: (
            weights * largest(sizes[name]) if name in ("out", "grad", "x") else weights * lens
        ),
    )


@given(strategies.polar_maps())
def test_polar_to_image_equals_the_reference(case):
    check_polar_map(case)


@given(strategies.norms())
def test_add_norm_is_as_accurate_as_torch(arguments):
    x, y, weight, bias = arguments
    note(f"{x.shape} {x.storage_offset()}")
    total = x + y

    def run():
        a, b = x.clone(), y.clone()
        return a, add_norm_(a, b, weight, bias, 1e-5)

    assert_same_bits_on_any_number_of_threads(lambda: dict(enumerate(run())))
    changed, out = run()
    assert torch.equal(changed, total)
    if x.numel() == 0:
        return
    # Of the sum as it is rounded: what the norm is given.
    exact = torch.layer_norm(total.double(), weight.shape, weight.double(), bias.double(), 1e-5)
    base = torch.layer_norm(total, weight.shape, weight, bias, 1e-5)
    assert_accurate(out, base, exact, largest(exact) + largest(bias))


@given(strategies.matrices())
def test_transpose_sum_equals_torch(x):
    note(f"{x.shape} {x.storage_offset()}")
    assert_same_bits_on_any_number_of_threads(lambda: dict(enumerate(transpose_sum(x))))
    transposed, sums = transpose_sum(x)
    assert torch.equal(transposed, x.t()) and transposed.is_contiguous()
    assert_accurate(sums, x.sum(0), x.double().sum(0), largest(x.double().abs().sum(0)) / 4)


# -- other types of pixels -------------------------------------------------------------------------


narrow_cases = st.booleans().flatmap(lambda embed: strategies.sampling(dtypes=(f32,), embed=embed))


@given(narrow_cases)
def test_bfloat16_pixels_are_sampled_as_float32_and_rounded_once(case):
    note(repr(case))
    inputs = dict(case.inputs)
    narrow = inputs.pop("image").to(bf16)
    rounded, wide = (
        Case(case.run, dict(inputs, image=image), case.mask) for image in (narrow, narrow.float())
    )
    ours, same = (results(c) for c in (rounded, wide))
    assert ours["out"].dtype == bf16 and torch.equal(ours["out"], same["out"].bfloat16())
    with torch.no_grad(), use_reference():
        exact = case.run(image=narrow.double(), **{name: t.double() for name, t in inputs.items()})
    size = largest(narrow) * (1 + largest(inputs.get("weight", narrow))) * narrow.shape[1]
    torch.testing.assert_close(ours["out"].double(), exact, rtol=2**-7, atol=1e-3 * (1 + size))
    assert_same_bits_on_any_number_of_threads(lambda: results(rounded))


@given(strategies.sampling(dtypes=(f32,)), st.booleans())
def test_uint8_pixels_are_sampled_as_what_they_stand_for(case, frames):
    note(repr(case))
    inputs, settings = dict(case.inputs), dict(case.settings)
    image = (inputs.pop("image") * 50 + 128).clamp(0, 255).to(torch.uint8)
    mean, std = 0.4, 0.25
    grid = (inputs["radii"], settings.pop("azimuths"), inputs["center"])
    general = {name: inputs[name] for name in ("affine", "offsets") if name in inputs}
    given = image.permute(0, 2, 3, 1) if frames else image
    norm = dict(mean=mean, std=std, channels_last=frames)
    ours = polar_sample(given, *grid, **general, **settings, **norm)
    with use_reference():
        exact = polar_sample(
            (image.double() / 255 - mean) / std, *(t.double() for t in grid),
            **{name: t.double() for name, t in general.items()}, **settings,
        )  # fmt: skip
    torch.testing.assert_close(ours.double(), exact, rtol=1e-5, atol=1e-5)


@given(strategies.attention(dtypes=(bf16,)))
def test_bfloat16_attention_is_float32_rounded_once(case):
    note(repr(case))
    wide = Case(case.run, {name: t.float() for name, t in case.inputs.items()})
    ours, exact = (results(c) for c in (case, wide))
    assert ours["out"].dtype == ours["qkv"].dtype == bf16
    torch.testing.assert_close(ours["out"].float(), exact["out"], rtol=2**-7, atol=1e-5)
    assert_same_bits_on_any_number_of_threads(lambda: results(case))


@given(strategies.polar_maps(dtypes=(bf16,)))
def test_bfloat16_maps_are_brought_back_in_float32_and_rounded_once(case):
    note(repr(case))
    wide = Case(case.run, {name: t.float() for name, t in case.inputs.items()}, case.mask)
    ours, exact = (results(c) for c in (case, wide))
    assert ours["out"].dtype == ours["x"].dtype == bf16
    assert torch.equal(ours["out"], exact["out"].bfloat16())
    assert_same_bits_on_any_number_of_threads(lambda: results(case))


@given(strategies.norms(dtypes=(bf16,)))
def test_bfloat16_norm_is_float32_rounded_once(arguments):
    x, y, weight, bias = arguments
    total = x + y
    assert_same_bits_on_any_number_of_threads(
        lambda: dict(out=add_norm_(x.clone(), y.clone(), weight, bias, 1e-5))
    )
    out = add_norm_(x, y, weight, bias, 1e-5)
    assert torch.equal(x, total)
    if x.numel():
        want = torch.layer_norm(total.float(), weight.shape, weight, bias, 1e-5)
        torch.testing.assert_close(out.float(), want, rtol=2**-7, atol=2e-3)


# -- what is not finite, and what nearly is not ----------------------------------------------------


def spoiled(generator: torch.Generator, tensor: Tensor, value: float, share: float) -> Tensor:
    """A copy in which about a `share` of the numbers, and one at least, are `value`."""
    hit = torch.rand(tensor.shape, generator=generator) < share
    if tensor.numel():
        hit.view(-1)[torch.randint(tensor.numel(), (), generator=generator)] = True
    return tensor.masked_fill(hit, value)


def assert_same_kinds(ours: Tensor, exact: Tensor, atol: float) -> None:
    """Numbers where the reference has numbers, and NaN and each infinity where it has that."""
    torch.testing.assert_close(ours.double(), exact.double(), rtol=1e-4, atol=atol, equal_nan=True)


bad_values = st.sampled_from([math.nan, math.inf, -math.inf])


@given(strategies.sampling(), strategies.generators(), bad_values, st.data())
def test_a_lens_that_is_not_finite_samples_nothing_there(case, generator, bad, data):
    note(repr(case))
    names = [name for name in ("radii", "center", "affine", "offsets") if name in case.inputs]
    name = data.draw(st.sampled_from([*names, "azimuths"]))
    place = case.settings if name == "azimuths" else case.inputs
    place[name] = spoiled(generator, place[name], bad, 0.2)
    exact = results(case.to(f64), is_reference=True)
    ours = results(case)
    lever = 1e-3 * (1 + exact["out"].numel()) * (1 + largest(case.inputs["image"]))
    for key, value in ours.items():
        assert value.isfinite().all()
        assert_same_kinds(value, exact[key], atol=1e-3 if key in ("out", "image") else lever)
    assert_same_bits_on_any_number_of_threads(lambda: results(case))


@given(strategies.sampling(), strategies.generators(), bad_values)
def test_pixels_that_are_not_finite_spoil_what_touches_them(case, generator, bad):
    note(repr(case))
    image = case.inputs["image"]
    case.inputs["image"] = spoiled(generator, image, bad, 0.02)
    smooth = case.smooth() > 0
    with torch.no_grad():
        ours = case.run(**case.inputs)
        with use_reference():
            exact = case.to(f64).run(**case.to(f64).inputs)
    # Right on the border of a pixel its weight is 0 or a rounding: NaN and infinity may differ.
    assert_same_kinds(torch.where(smooth, ours, 0), torch.where(smooth, exact, 0), atol=1e-3)


@given(strategies.sampling(), strategies.generators(), bad_values)
def test_gradients_that_are_not_finite_reach_the_pixels_that_were_touched(case, generator, bad):
    note(repr(case))
    if case.inputs["image"].numel() == 0:
        return
    mask = case.smooth().expand(case.run(**case.inputs).shape)
    grad = strategies.normal(generator, *mask.shape) * mask
    grad = torch.where(mask > 0, spoiled(generator, grad, bad, 0.02), grad)
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


@given(strategies.polar_maps(), strategies.generators(), bad_values, st.data())
def test_pixels_that_lie_nowhere_on_the_map_are_zero(case, generator, bad, data):
    names = [name for name in ("center", "affine", "points") if name in case.inputs]
    name = data.draw(st.sampled_from(names))
    case.inputs[name] = spoiled(generator, case.inputs[name], bad, 0.2)
    note(repr(case))
    exact = results(Case(case.run, case.to(f64).inputs), is_reference=True)
    ours = results(Case(case.run, case.inputs))
    for key in ("out", "x"):
        assert ours[key].isfinite().all()
        assert_same_kinds(ours[key], exact[key], atol=1e-2 * (1 + largest(exact[key])))


@given(strategies.polar_maps(), strategies.generators(), bad_values)
def test_tokens_that_are_not_finite_spoil_the_pixels_around_them(case, generator, bad):
    note(repr(case))
    smooth = case.smooth() > 0
    case.inputs["x"] = spoiled(generator, case.inputs["x"], bad, 0.02)
    with torch.no_grad():
        ours = case.run(**case.inputs)
        with use_reference():
            exact = case.to(f64).run(**case.to(f64).inputs)
    # Right on the middle of a token the others' weights are 0 or a rounding.
    assert_same_kinds(torch.where(smooth, ours, 0), torch.where(smooth, exact, 0), atol=1e-2)


@given(strategies.attention(), strategies.generators(), bad_values)
def test_a_token_that_is_not_finite_spoils_its_window_alone(case, generator, bad):
    note(repr(case))
    qkv = spoiled(generator, case.inputs["qkv"], bad, 0.01)
    settings = case.settings
    # Windows that hold one, as the tokens of the map.
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
