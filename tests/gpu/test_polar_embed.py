"""polar_embed on the kernels of polar_sample: the accuracy rule, and what is the linear layer's. Of
points and pixels test_polar_sample.py asks."""

import pytest
import torch
from gpu.test_polar_sample import azimuths, make_inputs, smooth
from helpers import assert_accurate, with_gradients

from darswin.ops import polar_embed, use_reference


def embedder(columns, samples, **options):
    """polar_embed as a function of its differentiable inputs."""
    angles = azimuths(columns)

    def run(image, radii, center, weight, bias=None):
        grid = (image, radii, angles.to(radii), center)
        return polar_embed(*grid, weight, bias, samples=samples, **options)

    return run


def smooth_tokens(columns, samples, **options):
    """As `smooth`: a token has a gradient if all of its samples may have one."""
    points = smooth(columns, samples, **options)
    return lambda image, radii, center, *layer: points(image, radii, center).amin(-1, keepdim=True)


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_accuracy_rule(jitter, bias, on):
    options = dict(jitter=jitter, seed=5)

    def make():
        layer = [torch.randn(7, 24), torch.randn(7)]
        return *make_inputs(batch=2), *layer[: 1 + bias]

    run = on(embedder(8, (2, 4), **options))
    assert_accurate(run, make, smooth_tokens(8, (2, 4), **options))


def test_a_token_without_a_gradient_leaves_the_images_gradient_right(on):
    def other_tokens(*inputs):
        mask = smooth_tokens(8, (2, 2))(*inputs)
        mask.view(2, -1)[:, :2] = 0  # the first ones of both images
        return mask

    def make():
        return *make_inputs(), torch.randn(7, 12)

    assert_accurate(on(embedder(8, (2, 2))), make, other_tokens)


def test_only_the_layer_is_learned(on):
    image, radii, center = make_inputs()
    run, layer = embedder(8, (2, 4)), (torch.randn(7, 24), torch.randn(7))
    found = with_gradients(lambda *layer: on(run)(image, radii, center, *layer), layer)
    with use_reference():
        expected = with_gradients(lambda *layer: run(image, radii, center, *layer), layer)
    for got, want in zip(found, expected, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


def test_bfloat16(device):
    image, radii, center = (t.to(device) for t in make_inputs())
    weight, bias = torch.randn(7, 24, device=device), torch.randn(7, device=device)
    run, half = embedder(8, (2, 4)), image.bfloat16()
    # The samples are not rounded, nor are the products, even where autocast would.
    expected = run(half.float(), radii, center, weight, bias).bfloat16()
    assert torch.equal(run(half, radii, center, weight, bias), expected)
    with torch.autocast(device.type, dtype=torch.bfloat16):
        assert torch.equal(run(half.float(), radii, center, weight, bias), expected)
    narrow = with_gradients(
        lambda *x: run(*x).float(), (half, radii, center, weight.bfloat16(), bias.bfloat16())
    )
    wide = with_gradients(
        run, (half.float(), radii, center, *(t.bfloat16().float() for t in (weight, bias)))
    )
    assert torch.equal(narrow[0], wide[0].bfloat16().float())
    for got, want in zip(narrow[1:], wide[1:], strict=True):
        torch.testing.assert_close(got.float(), want, rtol=0.02, atol=0.02 * want.abs().max())


@pytest.mark.parametrize("sizes", [dict(batch=0, shared=True), dict(rows=0), dict(channels=0)])
def test_nothing_to_embed(sizes, on):
    inputs = *make_inputs(**sizes), torch.randn(7, 8 * sizes.get("channels", 3)), torch.randn(7)
    results = with_gradients(on(embedder(8, (2, 4))), inputs)
    with use_reference():
        expected = with_gradients(embedder(8, (2, 4)), inputs)
    for got, want in zip(results, expected, strict=True):
        torch.testing.assert_close(got, want)


@pytest.mark.parametrize("wanted", [(True, True, False, True), (False, False, False, True),
                                    (True, False, False, False)])  # fmt: skip
def test_opcheck(wanted, device):
    image, radii, center = (t.to(device) for t in make_inputs(batch=1))
    weight = torch.randn(7, 24, device=device)
    call = (image, radii, azimuths(8).to(device), center, None, None, None, None, (2, 4), (), (),
            False, weight)  # fmt: skip
    checks = dict(test_utils=("test_schema", "test_faketensor"))
    torch.library.opcheck(torch.ops.darswin.polar_embed.default, (*call, None), **checks)
    call = (*call, torch.randn(1, 1, 2, 7, device=device), *wanted)
    torch.library.opcheck(torch.ops.darswin.polar_embed_backward.default, call, **checks)
