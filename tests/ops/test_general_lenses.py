"""Both operators with general lenses: `affine` and `offsets`."""

import math

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_accurate, assert_equals_reference, with_gradients

from darswin.ops import polar_embed, polar_sample, use_reference

f64 = torch.float64
LAYOUTS = ("tokens", "image")
PARTS = {"affine": (True, False), "offsets": (False, True), "both": (True, True)}


def make_inputs(
    batch=2, channels=3, height=17, width=23, rows=6, columns=8, shared=False, far=1.0, dtype=f64
):
    """Image, radii, center, affine and offsets, and azimuths; points inside and outside.

    The matrix more than doubles some lengths; offsets are of `far` px, now and then of the image's
    size.
    """
    image = torch.randn(batch, channels, height, width, dtype=dtype)
    lenses = 1 if shared else batch
    radii = torch.rand(lenses, rows, dtype=dtype).sort(1).values * max(height, width) * 0.7
    center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=dtype)
    center = center + torch.rand(lenses, 2, dtype=dtype)
    affine = torch.eye(2, dtype=dtype) + 0.5 * torch.randn(lenses, 2, 2, dtype=dtype)
    offsets = far * torch.randn(lenses, 2, rows, columns, dtype=dtype)
    jumps = torch.rand(lenses, 1, rows, columns) < 0.1
    offsets = torch.where(jumps, offsets * max(height, width), offsets)
    azimuths = (torch.arange(columns, dtype=dtype) + 0.37) * (2 * math.pi / max(columns, 1))
    return image, radii, center, affine, offsets, azimuths


def sampler(azimuths, samples, parts="both", **options):
    """polar_sample of its differentiable inputs, of affine and offsets only `parts`."""

    def run(image, radii, center, *tensors):
        names = [n for n, given in zip(("affine", "offsets"), PARTS[parts], strict=True) if given]
        return polar_sample(
            image, radii, azimuths.to(radii.dtype), center, samples=samples,
            **dict(zip(names, tensors, strict=True)), **options,
        )  # fmt: skip

    return run


def embedder(azimuths, samples, **options):
    """polar_embed likewise, of weight and bias too."""
    return lambda image, radii, center, affine, offsets, weight, bias: polar_embed(
        image, radii, azimuths.to(radii.dtype), center, weight, bias,
        affine=affine, offsets=offsets, samples=samples, **options,
    )  # fmt: skip


def without_others(inputs, parts):
    """The differentiable inputs, of affine and offsets only `parts`."""
    image, radii, center, *rest = inputs
    given = [t for t, with_it in zip(rest, PARTS[parts], strict=True) if with_it]
    return image, radii, center, *given


def linear(depth, features=20, dtype=f64):
    weight = torch.randn(features, depth, dtype=dtype) / math.sqrt(depth or 1)
    return weight, torch.randn(features, dtype=dtype)


def mesh(radii, center, affine, offsets, azimuths):
    """x and y of the points, (B or 1, N_r, N_a) each, in float64."""
    radii, center, affine, offsets, azimuths = (
        t.double() for t in (radii, center, affine, offsets, azimuths)
    )
    directions = torch.stack((torch.cos(azimuths), torch.sin(azimuths)))
    points = torch.einsum("bxy,br,ya->bxra", affine, radii, directions)
    return (center[:, :, None, None] + points + offsets).unbind(1)


def away_from_borders(inputs, azimuths):
    """(B, 1, N_r, N_a): 1 at points not within 1e-3 px of where bilinear gradients jump, else 0."""
    image, *lens = inputs
    smooth = torch.stack([(v - v.round()).abs() > 1e-3 for v in mesh(*lens, azimuths)]).all(0)
    return smooth[:, None].expand(len(image), 1, -1, -1).double()


SHAPES = {
    # What csrc/kernels tells apart, and sizes at its edges.
    "plain": (dict(), (3, 4)),
    "shared lens": (dict(shared=True, batch=5), (2, 2)),
    "one point": (dict(rows=1, columns=1), (1, 1)),
    "odd rows": (dict(rows=3, columns=13), (1, 13)),
    "one pixel": (dict(height=1, width=1), (3, 2)),
    "empty batch": (dict(batch=0, shared=True), (3, 4)),
    "no lenses": (dict(batch=0), (3, 4)),
    "no points": (dict(rows=0, columns=8), (3, 4)),
    "no channels": (dict(channels=0), (3, 4)),
    "cells": (dict(height=31, width=33, rows=40, columns=64), (10, 8)),
    "cells, one channel": (dict(height=31, width=33, rows=40, columns=63, channels=1), (8, 3)),
    "packed, six channels": (dict(height=31, width=33, rows=40, columns=64, channels=6), (4, 4)),
    "packed, large": (dict(height=200, width=180, rows=80, columns=160, batch=1), (8, 8)),
    "in place": (dict(height=200, width=180, rows=8, columns=16), (4, 4)),
    "in place, large": (dict(height=400, width=390, rows=20, columns=16, batch=1), (4, 4)),
    "in place, shared": (dict(height=90, width=80, rows=8, columns=15, shared=True), (4, 5)),
    "long rows": (dict(height=31, width=33, rows=2, columns=3001, batch=1), (1, 3001)),
}
shapes = pytest.mark.parametrize("shape", SHAPES)
jitters = pytest.mark.parametrize("jitter", [0.0, 0.8])
references = pytest.mark.parametrize("reference", [False, True])


# -- where points stand ----------------------------------------------------------------------------


def test_equals_grid_sample():
    image, *lens, azimuths = make_inputs(rows=12, columns=16)
    height, width = image.shape[2:]
    x, y = mesh(*lens, azimuths)
    places = torch.stack((2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1), -1)
    expected = F.grid_sample(image, places, align_corners=True)
    got = sampler(azimuths, (1, 1), layout="image")(image, *lens)
    assert (expected != 0).double().mean() > 0.3
    torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-10)


@jitters
def test_a_rotation_turns_the_azimuths(jitter):
    image, radii, center, *_, azimuths = make_inputs()
    c, s = math.cos(0.4), math.sin(0.4)
    turn = torch.tensor([[[c, -s], [s, c]]], dtype=f64)
    options = dict(samples=(3, 4), jitter=jitter, seed=2)
    torch.testing.assert_close(
        polar_sample(image, radii, azimuths, center, affine=turn, **options),
        polar_sample(image, radii, azimuths + 0.4, center, **options),
    )


@jitters
def test_equal_offsets_move_the_center(jitter):
    image, radii, center, _, offsets, azimuths = make_inputs()
    shift = torch.tensor([1.5, -2.25], dtype=f64)
    options = dict(samples=(3, 4), jitter=jitter, seed=2)
    offsets = shift[None, :, None, None].expand_as(offsets)
    torch.testing.assert_close(
        polar_sample(image, radii, azimuths, center, offsets=offsets, **options),
        polar_sample(image, radii, azimuths, center + shift, **options),
    )


def test_jitter_moves_points_before_the_matrix_and_leaves_their_offsets():
    _, radii, _, affine, offsets, azimuths = make_inputs(batch=1, rows=12, columns=40)
    # An image whose channels are x and y: sampling it gives each point's place.
    x = torch.arange(256.0, dtype=f64).expand(256, 256)
    image, center = torch.stack((x, x.T))[None], torch.full((1, 2), 127.5, dtype=f64)
    options = dict(samples=(1, 1), jitter=0.9, seed=7, layout="image")
    moved = polar_sample(image, radii, azimuths, center, **options)[0] - 127.5
    still = polar_sample(image, radii, azimuths, center, samples=(1, 1), layout="image")[0] - 127.5
    assert (moved - still).abs().max() > 0.5
    got = polar_sample(
        image, radii, azimuths, center, affine=affine, offsets=offsets, **options
    )[0]  # fmt: skip
    expected = 127.5 + torch.einsum("xy,yra->xra", affine[0], moved) + offsets[0]
    torch.testing.assert_close(got, expected)


@pytest.mark.parametrize("dtype", [torch.float32, f64])
@pytest.mark.parametrize("shape", ["plain", "cells", "packed, large", "in place", "one pixel"])
@jitters
def test_an_identity_changes_no_bit(shape, jitter, dtype):
    sizes, samples = SHAPES[shape]
    image, radii, center, _, offsets, azimuths = make_inputs(**sizes, dtype=dtype)
    options = dict(samples=samples, jitter=jitter, seed=3)
    for part in (dict(affine=torch.eye(2, dtype=dtype)[None]), dict(offsets=0 * offsets)):
        results = [
            with_gradients(
                lambda i, r, c, given=given: polar_sample(
                    i, r, azimuths.to(dtype), c, **given, **options
                ),
                (image, radii, center),
            )
            for given in ({}, part)
        ]
        assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_points_thrown_far_outside_are_zero():
    image, radii, center, affine, offsets, azimuths = make_inputs(dtype=torch.float32)
    run = sampler(azimuths, (3, 4))
    for far in (60.0, 1e6, 1e12, 1e30, 3e38):
        for sign in (1, -1):
            assert (run(image, radii * 0, center, affine, offsets * 0 + sign * far) == 0).all()
            away = run(image, radii + 1, center, affine + sign * 1e3 * far, offsets)
            assert away.isfinite().all()


# -- against the reference -------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("parts", PARTS)
@jitters
@shapes
def test_equals_reference_in_float64(shape, jitter, parts, layout):
    sizes, samples = SHAPES[shape]
    *inputs, azimuths = make_inputs(**sizes)
    inputs = without_others(inputs, parts)
    run = sampler(azimuths, samples, parts, jitter=jitter, seed=3, layout=layout)
    assert_equals_reference(run, inputs, rtol=1e-9, atol=1e-9)


@jitters
@shapes
def test_embedding_equals_reference_in_float64(shape, jitter):
    sizes, samples = SHAPES[shape]
    *inputs, azimuths = make_inputs(**sizes)
    inputs += linear(samples[0] * samples[1] * inputs[0].shape[1])
    run = embedder(azimuths, samples, jitter=jitter, seed=3)
    assert_equals_reference(run, inputs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("layout", LAYOUTS)
@shapes
def test_accuracy_rule(shape, layout):
    sizes, samples = SHAPES[shape]
    azimuths = make_inputs(**sizes)[-1]

    def mask(*inputs):
        points = away_from_borders(inputs, azimuths).expand(-1, inputs[0].shape[1], -1, -1)
        if layout == "image":
            return points
        rings, sectors = points.shape[2] // samples[0], points.shape[3] // samples[1]
        points = points.unflatten(3, (sectors, samples[1])).unflatten(2, (rings, samples[0]))
        return points.permute(0, 2, 4, 3, 5, 1).flatten(3)

    assert_accurate(
        sampler(azimuths, samples, layout=layout),
        lambda: make_inputs(**sizes, dtype=torch.float32)[:-1],
        mask,
        draws=10,  # of six radii three draws are too few to measure rounding with
    )


@pytest.mark.parametrize("parts", PARTS)
def test_accuracy_rule_where_many_images_share_a_lens(parts):
    sizes = dict(batch=64, rows=8, columns=16, shared=True)
    azimuths = make_inputs(**sizes)[-1]
    smooth = {}

    def make():
        inputs = make_inputs(**sizes, dtype=torch.float32)[:-1]
        inputs[4].mul_(PARTS[parts][1])
        if not PARTS[parts][0]:
            inputs[3].copy_(torch.eye(2))
        smooth["mask"] = away_from_borders(inputs, azimuths)
        return without_others(inputs, parts)

    assert_accurate(sampler(azimuths, (1, 1), parts, layout="image"), make,
                    lambda *_: smooth["mask"])  # fmt: skip


@pytest.mark.parametrize("rows", [6, 60])  # far and near, see csrc/kernels/polar_image.h
@pytest.mark.parametrize("pixel", [torch.float32, torch.bfloat16, torch.uint8])
@jitters
def test_every_type_of_pixels(pixel, rows, jitter):
    image, *lens, azimuths = make_inputs(rows=rows, columns=40, dtype=torch.float32)
    image = (
        torch.randint(256, image.shape, dtype=pixel) if pixel == torch.uint8 else image.to(pixel)
    )
    run = sampler(azimuths, (3, 4), jitter=jitter, seed=2)
    weights = linear(3 * 4 * 3, dtype=torch.float32)
    embed = embedder(azimuths, (3, 4), jitter=jitter, seed=2)
    for operator, leaves in (
        (lambda *lens: run(image, *lens).float(), lens),
        (lambda *lens: embed(image, *lens).float(), (*lens, *weights)),
    ):
        ours = with_gradients(operator, leaves)
        with use_reference():
            expected = with_gradients(operator, leaves)
        tolerance = 1e-4 if pixel != torch.bfloat16 else 0.02
        for got, want in zip(ours, expected, strict=True):
            assert got.dtype == torch.float32
            torch.testing.assert_close(
                got, want, rtol=tolerance, atol=tolerance * want.abs().max().item()
            )


# -- gradients -------------------------------------------------------------------------------------


@jitters
def test_gradcheck(jitter):
    *inputs, azimuths = make_inputs(height=7, width=8, rows=4, columns=6)
    run = sampler(azimuths, (2, 3), jitter=jitter, seed=11)
    assert torch.autograd.gradcheck(run, [t.requires_grad_() for t in inputs])


def test_gradcheck_of_the_embedding():
    *inputs, azimuths = make_inputs(height=7, width=8, rows=4, columns=6)
    inputs += linear(18, features=3)
    run = embedder(azimuths, (2, 3), jitter=0.5, seed=1)
    assert torch.autograd.gradcheck(run, [t.requires_grad_() for t in inputs])


@jitters
def test_a_shared_lens_gets_the_sum_over_the_images(jitter):
    image, *lens, azimuths = make_inputs(batch=4, shared=True)
    run = sampler(azimuths, (3, 4), jitter=jitter, seed=1)
    rows = [t.expand(4, *t.shape[1:]).contiguous() for t in lens]
    out, grad_image, *grads = with_gradients(run, (image, *lens))
    for index in range(4):
        # Each alone of the four is shared, then all of them.
        leaves = [lens[k] if k == index else rows[k] for k in range(4)]
        own = with_gradients(run, (image, *leaves))
        torch.testing.assert_close(own[2 + index], grads[index], rtol=1e-12, atol=1e-12)
    own_out, own_image, *own_grads = with_gradients(run, (image, *rows))
    assert torch.equal(own_out, out) and torch.equal(own_image, grad_image)
    for got, own in zip(grads, own_grads, strict=True):
        assert got.shape[0] == 1
        torch.testing.assert_close(got, own.sum(0, keepdim=True), rtol=1e-12, atol=1e-12)


def test_only_the_gradients_asked_for():
    *inputs, azimuths = make_inputs(dtype=torch.float32)
    weights = linear(36, dtype=torch.float32)
    for run, leaves in (
        (sampler(azimuths, (3, 4)), inputs),
        (embedder(azimuths, (3, 4)), (*inputs, *weights)),
    ):
        full = with_gradients(run, leaves)
        for index in range(len(leaves)):
            alone = [t.detach().requires_grad_(k == index) for k, t in enumerate(leaves)]
            out = run(*alone)
            grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(7))
            (got,) = torch.autograd.grad(out, alone[index], grad)
            assert torch.equal(got, full[index + 1])


def test_strided_lenses():
    image, radii, center, affine, offsets, azimuths = make_inputs()
    plain = with_gradients(sampler(azimuths, (3, 4)), (image, radii, center, affine, offsets))
    wide = torch.randn(2, 8, 6, 2, dtype=f64)
    wide.transpose(1, 3)[:] = offsets
    strided = [image, radii, center, affine.mT.contiguous().mT, wide.transpose(1, 3)]
    assert not strided[3].is_contiguous() and not strided[4].is_contiguous()
    got = with_gradients(sampler(azimuths, (3, 4)), strided)
    for a, b in zip(got, plain, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


# -- NaN and infinity ------------------------------------------------------------------------------


@references
@jitters
@pytest.mark.parametrize("rows", [6, 60])  # far and near
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_points_at_nan_or_infinity_sample_nothing(bad, rows, jitter, reference):
    image, radii, center, affine, offsets, azimuths = make_inputs(
        rows=rows, columns=40, dtype=torch.float32
    )
    run = sampler(azimuths, (1, 1), jitter=jitter, seed=5, layout="image")
    good = run(image, radii, center, affine, offsets)
    for place in ((0, 0), (0, 1), (1, 0), (1, 1)):
        broken = affine.clone()
        broken[0][place] = bad
        with use_reference(reference):
            out, *grads = with_gradients(run, (image, radii, center, broken, offsets))
        assert (out[0] == 0).all()
        torch.testing.assert_close(out[1], good[1], rtol=1e-4, atol=1e-4)
        assert all(grad.isfinite().all() and (grad[0] == 0).all() for grad in grads)
    for axis in (0, 1):
        broken = offsets.clone()
        broken[1, axis, 2, 5] = bad
        with use_reference(reference):
            out, *grads = with_gradients(run, (image, radii, center, affine, broken))
        assert (out[1, :, 2, 5] == 0).all()
        assert (grads[-1][1, :, 2, 5] == 0).all()
        assert all(grad.isfinite().all() for grad in grads)
        out[1, :, 2, 5] = good[1, :, 2, 5]
        torch.testing.assert_close(out, good, rtol=1e-4, atol=1e-4)


@references
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_bad_radii_keep_to_themselves(bad, reference):
    image, radii, center, affine, offsets, azimuths = make_inputs(dtype=torch.float32)
    radii[0, 2] = bad
    with use_reference(reference):
        out, *grads = with_gradients(
            sampler(azimuths, (1, 1), layout="image"), (image, radii, center, affine, offsets)
        )
    assert (out[0, :, 2] == 0).all() and (out[0] != 0).any()
    assert all(grad.isfinite().all() for grad in grads)
    assert grads[1][0, 2] == 0 and (grads[4][0, :, 2] == 0).all()


# -- threads ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("batch", [1, 5])  # a batch of one is cut into bands of rows
@jitters
@shapes
def test_same_bits_for_any_number_of_threads(threads, shape, jitter, batch, shared):
    sizes, samples = SHAPES[shape]
    sizes = sizes | dict(batch=batch, shared=shared, dtype=torch.float32)
    *inputs, azimuths = make_inputs(**sizes)
    weights = linear(samples[0] * samples[1] * inputs[0].shape[1], dtype=torch.float32)
    run, embed = (make(azimuths, samples, jitter=jitter, seed=1) for make in (sampler, embedder))
    results = []
    for count in (1, 2, 7):
        threads(count)
        image_alone = [t.detach().requires_grad_(k == 0) for k, t in enumerate(inputs)]
        out = embed(*image_alone, *weights)
        (fused,) = torch.autograd.grad(out.square().sum(), image_alone[0])
        results.append(
            [*with_gradients(run, inputs), *with_gradients(embed, (*inputs, *weights)), fused]
        )
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("far", [0.5, 40.0, 1e4])
def test_bands_get_what_offsets_bring_them(threads, far):
    *inputs, azimuths = make_inputs(batch=1, height=200, width=180, rows=80, columns=160, far=far)
    run = sampler(azimuths, (8, 8))
    threads(1)
    with use_reference():
        expected = with_gradients(run, inputs)
    threads(7)
    for got, want in zip(with_gradients(run, inputs), expected, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)


# -- torch's own machinery -------------------------------------------------------------------------


@pytest.mark.parametrize("requires_grad", [False, True])
@pytest.mark.parametrize("parts", PARTS)
def test_opcheck(requires_grad, parts):
    image, radii, center, affine, offsets, azimuths = make_inputs(dtype=torch.float32)
    weight, bias = linear(36, dtype=torch.float32)
    for tensor in (image, radii, center, affine, offsets, weight, bias):
        tensor.requires_grad_(requires_grad)
    with_affine, with_offsets = PARTS[parts]
    lens = (radii, azimuths, center, affine if with_affine else None,
            offsets if with_offsets else None)  # fmt: skip
    sampling = (image, *lens, torch.tensor(0.5).double(), torch.tensor(5), (3, 4), (), (), False)
    torch.library.opcheck(torch.ops.darswin.polar_sample.default, (*sampling, True))
    torch.library.opcheck(torch.ops.darswin.polar_embed.default, (*sampling, weight, bias))


@pytest.mark.parametrize("lens_grad", [False, True])
@pytest.mark.parametrize("offsets_grad", [False, True])
def test_opcheck_backward(lens_grad, offsets_grad):
    image, radii, center, affine, offsets, azimuths = make_inputs(dtype=torch.float32)
    weight, _ = linear(36, dtype=torch.float32)
    wanted = (False, lens_grad, offsets_grad)
    lens = (radii, azimuths, center, affine, offsets)
    sampling = (image, *lens, None, None, (3, 4), (), (), False)
    sample, embed = torch.ops.darswin.polar_sample_backward, torch.ops.darswin.polar_embed_backward
    sample_arguments = (*sampling, True, torch.randn(2, 2, 2, 36), *wanted)
    embed_arguments = (*sampling, weight, torch.randn(2, 2, 2, 20), *wanted, True)
    for operator, arguments in ((sample, sample_arguments), (embed, embed_arguments)):
        torch.library.opcheck(
            operator.default, arguments, test_utils=("test_schema", "test_faketensor")
        )
        grads = operator(*arguments)
        for grad, like, given in zip(
            grads, (image, radii, center, affine, offsets),
            (False, lens_grad, lens_grad, lens_grad, offsets_grad), strict=False,
        ):  # fmt: skip
            assert grad.shape == (like.shape if given else (0,))


@pytest.mark.unsanitized
def test_compile_fullgraph():
    *inputs, azimuths = make_inputs(dtype=torch.float32)

    def run(*inputs):
        return sampler(azimuths, (3, 4), jitter=0.5, seed=torch.tensor(4))(*inputs) * 2

    compiled = torch.compile(run, fullgraph=True)
    for got, want in zip(
        with_gradients(compiled, inputs), with_gradients(run, inputs), strict=True
    ):
        torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6)


@pytest.mark.unsanitized
def test_export():
    class Module(torch.nn.Module):
        def forward(self, image, radii, center, affine, offsets, azimuths):
            return polar_sample(
                image, radii, azimuths, center, affine=affine, offsets=offsets, samples=(3, 4)
            )

    arguments = make_inputs(dtype=torch.float32)
    program = torch.export.export(Module(), arguments)
    assert torch.equal(program.module()(*arguments), Module()(*arguments))


# -- errors ----------------------------------------------------------------------------------------


@references
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(affine="no"), TypeError, "affine must be a tensor, got str"),
        (dict(affine=torch.eye(2)), ValueError,
         r"affine must have shape \(B or 1, 2, 2\) = \(2 or 1, 2, 2\), got \(2, 2\)"),
        (dict(affine=torch.zeros(3, 2, 2)), ValueError, "affine must have shape"),
        (dict(affine=torch.zeros(2, 2, 3)), ValueError, "affine must have shape"),
        (dict(affine=torch.zeros(2, 2, 2).double()), TypeError, "affine must be float32, got"),
        (dict(affine=torch.zeros(2, 2, 2, device="meta")), ValueError, "affine must be on the"),
        (dict(offsets="no"), TypeError, "offsets must be a tensor, got str"),
        (dict(offsets=torch.zeros(2, 6, 8)), ValueError,
         r"offsets must have shape \(B or 1, 2, R·S_r, A·S_φ\) = \(2 or 1, 2, 6, 8\), "
         r"got \(2, 6, 8\)"),
        (dict(offsets=torch.zeros(2, 2, 8, 6)), ValueError, "offsets must have shape"),
        (dict(offsets=torch.zeros(3, 2, 6, 8)), ValueError, "offsets must have shape"),
        (dict(offsets=torch.zeros(2, 2, 6, 8).long()), TypeError, "offsets must be float32, got"),
    ],
)  # fmt: skip
def test_errors_say_what_was_expected(change, error, message, reference):
    image, radii, center, affine, offsets, azimuths = make_inputs(dtype=torch.float32)
    weight, _ = linear(36, dtype=torch.float32)
    arguments = dict(
        image=image, radii=radii, azimuths=azimuths, center=center, affine=affine, offsets=offsets,
        samples=(3, 4),
    )  # fmt: skip
    with use_reference(reference):
        with pytest.raises(error, match=message):
            polar_sample(**(arguments | change))
        with pytest.raises(error, match=message):
            polar_embed(**(arguments | change), weight=weight)


def test_the_compiled_operator_itself_reads_nothing_outside():
    # Without the checks of the public function, wrong sizes must still not crash.
    image, radii, center, affine, offsets, azimuths = make_inputs(dtype=torch.float32)
    for bad in (
        dict(affine=torch.zeros(2, 2)), dict(affine=torch.zeros(3, 2, 2)),
        dict(affine=affine.double()), dict(affine=torch.tensor(1.0)),
        dict(offsets=offsets[:, :1]), dict(offsets=offsets[:, :, 1:]),
        dict(offsets=offsets[..., 1:]), dict(offsets=offsets.double()),
        dict(offsets=torch.zeros(3, 2, 6, 8)),
    ):  # fmt: skip
        lens = dict(affine=affine, offsets=offsets) | bad
        with pytest.raises(RuntimeError, match="affine or offsets"):
            torch.ops.darswin.polar_sample(
                image, radii, azimuths, center, lens["affine"], lens["offsets"], None, None, (3, 4),
                (), (), False, True,
            )  # fmt: skip
