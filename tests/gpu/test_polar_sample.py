"""polar_sample's kernels: the accuracy rule, the reference's random points, bits that do not depend
on any order, arguments at the edge. Images and grids are small, since a program takes a while in
the interpreter: backward has one for each radius of an image."""

import math

import pytest
import torch
from helpers import assert_accurate, with_gradients
from strategies import places, to_tokens

from darswin.ops import polar_sample, use_reference

LAYOUTS = ("tokens", "image")
# NumPy, which the interpreter computes with, tells of every NaN and infinity.
pytestmark = pytest.mark.filterwarnings("ignore:(invalid value|overflow):RuntimeWarning")


def make_inputs(batch=2, channels=3, size=(17, 23), rows=2, columns=8, shared=False, general=False):
    """Image, radii and center, affine and offsets if asked for; points in the image and outside."""
    lenses = 1 if shared else batch
    radii = torch.rand(lenses, rows).sort(1).values * max(size) * 0.7
    center = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2]) + torch.rand(lenses, 2)
    inputs = [torch.randn(batch, channels, *size), radii, center]
    if general:
        inputs.append(torch.eye(2) + 0.2 * torch.randn(lenses, 2, 2))
        inputs.append(torch.randn(lenses, 2, rows, columns))
    return inputs


def azimuths(columns):
    return (torch.arange(columns) + 0.37) * (2 * math.pi / max(columns, 1))


def sampler(columns, samples, **options):
    """polar_sample as a function of its differentiable inputs."""
    angles = azimuths(columns)

    def run(image, radii, center, affine=None, offsets=None):
        grid = (image, radii, angles.to(radii), center)
        return polar_sample(*grid, affine=affine, offsets=offsets, samples=samples, **options)

    return run


def smooth(columns, samples, jitter=0.0, seed=0, layout="tokens"):
    """A mask of the output: 0 where a point stands so near a pixel's middle that rounding may take
    it across, where gradients jump, or jitter brings it to the pole."""

    def mask(image, radii, center, affine=None, offsets=None):
        lens = (radii, azimuths(columns), center, affine, offsets)
        x, y, r = places(*lens, len(image), jitter, seed)
        away = ((x - x.round()).abs() > 1e-3) & ((y - y.round()).abs() > 1e-3)
        away &= (r > 1e-3) | (jitter == 0)
        planes = away[:, None].expand(-1, image.shape[1], -1, -1).double()
        return to_tokens(planes, samples) if layout == "tokens" else planes

    return mask


CASES = {
    "tokens": (dict(rows=4), (2, 4), dict()),
    "image": (dict(), (2, 4), dict(layout="image")),
    "jitter": (dict(rows=4), (2, 2), dict(jitter=0.8, seed=-3)),
    "general": (dict(general=True), (1, 2), dict(jitter=0.5, seed=2**40)),
    "one lens of all": (dict(shared=True, general=True), (2, 2), dict(layout="image")),
    "one ring, one sector": (dict(columns=3), (2, 3), dict(jitter=1.0)),
    "one point": (dict(rows=1, columns=1), (1, 1), dict(jitter=1.0)),
    "one pixel": (dict(size=(1, 1)), (1, 2), dict()),
    "thin image, one channel": (dict(size=(1, 37), channels=1), (1, 8), dict()),
    "two channels": (dict(channels=2), (1, 8), dict()),
    "many channels": (dict(channels=6, batch=1), (2, 4), dict()),
    "many points": (dict(channels=1, columns=301, batch=1), (2, 7), dict()),
}


@pytest.mark.parametrize("case", CASES)
def test_accuracy_rule(case, on):
    sizes, samples, options = CASES[case]
    columns = sizes.get("columns", 8)
    assert_accurate(
        on(sampler(columns, samples, **options)),
        lambda: make_inputs(**sizes),
        smooth(columns, samples, **options),
        draws=1,
    )


@pytest.mark.parametrize("seed", [1, -1, -(2**63), 2**62 + 3])
def test_jitter_is_the_references(seed, on):
    # Of an image that is its own coordinates the samples are the points. Rows of an odd length
    # begin in the middle of four random words.
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")
    image = torch.stack((x, y)).expand(3, 2, 40, 40)
    radii, center = torch.tensor([[2.0, 5.0, 11.0]]), torch.tensor([[19.3, 20.6]])
    run = on(sampler(13, (1, 1), jitter=1.0, seed=seed, layout="image"))
    found = run(image, radii, center)
    expected = places(radii, azimuths(13), center, None, None, 3, 1.0, seed)[:2]
    torch.testing.assert_close(found.double(), torch.stack(expected, 1), rtol=0, atol=2e-5)


def test_a_seed_on_the_device(device):
    image, radii, center = (t.to(device) for t in make_inputs())
    results = [
        sampler(8, (1, 1), jitter=1.0, seed=seed)(image, radii, center)
        for seed in (7, torch.tensor(7), torch.tensor(7, device=device))
    ]
    assert all(torch.equal(results[0], other) for other in results[1:])


@pytest.mark.parametrize("angle", [100.0, -1e4, 1e6])
def test_azimuths_of_many_turns(angle, on):
    image, radii, center = make_inputs(batch=1)

    def run(image, radii, center, angles):
        return polar_sample(image, radii, angles, center, samples=(1, 1))

    far = azimuths(8) + angle
    with use_reference():
        expected = run(*(t.double() for t in (image, radii, center, far)))
    found = on(run)(image, radii, center, far)
    torch.testing.assert_close(found.double(), expected, rtol=0, atol=2e-5)


def test_the_gradient_of_an_image_does_not_depend_on_any_order(on):
    # All points fall into four pixels; their gradients cover 40 binary digits.
    image, _, center = make_inputs(batch=1)
    radii = torch.linspace(0, 0.4, 6)[None]
    center = center.round() + 0.5
    grad = torch.randn(1, 3, 6, 16) * 2.0 ** torch.randint(-40, 0, (1, 3, 6, 16))

    def run(order):
        leaf = image.detach().requires_grad_()
        sampled = on(sampler(16, (1, 1), layout="image"))(leaf, radii[:, order], center)
        return torch.autograd.grad(sampled, leaf, grad[:, :, order])[0]

    plain, turned = run(torch.arange(6)), run(torch.tensor([5, 2, 3, 0, 4, 1]))
    assert torch.equal(plain, turned) and plain.count_nonzero() == 12


def test_two_runs_give_the_same_bits(on):
    inputs = make_inputs(general=True)
    run = on(sampler(8, (2, 2), jitter=1.0, seed=4))
    for one, other in zip(with_gradients(run, inputs), with_gradients(run, inputs), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("size", [0.0, 1e-44, 1e-38, 1e-30, 1e30, 3e38])
def test_gradients_of_any_size(size, on):
    image, radii, center = make_inputs(batch=1, channels=1)
    run, leaf = sampler(8, (2, 4)), image.requires_grad_()
    grad = torch.rand(1, 1, 2, 8) * size
    (found,) = torch.autograd.grad(on(run)(leaf, radii, center), leaf, grad)
    with use_reference():
        double = leaf.detach().double().requires_grad_()
        sampled = run(double, radii.double(), center.double())
    (expected,) = torch.autograd.grad(sampled, double, grad.double())
    # The smallest numbers of all have few digits.
    torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=1e-6 * size + 1.5e-45)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_is_not_hidden(bad, on):
    image, radii, center = make_inputs(batch=1)
    leaf = image.requires_grad_()
    sampled = on(sampler(8, (2, 4)))(leaf, radii, center)
    grad = torch.ones_like(sampled)
    grad[0, 0, 0, 0] = bad
    assert torch.autograd.grad(sampled, leaf, grad)[0].isnan().all()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("sizes", [dict(batch=0, shared=True), dict(rows=0), dict(channels=0)])
def test_nothing_to_sample(sizes, layout, on):
    inputs = make_inputs(**sizes)
    results = with_gradients(on(sampler(8, (2, 4), layout=layout)), inputs)
    with use_reference():
        expected = with_gradients(sampler(8, (2, 4), layout=layout), inputs)
    assert [r.shape for r in results] == [r.shape for r in expected]
    assert not any(result.any() for result in results)


def test_an_image_without_pixels(on):
    image, radii, center = make_inputs(size=(0, 5))
    sampled, grad_image, *grads = with_gradients(on(sampler(8, (2, 4))), (image, radii, center))
    assert sampled.numel() and not sampled.any() and grad_image.shape == image.shape
    assert not any(grad.any() for grad in grads)


@pytest.mark.parametrize(
    ("rows", "jitter", "bad"), [(3, 0.0, math.inf), (1, 1.0, math.nan), (3, 1.0, -math.inf)]
)
def test_points_at_nan_or_infinity_sample_nothing(rows, jitter, bad, on):
    # In each image something else is bad, and one azimuth in all.
    tensors = make_inputs(batch=4, channels=1, rows=rows, columns=4, general=True)
    for b, tensor in enumerate(tensors[1:]):
        tensor[b].view(-1)[0] = bad
    angles = azimuths(4)
    angles[2] = bad

    def run(image, radii, center, affine, offsets):
        return polar_sample(
            image, radii, angles.to(radii), center, affine=affine, offsets=offsets,
            samples=(1, 1), jitter=jitter, seed=4, layout="image",
        )  # fmt: skip

    with use_reference():
        expected = with_gradients(run, tensors)
    for got, want in zip(with_gradients(on(run), tensors), expected, strict=True):
        assert got.isfinite().all()
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)
    assert not expected[0][:, :, 0, 0].any() and not expected[0][..., 2].any()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_pixels_that_are_nan_or_infinite_count_where_they_are_touched(bad, on):
    image = torch.zeros(1, 3, 7, 7)
    image[0, 1, 3, 3] = bad
    run, radii = sampler(8, (1, 1), layout="image"), torch.tensor([[0.25, 2.5]])
    found = on(run)(image, radii, torch.full((1, 2), 3.25))
    assert not found[:, 0::2].any() and not found[0, 1, 1].any()
    assert not found[0, 1, 0].isfinite().any()
    # Points just outside of an image touch none of its pixels.
    assert not on(run)(torch.full_like(image, bad), radii * 0, torch.full((1, 2), -1.0)).any()


def test_strided_inputs(on):
    image, radii, center, affine, offsets = make_inputs(general=True)
    plain = with_gradients(on(sampler(8, (2, 4))), (image, radii, center, affine, offsets))
    wide = torch.randn(2, 6, 34, 46)
    wide[:, ::2, ::2, ::2] = image
    inputs = (
        wide[:, ::2, ::2, ::2], radii.mT.contiguous().mT, center.mT.contiguous().mT,
        affine.mT.contiguous().mT, offsets.mT.contiguous().mT,
    )  # fmt: skip
    assert not any(t.is_contiguous() for t in inputs)
    strided = with_gradients(on(sampler(8, (2, 4))), inputs)
    last = with_gradients(
        on(sampler(8, (2, 4))),
        (image.contiguous(memory_format=torch.channels_last), *inputs[1:]),
    )
    for one, *others in zip(plain, strided, last, strict=True):
        assert all(torch.equal(one, other) for other in others)


def test_expanded_gradients(on):
    image, radii, center = make_inputs(batch=2, shared=True)
    leaf = image[:1].requires_grad_()
    run = on(sampler(8, (2, 4)))
    (grad,) = torch.autograd.grad(run(leaf.expand(2, -1, -1, -1), radii, center).sum(), leaf)
    (expected,) = torch.autograd.grad(run(leaf, radii, center).sum(), leaf)
    torch.testing.assert_close(grad, 2 * expected)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_camera_frames(layout, on):
    frames = torch.randint(256, (2, 17, 23, 3), dtype=torch.uint8)
    _, radii, center = make_inputs()
    norm = dict(mean=(0.4, 0.5, 0.6), std=(0.2, 0.3, 0.1))
    run = sampler(8, (2, 4), layout=layout, **norm)
    with use_reference():
        expected, *expected_grads = with_gradients(lambda *t: run(frames, *t), (radii, center))
    for image in (frames, frames.permute(0, 3, 1, 2).contiguous()):
        found, *grads = with_gradients(lambda *t, image=image: on(run)(image, *t), (radii, center))
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=2e-5)
        for grad, want in zip(grads, expected_grads, strict=True):
            torch.testing.assert_close(grad, want, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_bfloat16(layout, on):
    image, radii, center = make_inputs()
    half = image.bfloat16()
    run = on(sampler(8, (2, 4), layout=layout))
    found, *grads = with_gradients(lambda *x: run(*x).float(), (half, radii, center))
    assert run(half, radii, center).dtype == torch.bfloat16
    expected, *expected_grads = with_gradients(run, (half.float(), radii, center))
    # The interpreter cuts off the digits that hardware rounds.
    torch.testing.assert_close(found, expected, rtol=2**-7, atol=0)
    assert [g.dtype for g in grads] == [torch.bfloat16, torch.float32, torch.float32]
    for got, want in zip(grads, expected_grads, strict=True):
        torch.testing.assert_close(got.float(), want, rtol=0.02, atol=0.02 * want.abs().max())


def test_images_of_a_batch_do_not_matter_to_each_other(on):
    """A gradient that is tiny beside another image's, or NaN there, is as exact as alone."""
    image, radii, center = make_inputs(batch=2, shared=True)
    leaf = image.clone().requires_grad_()
    out = on(sampler(8, (2, 4)))(leaf, radii, center)
    grad = torch.randn(out.shape, device=out.device)
    (both,) = torch.autograd.grad(out, leaf, grad, retain_graph=True)
    for factor in (1e-15, math.nan):
        scaled = torch.stack((grad[0] * factor, grad[1]))
        (found,) = torch.autograd.grad(out, leaf, scaled, retain_graph=True)
        assert torch.equal(found[1], both[1])
        expected = both[0] * factor if factor == factor else torch.full_like(both[0], math.nan)
        torch.testing.assert_close(found[0], expected, rtol=1e-5, atol=1e-21, equal_nan=True)


def test_autocast_gives_bfloat16(device):
    inputs = [t.to(device) for t in make_inputs()]
    expected = sampler(8, (2, 4))(*inputs)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        found = sampler(8, (2, 4))(*inputs)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found.float(), expected, rtol=2**-7, atol=0)


@pytest.mark.parametrize("wanted", [(True, True, True), (True, False, False), (False, True, False)])
def test_opcheck(wanted, device):
    tensors = [t.to(device) for t in make_inputs(batch=1, general=True)]
    amount = torch.tensor(0.5, dtype=torch.float64), torch.tensor(3)
    call = (*tensors[:2], azimuths(8).to(device), *tensors[2:], *amount, (2, 4), (), (), False)
    checks = dict(test_utils=("test_schema", "test_faketensor"))
    torch.library.opcheck(torch.ops.darswin.polar_sample.default, (*call, True), **checks)
    call = (*call, True, torch.randn(1, 1, 2, 24, device=device), *wanted)
    torch.library.opcheck(torch.ops.darswin.polar_sample_backward.default, call, **checks)
