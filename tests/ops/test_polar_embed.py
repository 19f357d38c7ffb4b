import math

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_accurate, with_gradients

from darswin.ops import polar_embed, polar_sample, use_reference


def make_inputs(
    batch=2,
    channels=3,
    size=31,
    rings=3,
    sectors=8,
    samples=(4, 5),
    features=20,
    dtype=torch.float32,
):
    """Image, radii, center, weight and bias, and azimuths."""
    image = torch.randn(batch, channels, size, size + 2, dtype=dtype)
    radii = torch.rand(batch, rings * samples[0], dtype=dtype).sort(1).values * size * 0.6
    center = (size - 1) / 2 + torch.rand(batch, 2, dtype=dtype)
    depth = samples[0] * samples[1] * channels
    weight = torch.randn(features, depth, dtype=dtype) / math.sqrt(depth or 1)
    bias = torch.randn(features, dtype=dtype)
    columns = sectors * samples[1]
    azimuths = (torch.arange(columns, dtype=dtype) + 0.37) * (2 * math.pi / max(columns, 1))
    return image, radii, center, weight, bias, azimuths


def embedder(azimuths, samples, **options):
    """polar_embed as a function of its differentiable inputs."""
    return lambda image, radii, center, weight, bias: polar_embed(
        image, radii, azimuths.to(radii.dtype), center, weight, bias, samples=samples, **options
    )


def two_steps(azimuths, samples, **options):
    def run(image, radii, center, weight, bias):
        grid = (radii, azimuths.to(radii.dtype), center)
        return F.linear(polar_sample(image, *grid, samples=samples, **options), weight, bias)

    return run


SHAPES = {
    "plain": dict(),
    "paper": dict(size=64, rings=2, sectors=64, samples=(10, 10), features=96, batch=1),
    "one token": dict(rings=1, sectors=1, samples=(1, 1), features=1, channels=1),
    "odd": dict(rings=3, sectors=7, samples=(3, 3), features=37, channels=2),
    "many features": dict(features=200, sectors=5),
    "deep": dict(samples=(12, 12), features=50, channels=4, sectors=3),
    "six channels": dict(channels=6, features=48),
    "large image": dict(size=300, rings=2, sectors=4),
    "empty batch": dict(batch=0),
    "no rings": dict(rings=0),
    "no channels": dict(channels=0),
    "no features": dict(features=0),
}


@pytest.mark.parametrize("jitter", [0.0, 0.8])
@pytest.mark.parametrize("shape", SHAPES)
def test_equals_the_two_steps_in_float64(shape, jitter):
    sizes = SHAPES[shape]
    *inputs, azimuths = make_inputs(**sizes, dtype=torch.float64)
    options = dict(jitter=jitter, seed=3)
    samples = sizes.get("samples", (4, 5))
    ours = with_gradients(embedder(azimuths, samples, **options), inputs)
    expected = with_gradients(two_steps(azimuths, samples, **options), inputs)
    with use_reference():
        reference = with_gradients(embedder(azimuths, samples, **options), inputs)
    for got, want, oracle in zip(ours, expected, reference, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-11, atol=1e-11)
        torch.testing.assert_close(got, oracle, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_accuracy_rule(shape):
    # Bilinear gradients with respect to the lens jump at pixel borders; the others do not.
    sizes, lens = SHAPES[shape], make_inputs(**SHAPES[shape])[1:3]
    azimuths, samples = make_inputs(**sizes)[-1], sizes.get("samples", (4, 5))

    def run(image, weight, bias):
        grid = (lens[0].to(image.dtype), azimuths.to(image.dtype), lens[1].to(image.dtype))
        return polar_embed(image, *grid, weight, bias, samples=samples)

    def make():
        image, _, _, weight, bias, _ = make_inputs(**sizes)
        return image, weight, bias

    assert_accurate(run, make)


def test_gradcheck():
    *inputs, azimuths = make_inputs(
        size=7, rings=2, sectors=3, samples=(2, 2), features=3, dtype=torch.float64
    )
    run = embedder(azimuths, (2, 2), jitter=0.5, seed=1)
    assert torch.autograd.gradcheck(run, [t.requires_grad_() for t in inputs])


@pytest.mark.parametrize("requires_grad", [False, True])
@pytest.mark.parametrize("with_bias", [False, True])
def test_opcheck(requires_grad, with_bias):
    image, radii, center, weight, bias, azimuths = make_inputs()
    for tensor in (image, radii, center, weight, bias):
        tensor.requires_grad_(requires_grad)
    settings = (torch.tensor(0.5).double(), torch.tensor(5), (4, 5), (), (), False)
    parameters = (weight, bias if with_bias else None)
    arguments = (image, radii, azimuths, center, None, None, *settings, *parameters)
    torch.library.opcheck(torch.ops.darswin.polar_embed.default, arguments)


def test_only_the_gradients_asked_for():
    *inputs, azimuths = make_inputs()
    full = with_gradients(embedder(azimuths, (4, 5)), inputs)
    for index in range(len(inputs)):
        leaves = [t.detach().requires_grad_(k == index) for k, t in enumerate(inputs)]
        out = embedder(azimuths, (4, 5))(*leaves)
        grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(7))
        (got,) = torch.autograd.grad(out, leaves[index], grad)
        assert torch.equal(got, full[index + 1])


def test_without_bias():
    image, radii, center, weight, bias, azimuths = make_inputs()
    out = polar_embed(image, radii, azimuths, center, weight, samples=(4, 5))
    expected = polar_embed(image, radii, azimuths, center, weight, 0 * bias, samples=(4, 5))
    assert torch.equal(out, expected)
    weight.requires_grad_()
    polar_embed(image, radii, azimuths, center, weight, samples=(4, 5)).sum().backward()
    assert weight.grad.shape == weight.shape


@pytest.mark.parametrize("batch", [1, 5])
@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_same_bits_for_any_number_of_threads(threads, batch, jitter):
    *inputs, azimuths = make_inputs(batch=batch, rings=5)
    run = embedder(azimuths, (4, 5), jitter=jitter, seed=1)
    results = []
    for count in (1, 2, 3, 7):
        threads(count)
        image_alone = [t.detach().requires_grad_(k == 0) for k, t in enumerate(inputs)]
        (fused,) = torch.autograd.grad(run(*image_alone).square().sum(), image_alone[0])
        results.append([*with_gradients(run, inputs), fused])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_image_gradient_alone_equals_that_with_the_lens():
    # Without lens gradients those of the samples are not written either.
    *inputs, azimuths = make_inputs(batch=4)
    run = embedder(azimuths, (4, 5))
    together = with_gradients(run, inputs)[1]
    leaves = [t.detach().requires_grad_(k == 0) for k, t in enumerate(inputs)]
    out = run(*leaves)
    grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(7))
    assert torch.equal(torch.autograd.grad(out, leaves[0], grad)[0], together)


@pytest.mark.parametrize("reference", [False, True])
def test_autocast(reference):
    *inputs, azimuths = make_inputs(sectors=16, features=96)
    run = embedder(azimuths, (4, 5))
    expected = with_gradients(run, inputs)

    def half(*leaves):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            out = run(*leaves)
        assert out.dtype == torch.bfloat16
        return out.float()

    with use_reference(reference):
        results = with_gradients(half, inputs)
    for got, want in zip(results, expected, strict=True):
        assert got.dtype == torch.float32
        torch.testing.assert_close(got, want, rtol=0.02, atol=0.02 * want.abs().max().item())


def test_bfloat16_weights_and_image():
    image, radii, center, weight, bias, azimuths = make_inputs()
    half = [image.bfloat16(), weight.bfloat16(), bias.bfloat16()]
    leaves = [t.requires_grad_() for t in half]
    out = polar_embed(leaves[0], radii, azimuths, center, *leaves[1:], samples=(4, 5))
    wide = [t.detach().float() for t in half]
    expected = polar_embed(wide[0], radii, azimuths, center, *wide[1:], samples=(4, 5))
    assert torch.equal(out, expected.bfloat16())
    grads = torch.autograd.grad(out.float().sum(), leaves)
    assert all(g.dtype == torch.bfloat16 and g.shape == t.shape
               for g, t in zip(grads, leaves, strict=True))  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "given"),
    [((2, 31, 33, 3), None), ((2, 3, 31, 3), False), ((2, 31, 3, 3), True), ((2, 3, 31, 33), None)],
)
def test_uint8_frames(shape, given):
    _, radii, center, weight, bias, azimuths = make_inputs()
    frames = torch.randint(256, shape, dtype=torch.uint8)
    options = dict(mean=0.4, std=(0.2, 0.3, 0.25), channels_last=given)
    weight.requires_grad_()
    run = embedder(azimuths, (4, 5), **options)
    ours = run(frames, radii, center, weight, bias)
    expected = two_steps(azimuths, (4, 5), **options)(frames, radii, center, weight, bias)
    torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-5)
    grad = torch.randn(ours.shape)
    for got, want in zip(
        torch.autograd.grad(ours, weight, grad),
        torch.autograd.grad(expected, weight, grad),
        strict=True,
    ):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-3)


@pytest.mark.unsanitized
def test_compile_fullgraph():
    *inputs, azimuths = make_inputs()

    def run(image, radii, center, weight, bias):
        seed = torch.tensor(4)
        out = polar_embed(
            image, radii, azimuths, center, weight, bias, samples=(4, 5), jitter=0.5, seed=seed
        )
        return out * 2

    compiled = torch.compile(run, fullgraph=True)
    for got, want in zip(
        with_gradients(compiled, inputs), with_gradients(run, inputs), strict=True
    ):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(weight=torch.zeros(20, 61)), ValueError, r"weight must have shape .*\(any, 60\)"),
        (dict(weight=torch.zeros(60)), ValueError, r"weight must have shape .*, got \(60,\)"),
        (
            dict(weight=torch.zeros(20, 60).double()),
            TypeError,
            "weight must be float32 or bfloat16",
        ),
        (dict(bias=torch.zeros(21)), ValueError, r"bias must have shape \(D,\) = \(20,\), got"),
        (dict(bias="no"), TypeError, "bias must be a tensor, got str"),
        (dict(samples=(5, 5)), ValueError, "must divide"),
        (dict(jitter=2.0), ValueError, r"jitter must be in \[0, 1\]"),
        (dict(image=torch.zeros(2, 3, 31, 3).byte()), ValueError, "pass channels_last=True"),
    ],
)
def test_errors_say_what_was_expected(change, error, message, reference):
    image, radii, center, weight, bias, azimuths = make_inputs()
    arguments = dict(
        image=image, radii=radii, azimuths=azimuths, center=center, weight=weight, bias=bias,
        samples=(4, 5),
    )  # fmt: skip
    with use_reference(reference), pytest.raises(error, match=message):
        polar_embed(**(arguments | change))


def test_errors_of_uint8_statistics():
    _, radii, center, weight, bias, azimuths = make_inputs()
    frames = torch.zeros(2, 3, 31, 33, dtype=torch.uint8)
    for change, message in (
        (dict(mean=(0.1, 0.2)), r"mean must be one number or one a channel, 3, got \(0.1, 0.2\)"),
        (dict(std=0.0), "std must be positive, got 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            polar_embed(frames, radii, azimuths, center, weight, bias, samples=(4, 5), **change)


def test_the_compiled_operator_itself_reads_nothing_outside():
    image, radii, center, weight, bias, azimuths = make_inputs()
    for bad_weight, bad_bias in (
        (torch.zeros(20, 59), bias), (torch.zeros(60), bias), (weight, torch.zeros(19)),
    ):  # fmt: skip
        with pytest.raises(RuntimeError):
            torch.ops.darswin.polar_embed(
                image, radii, azimuths, center, None, None, None, None, (4, 5), (), (), False,
                bad_weight, bad_bias,
            )  # fmt: skip


def test_gradients_of_very_many_tokens_are_as_accurate_as_torch():
    # 131,072 tokens: sums of float32 one by one had 12 times torch's error.
    radii, azimuths = torch.linspace(1, 6, 64)[None], torch.linspace(0, 6.2, 512)
    image, center = torch.randn(4, 1, 12, 12), torch.full((1, 2), 5.5)
    grad = torch.randn(4, 64, 512, 3) + 0.5

    def gradients(dtype):
        weight = torch.ones(3, 1, dtype=dtype, requires_grad=True)
        bias = torch.zeros(3, dtype=dtype, requires_grad=True)
        grid = (t.to(dtype) for t in (image, radii, azimuths, center))
        out = polar_embed(*grid, weight, bias, samples=(1, 1))
        return torch.autograd.grad(out, (weight, bias), grad.to(dtype))

    ours = gradients(torch.float32)
    with use_reference():
        own, exact = gradients(torch.float32), gradients(torch.float64)
    for got, base, want in zip(ours, own, exact, strict=True):
        rounding = torch.finfo(torch.float32).eps * want.abs().max()
        assert (got - want).abs().max() <= max(2 * (base - want).abs().max(), rounding)
