"""polar_to_image's kernels: the accuracy rule, bits that do not depend on any order, sizes and
values at the edge. Maps and images are small, since a program takes a while in the interpreter."""

import math
from unittest import mock

import pytest
import torch
from helpers import assert_accurate, with_gradients

from darswin.ops import _library, polar_to_image, use_reference

# NumPy, which the interpreter computes with, tells of every NaN and infinity.
pytestmark = pytest.mark.filterwarnings("ignore:(invalid value|overflow):RuntimeWarning")


def make_inputs(batch=2, rings=4, sectors=8, channels=3, size=(7, 9), lenses=1, general=None):
    """x, radii and center; then affine, or points instead of center."""
    x = torch.randn(batch, rings, sectors, channels)
    radii = (torch.rand(lenses, rings) + 0.3).cumsum(1) * 4 / rings
    if general == "points":
        return x, radii, torch.randn(lenses, *size, 2) * 3
    middle = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2])
    center = middle + 0.3 + 0.1 * torch.rand(lenses, 2)
    affine = (torch.eye(2) + 0.2 * torch.randn(lenses, 2, 2),) if general == "affine" else ()
    return x, radii, center, *affine


def back(size=(7, 9), general=None, **options):
    """polar_to_image as a function of its differentiable inputs."""

    def run(x, radii, *lens):
        if general == "points":
            return polar_to_image(x, radii, None, size, points=lens[0], **options)
        affine = lens[1] if general == "affine" else None
        return polar_to_image(x, radii, lens[0], size, affine=affine, **options)

    return run


CASES = {
    "small": (dict(), dict()),
    "tokens": (dict(channels=19), dict(layout="tokens")),
    "a lens an image": (dict(lenses=2), dict(r_max=3.7)),
    "affine": (dict(lenses=2, general="affine"), dict(general="affine")),
    "points": (dict(general="points"), dict(general="points", layout="tokens")),
    "one ring": (dict(rings=1, sectors=16), dict(r_max=4.3)),
    "one sector": (dict(sectors=1, channels=1), dict(layout="tokens")),
    "odd sectors": (dict(sectors=7, rings=5), dict()),
    "one channel": (dict(channels=1, sectors=64, rings=16), dict()),
    "wide": (dict(batch=1, size=(2, 90)), dict(size=(2, 90))),
    "one pixel": (dict(size=(1, 1)), dict(size=(1, 1))),
}


@pytest.mark.parametrize("case", CASES)
def test_accuracy_rule(case, on):
    sizes, options = CASES[case]
    # The more numbers there are, the fewer draws measure their rounding.
    draws = 8 if case == "one pixel" else 3
    assert_accurate(on(back(**options)), lambda: make_inputs(**sizes), draws=draws)


@pytest.mark.parametrize("sizes", [dict(batch=0), dict(channels=0), dict(size=(0, 4))])
def test_nothing_to_bring_back(sizes, on):
    run, inputs = back(sizes.get("size", (7, 9))), make_inputs(**sizes)
    with use_reference():
        expected = with_gradients(run, inputs)
    for got, want in zip(with_gradients(on(run), inputs), expected, strict=True):
        assert torch.equal(got, want)


def test_the_gradient_of_a_map_does_not_depend_on_any_order(on):
    # All pixels lie between the same tokens; their gradients cover 40 binary digits.
    x, radii = torch.randn(1, 2, 4, 2), torch.tensor([[1.0, 2.0]])
    points = 0.1 * torch.rand(1, 70, 1, 2) + torch.tensor([0.9, 1.1])
    grad = torch.randn(1, 2, 70, 1) * 2.0 ** torch.randint(-40, 0, (1, 2, 70, 1))

    def run(order):
        leaf = x.detach().requires_grad_()
        out = on(back((70, 1), "points"))(leaf, radii, points[:, order])
        return torch.autograd.grad(out, leaf, grad[:, :, order])[0]

    order = torch.randperm(70)
    plain, turned = run(torch.arange(70)), run(order)
    assert torch.equal(plain, turned) and plain.count_nonzero() == 8


def test_two_runs_give_the_same_bits(on):
    inputs, run = make_inputs(general="affine"), on(back(general="affine"))
    for one, other in zip(with_gradients(run, inputs), with_gradients(run, inputs), strict=True):
        assert torch.equal(one, other)


def test_the_centre_and_the_axes(on):
    # Pixels at the pole, on the axes and the diagonals, where the pieces of the arctangent meet.
    x, radii = torch.randn(1, 3, 8, 2), torch.tensor([[0.5, 1.5, 3.0]])
    run, center = back((7, 7)), torch.full((1, 2), 3.0)
    with use_reference():
        expected = with_gradients(run, [t.double() for t in (x, radii, center)])
    found = with_gradients(on(run), (x, radii, center))
    for got, want in zip(found[:3], expected[:3], strict=True):
        torch.testing.assert_close(got.double(), want, rtol=1e-5, atol=2e-5)
    assert found[3].isfinite().all()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_pixels_at_nan_or_infinity_are_zero(bad, on):
    x, radii, points = make_inputs(batch=1, general="points")
    points[0, 2, 3, 0] = points[0, 4, 1, 1] = bad
    run = back(general="points", r_max=1e6)
    with use_reference():
        expected = with_gradients(run, (x, radii, points))
    for got, want in zip(with_gradients(on(run), (x, radii, points)), expected, strict=True):
        assert got.isfinite().all()
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)
    assert not expected[0][:, :, 2, 3].any() and not expected[0][:, :, 4, 1].any()


def test_strided_inputs(on):
    x, radii, center, affine = make_inputs(lenses=2, general="affine")
    run = on(back(general="affine"))
    plain = with_gradients(run, (x, radii, center, affine))
    strided = (
        x.permute(3, 0, 2, 1).contiguous().permute(1, 3, 2, 0), radii.mT.contiguous().mT,
        center.mT.contiguous().mT, affine.mT.contiguous().mT,
    )  # fmt: skip
    assert not any(t.is_contiguous() for t in strided)
    for one, other in zip(plain, with_gradients(run, strided), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_types_of_16_bits(dtype, on):
    x, *lens = make_inputs()
    run, half = on(back()), x.to(dtype)
    with mock.patch.object(_library, "has_kernels", return_value=True):  # the interpreter's, too
        found, grad, *grads = with_gradients(lambda *t: run(*t).float(), (half, *lens))
        assert run(half, *lens).dtype == grad.dtype == dtype
    expected, *expected_grads = with_gradients(run, (half.float(), *lens))
    # The interpreter cuts off the digits of bfloat16 that hardware rounds.
    torch.testing.assert_close(found, expected, rtol=torch.finfo(dtype).eps, atol=1e-7)
    for got, want in zip((grad, *grads), expected_grads, strict=True):
        torch.testing.assert_close(got.float(), want, rtol=0.02, atol=0.02 * want.abs().max())


@pytest.mark.parametrize("wanted", [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("general", [None, "affine", "points"])
def test_opcheck(general, wanted, device):
    x, radii, *lens = (t.to(device) for t in make_inputs(batch=1, size=(3, 4), general=general))
    plane = (None, None, lens[0]) if general == "points" else (*lens, None, None)[:3]
    call = (x, radii, *plane, torch.ones(1, device=device), [3, 4], True)
    checks = dict(test_utils=("test_schema", "test_faketensor"))
    torch.library.opcheck(torch.ops.darswin.polar_to_image.default, call, **checks)
    call = (*call, torch.randn(1, 3, 4, 3, device=device), *wanted)
    torch.library.opcheck(torch.ops.darswin.polar_to_image_backward.default, call, **checks)
