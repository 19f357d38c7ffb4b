import math
import time

import pytest
import torch
import torch.nn.functional as F
from helpers import assert_accurate, assert_equals_reference, with_gradients

from darswin.ops import _module, cpu_capability, polar_sample, reference_in_use, use_reference
from darswin.ops.reference import philox

LAYOUTS = ("tokens", "image")


def make_inputs(
    batch=2, channels=3, height=17, width=23, rows=6, columns=8, shared=False, dtype=torch.float32
):
    """Image, radii and center, and azimuths; points inside, on the border and outside."""
    image = torch.randn(batch, channels, height, width, dtype=dtype)
    lenses = 1 if shared else batch
    radii = torch.rand(lenses, rows, dtype=dtype).sort(1).values * max(height, width) * 0.7
    center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=dtype)
    center = center + torch.rand(lenses, 2, dtype=dtype)
    azimuths = (torch.arange(columns, dtype=dtype) + 0.37) * (2 * math.pi / max(columns, 1))
    return image, radii, center, azimuths


def sampler(azimuths, samples, **options):
    """polar_sample as a function of its differentiable inputs."""
    return lambda image, radii, center: polar_sample(
        image, radii, azimuths.to(radii.dtype), center, samples=samples, **options
    )


def away_from_borders(image, radii, center, azimuths, samples, layout):
    """1 at points that are not within 1e-3 px of where a bilinear gradient jumps, else 0."""
    r, a = radii.double()[:, :, None], azimuths.double()
    xy = (center.double()[:, 0, None, None] + r * torch.cos(a),
          center.double()[:, 1, None, None] + r * torch.sin(a))  # fmt: skip
    smooth = torch.stack([(v - v.round()).abs() > 1e-3 for v in xy]).all(0).double()
    points = smooth[:, None].expand(len(image), image.shape[1], -1, -1)
    if layout == "image":
        return points
    rings, sectors = radii.shape[1] // samples[0], len(azimuths) // samples[1]
    points = points.unflatten(3, (sectors, samples[1])).unflatten(2, (rings, samples[0]))
    return points.permute(0, 2, 4, 3, 5, 1).flatten(3)


SHAPES = {
    "plain": (dict(), (3, 4)),
    "shared lens": (dict(shared=True), (2, 2)),
    "one ring, one sector": (dict(rows=4, columns=3), (4, 3)),
    "one point": (dict(rows=1, columns=1), (1, 1)),
    "one pixel": (dict(height=1, width=1), (3, 2)),
    "thin image": (dict(height=1, width=37, channels=1), (1, 8)),
    "many channels": (dict(channels=33, batch=1), (2, 4)),
    "many points": (dict(rows=40, columns=64, height=31, width=33), (10, 8)),
    "empty batch": (dict(batch=0, shared=True), (3, 4)),
    "no points": (dict(rows=0, columns=8), (3, 4)),
    "no channels": (dict(channels=0), (3, 4)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("jitter", [0.0, 0.8])
@pytest.mark.parametrize("shape", SHAPES)
def test_equals_reference_in_float64(shape, jitter, layout):
    sizes, samples = SHAPES[shape]
    *inputs, azimuths = make_inputs(**sizes, dtype=torch.float64)
    run = sampler(azimuths, samples, jitter=jitter, seed=3, layout=layout)
    assert_equals_reference(run, inputs, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("shape", SHAPES)
def test_accuracy_rule(shape, layout):
    sizes, samples = SHAPES[shape]
    azimuths = make_inputs(**sizes)[-1]
    assert_accurate(
        sampler(azimuths, samples, layout=layout),
        lambda: make_inputs(**sizes)[:-1],
        lambda *inputs: away_from_borders(*inputs, azimuths, samples, layout),
    )


@pytest.mark.parametrize("scale", [1e-30, 1e30], ids=["tiny pixels", "huge pixels"])
def test_accuracy_rule_at_extreme_values(scale):
    azimuths = make_inputs(rows=40, columns=32)[-1]

    def make():
        image, radii, center, _ = make_inputs(rows=40, columns=32)
        return image * scale, radii, center

    assert_accurate(
        sampler(azimuths, (4, 4)),
        make,
        lambda *inputs: away_from_borders(*inputs, azimuths, (4, 4), "tokens"),
    )


def test_accuracy_rule_where_all_points_meet():
    # Every point of the innermost rings falls into one pixel: the longest sums of all.
    azimuths = make_inputs(columns=512)[-1]

    def make():
        image, _, center, _ = make_inputs(batch=1)
        return image, torch.linspace(0, 0.4, 64)[None], center.round() + 0.5

    assert_accurate(
        sampler(azimuths, (8, 8)),
        make,
        lambda *inputs: away_from_borders(*inputs, azimuths, (8, 8), "tokens"),
    )


def test_equals_grid_sample():
    image, radii, center, azimuths = make_inputs(rows=12, columns=16, dtype=torch.float64)
    height, width = image.shape[2:]
    x = center[:, 0, None, None] + radii[:, :, None] * torch.cos(azimuths)
    y = center[:, 1, None, None] + radii[:, :, None] * torch.sin(azimuths)
    mesh = torch.stack((2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1), -1)
    expected = F.grid_sample(image, mesh, align_corners=True)
    got = polar_sample(image, radii, azimuths, center, samples=(1, 1), layout="image")
    torch.testing.assert_close(got, expected, rtol=1e-10, atol=1e-10)


def test_layouts_hold_the_same_samples():
    image, radii, center, azimuths = make_inputs(rows=6, columns=8)
    planes = polar_sample(image, radii, azimuths, center, samples=(3, 4), layout="image")
    tokens = polar_sample(image, radii, azimuths, center, samples=(3, 4), layout="tokens")
    assert tokens.shape == (2, 2, 2, 36) and planes.shape == (2, 3, 6, 8)
    # Token (ring 1, sector 0), inner order (S_r, S_φ, C).
    torch.testing.assert_close(
        tokens[0, 1, 0].reshape(3, 4, 3), planes[0, :, 3:6, 0:4].permute(1, 2, 0), rtol=0, atol=0
    )


@pytest.mark.parametrize("jitter", [0.0, 0.6])
def test_gradcheck(jitter):
    *inputs, azimuths = make_inputs(height=7, width=8, rows=4, columns=6, dtype=torch.float64)
    run = sampler(azimuths, (2, 3), jitter=jitter, seed=11)
    assert torch.autograd.gradcheck(run, [t.requires_grad_() for t in inputs])


@pytest.mark.parametrize("requires_grad", [False, True])
@pytest.mark.parametrize("jitter", [0.0, 0.5])
def test_opcheck(requires_grad, jitter):
    image, radii, center, azimuths = make_inputs()
    for tensor in (image, radii, center):
        tensor.requires_grad_(requires_grad)
    moved = (torch.tensor(jitter, dtype=torch.float64), torch.tensor(5)) if jitter else (None, None)
    settings = (None, None, *moved, (3, 4), (), (), False)
    arguments = (image, radii, azimuths, center, *settings, True)
    torch.library.opcheck(torch.ops.darswin.polar_sample.default, arguments)


def test_opcheck_backward():
    image, radii, center, azimuths = make_inputs()
    grad = torch.randn(2, 2, 2, 36)
    for wanted in ((True, True, False), (True, False, False), (False, True, False)):
        settings = (None, None, None, None, (3, 4), (), (), False)
        arguments = (image, radii, azimuths, center, *settings, True, grad, *wanted)
        torch.library.opcheck(
            torch.ops.darswin.polar_sample_backward.default,
            arguments,
            test_utils=("test_schema", "test_faketensor"),
        )


def test_no_second_derivative():
    image, radii, center, azimuths = make_inputs()
    for reference in (True, False):
        with use_reference(reference):
            out = polar_sample(image.requires_grad_(), radii, azimuths, center, samples=(3, 4))
        (grad,) = torch.autograd.grad(out.square().sum(), image, create_graph=True)
        if reference:
            grad.sum().backward()
            continue
        with pytest.raises(NotImplementedError, match="no second derivative"):
            grad.sum().backward()


def test_only_the_gradients_asked_for():
    image, radii, center, azimuths = make_inputs()
    full = with_gradients(sampler(azimuths, (3, 4)), (image, radii, center))
    names = ("image", "radii", "center")
    for index, name in enumerate(names):
        inputs = dict(zip(names, (image, radii, center), strict=True))
        leaf = inputs[name] = inputs[name].detach().requires_grad_()
        out = polar_sample(
            inputs["image"], inputs["radii"], azimuths, inputs["center"], samples=(3, 4)
        )
        grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(7))
        (got,) = torch.autograd.grad(out, leaf, grad)
        assert torch.equal(got, full[index + 1])


@pytest.mark.unsanitized
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_compile_fullgraph(backend):
    *inputs, azimuths = make_inputs()
    seed = torch.tensor(4)

    def run(image, radii, center):
        out = polar_sample(image, radii, azimuths, center, samples=(3, 4), jitter=0.5, seed=seed)
        return out * 2

    compiled = torch.compile(run, fullgraph=True, backend=backend)
    for got, want in zip(
        with_gradients(compiled, inputs), with_gradients(run, inputs), strict=True
    ):
        torch.testing.assert_close(got, want, rtol=1e-6, atol=1e-6)


@pytest.mark.unsanitized
def test_compiled_training_does_not_respecialise_on_the_seed():
    image, radii, center, azimuths = make_inputs()
    counter = torch._dynamo.testing.CompileCounter()

    @torch.compile(fullgraph=True, backend=counter)
    def run(seed):
        return polar_sample(image, radii, azimuths, center, samples=(3, 4), jitter=0.5, seed=seed)

    outputs = [run(torch.tensor(seed)) for seed in range(3)]
    assert counter.frame_count == 1
    assert not torch.equal(outputs[0], outputs[1])


@pytest.mark.unsanitized
def test_export():
    class Module(torch.nn.Module):
        def forward(self, image, radii, azimuths, center):
            return polar_sample(image, radii, azimuths, center, samples=(3, 4))

    image, radii, center, azimuths = make_inputs()
    arguments = (image, radii, azimuths, center)
    program = torch.export.export(Module(), arguments)
    assert torch.equal(program.module()(*arguments), Module()(*arguments))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("jitter", [0.0, 0.5])
@pytest.mark.parametrize("shared", [False, True])
def test_same_bits_for_any_number_of_threads(threads, dtype, jitter, shared):
    *inputs, azimuths = make_inputs(batch=5, rows=30, columns=40, shared=shared, dtype=dtype)
    run = sampler(azimuths, (3, 4), jitter=jitter, seed=1)
    results = []
    for count in (1, 2, 3):
        threads(count)
        results.append(with_gradients(run, inputs))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_strided_inputs():
    image, radii, center, azimuths = make_inputs(dtype=torch.float64)
    plain = with_gradients(sampler(azimuths, (3, 4)), (image, radii, center))
    wide = torch.randn(2, 6, 34, 46, dtype=torch.float64)
    wide[:, ::2, ::2, ::2] = image
    strided = (
        wide[:, ::2, ::2, ::2],
        torch.stack((radii, radii), 2)[:, :, 0],
        torch.stack((center, center), 2)[:, :, 0],
    )
    variants = [strided, (image.contiguous(memory_format=torch.channels_last), radii, center)]
    for inputs in variants:
        assert any(not t.is_contiguous() for t in inputs)
        # As leaves they would be copied; a view of a leaf keeps its strides.
        got = polar_sample(
            inputs[0], inputs[1], azimuths.repeat_interleave(2)[::2], inputs[2], samples=(3, 4)
        )
        assert torch.equal(got, plain[0])
        leaves = [t.requires_grad_() if t.is_leaf else t for t in inputs]
        out = sampler(azimuths, (3, 4))(*leaves)
        grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(7)).double()
        for a, b in zip(torch.autograd.grad(out, leaves, grad), plain[1:], strict=True):
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_expanded_image_and_gradient():
    image, radii, center, azimuths = make_inputs(batch=1)
    image.requires_grad_()
    many = polar_sample(image.expand(4, -1, -1, -1), radii, azimuths, center, samples=(3, 4))
    one = polar_sample(image, radii, azimuths, center, samples=(3, 4))
    assert torch.equal(many[3], one[0])
    (grad,) = torch.autograd.grad(many.sum(), image)  # stride 0 comes back
    (expected,) = torch.autograd.grad(one.sum(), image)
    torch.testing.assert_close(grad, 4 * expected)


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30, -1e30])
def test_points_at_nan_or_infinity_sample_nothing(bad, reference):
    image, radii, center, azimuths = make_inputs(rows=4, columns=6)
    good = polar_sample(image, radii, azimuths, center, samples=(1, 1), layout="image")
    broken = radii.clone()
    broken[0, 2] = bad
    with use_reference(reference):
        out, grad_image, grad_radii, grad_center = with_gradients(
            sampler(azimuths, (1, 1), layout="image"), (image, broken, center)
        )
        assert (out[0, :, 2] == 0).all()
        torch.testing.assert_close(out[1], good[1])
        assert grad_radii[0, 2] == 0
        for grad in (grad_image, grad_radii, grad_center):
            assert grad.isfinite().all()
        lost = center.clone()
        lost[1, 0] = bad
        assert (polar_sample(image, radii, azimuths, lost, samples=(1, 1))[1] == 0).all()
        for jitter in (0.0, 1.0):
            turned = azimuths.clone()
            turned[3] = bad
            out = polar_sample(image, radii, turned, center, samples=(1, 1), jitter=jitter,
                               layout="image")  # fmt: skip
            assert (out[..., 3] == 0).all() or abs(bad) == 1e30
            assert out.isfinite().all()


@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_jitter_keeps_bad_radii_to_themselves(jitter):
    image, radii, center, azimuths = make_inputs(rows=6, columns=6)
    radii[0, 2] = math.nan
    out = polar_sample(
        image, radii, azimuths, center, samples=(1, 1), jitter=jitter, layout="image"
    )
    assert out.isfinite().all()
    assert (out[0, :, 2] == 0).all()
    assert (out[0, :, 0] != 0).any()


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_jitter_moves_no_radius_from_infinity_to_the_center(bad, rows, reference):
    image, radii, center, azimuths = make_inputs(rows=rows, columns=40)
    radii[:, 0] = bad
    with use_reference(reference):
        out = polar_sample(
            image, radii, azimuths, center, samples=(1, 1), jitter=1.0, layout="image"
        )
    assert (out[:, :, 0] == 0).all()


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_bad_pixel_spoils_only_the_points_that_touch_it(bad, reference):
    image = torch.ones(1, 1, 9, 9)
    image[0, 0, 4, 4] = bad
    radii, center = torch.tensor([[0.5, 2.5, 4.5]]), torch.tensor([[4.0, 4.0]])
    with use_reference(reference):
        out = polar_sample(
            image, radii, torch.tensor([0.1, 1.7]), center, samples=(1, 1), layout="image"
        )
    assert not out[0, 0, 0].isfinite().any()
    assert out[0, 0, 1:].isfinite().all()


def test_outside_is_zero():
    image = torch.ones(1, 1, 5, 5)
    radii = torch.tensor([[1.5, 2.25, 2.999, 3.0, 50.0]])
    out = polar_sample(
        image, radii, torch.zeros(1), torch.tensor([[2.0, 2.0]]), samples=(1, 1), layout="image"
    )
    torch.testing.assert_close(out.flatten(), torch.tensor([1.0, 0.75, 0.001, 0.0, 0.0]))


def test_indices_beyond_two_to_the_31():
    # The pages of a fresh tensor are not there before they are written: this costs little memory.
    side = 46400
    image = torch.empty(1, 1, side, side)
    if image.numel() <= 2**31:
        pytest.fail("the image must have more than 2^31 pixels")
    image[0, 0, side - 4 :, side - 4 :] = torch.arange(16.0).reshape(4, 4)
    center = torch.tensor([[side - 3.0, side - 3.0]])
    out = polar_sample(
        image, torch.tensor([[0.0, 1.0]]), torch.zeros(1), center, samples=(1, 1), layout="image"
    )
    assert out.flatten().tolist() == [5.0, 6.0]


def test_sizes_beyond_two_to_the_31():
    side = 2**31 + 8
    image = torch.ones(1, 1, 1, 1, dtype=torch.float64).expand(1, 1, side, side)
    center = torch.tensor([[2.0**31, 2.0**31]], dtype=torch.float64)
    radii = torch.tensor([[0.0, 3.5, 100.0]], dtype=torch.float64)
    azimuths = torch.zeros(1, dtype=torch.float64)
    out = polar_sample(image, radii, azimuths, center, samples=(1, 1), layout="image")
    assert out.flatten().tolist() == [1.0, 1.0, 0.0]


# -- jitter ---------------------------------------------------------------------------------------


def coordinates_image(size=64):
    """An image whose channels are x and y: sampling it gives each point's place."""
    y, x = torch.meshgrid(
        torch.arange(size, dtype=torch.float64),
        torch.arange(size, dtype=torch.float64),
        indexing="ij",
    )
    return torch.stack((x, y))[None]


def places(radii, azimuths, jitter, seed, size=64):
    """Radius and azimuth at which the points of one image really stand, (N_r, N_a) each."""
    middle = torch.full((1, 2), (size - 1) / 2, dtype=torch.float64)
    out = polar_sample(coordinates_image(size), radii, azimuths, middle, samples=(1, 1),
                       jitter=jitter, seed=seed, layout="image")  # fmt: skip
    x, y = out[0] - (size - 1) / 2
    return torch.hypot(x, y), torch.atan2(y, x)


def test_jitter_moves_points_as_said():
    radii = torch.tensor([[4.0, 7.0, 8.0, 20.0]], dtype=torch.float64)
    azimuths = (torch.arange(16, dtype=torch.float64) + 0.5) * (2 * math.pi / 16) - math.pi
    seed, jitter = 1234, 0.75
    r, a = places(radii, azimuths, jitter, seed)
    point = torch.arange(64)
    words = torch.stack(philox(torch.tensor(seed), point // 4, torch.tensor(0)))
    word = words[point % 4, point].reshape(4, 16)
    u, v = ((half / 2**16 - 0.5).double() * jitter for half in (word >> 16, word & 0xFFFF))
    outer = torch.tensor([3.0, 1.0, 12.0, 12.0], dtype=torch.float64)[:, None]
    inner = torch.tensor([3.0, 3.0, 1.0, 12.0], dtype=torch.float64)[:, None]
    expected = radii.T + u * torch.where(u < 0, inner, outer)
    torch.testing.assert_close(r, expected)
    torch.testing.assert_close(a, azimuths + v * (2 * math.pi / 16))


def test_jitter_is_uniform_and_independent():
    radii = torch.arange(8.0, 24.0, dtype=torch.float64)[None]
    azimuths = torch.linspace(-3, 3, 400, dtype=torch.float64)
    r, a = places(radii, azimuths, 1.0, seed=9)
    u = (r - radii.T)[1:-1].flatten()
    v = ((a - azimuths) / (2 * math.pi / 400))[1:-1].flatten()
    for offset in (u, v):
        assert offset.min() >= -0.5 - 1e-9 and offset.max() < 0.5 + 1e-9
        assert abs(offset.mean()) < 0.02 and abs(offset.std() - 12**-0.5) < 0.01
    assert abs(torch.corrcoef(torch.stack((u, v)))[0, 1]) < 0.05


def test_jitter_never_gives_a_negative_radius():
    radii = torch.tensor([[0.0, 8.0]], dtype=torch.float64)
    azimuths = torch.zeros(500, dtype=torch.float64)
    r, _ = places(radii, azimuths, 1.0, seed=2)
    assert (r[0] >= 0).all() and (r[0] < 1e-9).float().mean() > 0.3  # about half are clamped
    assert r[0].max() > 1


def test_seed_as_int_and_as_tensor_and_per_image():
    image, radii, center, azimuths = make_inputs(batch=2, shared=True)
    image = image[:1].expand(2, -1, -1, -1)

    def run(seed, images=image):
        return polar_sample(images, radii, azimuths, center, samples=(3, 4), jitter=1.0, seed=seed)

    for seed in (0, 7, 2**62, -(2**63), 2**63 - 1):
        assert torch.equal(run(seed), run(torch.tensor(seed)))
    assert not torch.equal(run(7), run(8))
    assert not torch.equal(run(7)[0], run(7)[1])  # each image has its own numbers
    assert torch.equal(run(7)[:1], run(7, image[:1]))  # whatever else is in the batch
    assert torch.equal(run(3), run(3))


def test_without_jitter_the_seed_does_nothing():
    image, radii, center, azimuths = make_inputs()
    a, b = (polar_sample(image, radii, azimuths, center, samples=(3, 4), seed=s) for s in (0, 1))
    assert torch.equal(a, b)


# -- the switch, autocast, errors ----------------------------------------------------------------


def test_reference_switch(monkeypatch):
    image, radii, center, azimuths = make_inputs()
    assert not reference_in_use()
    with use_reference():
        assert reference_in_use()
        with use_reference(False):
            assert not reference_in_use()
        out = polar_sample(image.requires_grad_(), radii, azimuths, center, samples=(3, 4))
        names, nodes = set(), [out.grad_fn]
        while nodes:
            node = nodes.pop()
            names.add(type(node).__name__)
            nodes += [n for n, _ in node.next_functions if n is not None]
        assert any("Gather" in name for name in names)
    assert not reference_in_use()


def test_other_devices_run_torch():
    image, radii, center, azimuths = (t.to("meta") for t in make_inputs())
    out = polar_sample(image, radii, azimuths, center, samples=(3, 4))
    assert out.shape == (2, 2, 2, 36) and out.device.type == "meta"


# -- types -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("jitter", [0.0, 0.7])
def test_bfloat16_is_computed_in_float32_and_rounded_once(layout, jitter):
    image, radii, center, azimuths = make_inputs(rows=30, columns=40)
    half = image.bfloat16()
    run = sampler(azimuths, (3, 4), jitter=jitter, seed=2, layout=layout)
    out, *grads = with_gradients(lambda *x: run(*x).float(), (half, radii, center))
    expected, *expected_grads = with_gradients(run, (half.float(), radii, center))
    assert run(half, radii, center).dtype == torch.bfloat16
    assert torch.equal(out, expected.bfloat16().float())
    assert [g.dtype for g in grads] == [torch.bfloat16, torch.float32, torch.float32]
    # The gradient that arrives is rounded to bfloat16 as well.
    for got, want in zip(grads, expected_grads, strict=True):
        torch.testing.assert_close(got.float(), want, rtol=0.02, atol=0.02 * want.abs().max())
    with use_reference():
        reference, *reference_grads = with_gradients(
            lambda *x: run(*x).float(), (half, radii, center)
        )
    torch.testing.assert_close(reference, out, rtol=2**-7, atol=1e-3)
    for got, want in zip(grads, reference_grads, strict=True):
        torch.testing.assert_close(
            got.float(), want.float(), rtol=0.02, atol=0.02 * want.abs().max()
        )


def test_bfloat16_rounds_to_nearest_even_and_keeps_nan():
    values = torch.tensor([1.0, 1.00390625, 1.01171875, 3.4e38, math.inf, math.nan, -1e-40, -0.0])
    image = values.reshape(1, 1, 1, -1)
    for columns in (8, 3):  # whole registers and less
        center = torch.tensor([[0.0, 0.0]])
        radii = torch.arange(float(columns))[None]
        with torch.autocast("cpu", dtype=torch.bfloat16):
            out = polar_sample(image, radii, torch.zeros(1), center, samples=(1, 1))
        expected = polar_sample(image, radii, torch.zeros(1), center, samples=(1, 1)).bfloat16()
        torch.testing.assert_close(out, expected, rtol=0, atol=0, equal_nan=True)


def test_autocast_gives_bfloat16():
    image, radii, center, azimuths = make_inputs()
    expected = polar_sample(image, radii, azimuths, center, samples=(3, 4))
    for reference in (False, True):
        with use_reference(reference), torch.autocast("cpu", dtype=torch.bfloat16):
            out = polar_sample(image.requires_grad_(), radii, azimuths, center, samples=(3, 4))
        assert out.dtype == torch.bfloat16
        torch.testing.assert_close(out.float(), expected, rtol=2**-7, atol=1e-3)
        (grad,) = torch.autograd.grad(out.float().sum(), image)
        assert grad.dtype == torch.float32
    double = [t.double() for t in (image, radii, azimuths, center)]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert polar_sample(*double, samples=(3, 4)).dtype == torch.float64


def test_autocast_takes_float16_as_float32():
    image, radii, center, azimuths = make_inputs()
    half = image.half()
    with torch.autocast("cpu", dtype=torch.float16):
        out = polar_sample(half, radii, azimuths, center, samples=(3, 4))
    expected = polar_sample(half.float(), radii, azimuths, center, samples=(3, 4))
    assert torch.equal(out, expected)
    with pytest.raises(TypeError, match=r"image must be .* or uint8, got torch.float16"):
        polar_sample(half, radii, azimuths, center, samples=(3, 4))


@pytest.mark.parametrize("rows", [6, 60])  # far and near, see csrc/kernels/polar_image.h
@pytest.mark.parametrize("layout", LAYOUTS)
def test_uint8_frames(layout, rows):
    _, radii, center, azimuths = make_inputs(rows=rows, columns=40)
    frames = torch.randint(256, (2, 17, 23, 3), dtype=torch.uint8)
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    planes = frames.permute(0, 3, 1, 2)
    normalised = (planes / 255 - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[
        :, None, None
    ]
    run = sampler(azimuths, (3, 4), layout=layout)
    for image in (frames, planes, planes.contiguous()):
        for reference in (False, True):
            with use_reference(reference):
                out = polar_sample(image, radii, azimuths, center, samples=(3, 4), layout=layout,
                                   mean=mean, std=std)  # fmt: skip
                expected = run(normalised, radii, center)
            torch.testing.assert_close(out, expected, rtol=1e-5, atol=1e-5)
            # The reference normalises what it has gathered, by the same operations.
            assert not reference or torch.equal(out, expected)
    plain = polar_sample(frames, radii, azimuths, center, samples=(3, 4), layout=layout)
    torch.testing.assert_close(plain, run(planes / 255, radii, center), rtol=1e-5, atol=1e-6)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = polar_sample(frames, radii, azimuths, center, samples=(3, 4), layout=layout)
    assert torch.equal(half, plain.bfloat16())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_images_that_are_not_uint8_count_as_they_are(dtype):
    image, radii, center, azimuths = make_inputs(
        dtype=torch.float64 if dtype == torch.float64 else torch.float32
    )
    run = sampler(azimuths, (3, 4), mean=0.5, std=(0.2, 0.3, 0.25))
    plain = sampler(azimuths, (3, 4))(image.to(dtype), radii, center)
    for reference in (False, True):
        with use_reference(reference):
            out = run(image.to(dtype), radii, center)
        torch.testing.assert_close(out, plain)


READINGS = [  # shape, channels_last as it is given, and what is read
    ((2, 17, 23, 1), None, True),
    ((2, 17, 23, 3), None, True),
    ((2, 17, 23, 4), None, True),
    ((2, 1, 17, 23), None, False),
    ((2, 3, 17, 23), None, False),
    ((2, 4, 17, 23), None, False),
    ((2, 12, 23, 3), None, True),
    ((2, 3, 23, 12), None, False),
    ((2, 1, 1, 1), None, False),
    ((2, 1, 17, 3), False, False),
    ((2, 1, 17, 3), True, True),
    ((2, 3, 17, 3), False, False),
    ((2, 3, 17, 3), True, True),
    ((2, 12, 17, 23), False, False),
    ((2, 17, 23, 12), True, True),
]


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize(("shape", "given", "last"), READINGS)
def test_which_axis_of_an_image_has_its_channels(shape, given, last, reference):
    frames = torch.randint(256, shape, dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2) if last else frames
    height, width = planes.shape[2:]
    _, radii, center, azimuths = make_inputs(height=height, width=width)
    run = sampler(azimuths, (3, 4))
    expected = run(planes / 255, radii, center)
    with use_reference(reference):
        got = sampler(azimuths, (3, 4), channels_last=given)(frames, radii, center)
        torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
        if given is not None:  # holds for an image of any type
            got = sampler(azimuths, (3, 4), channels_last=given)(frames / 255, radii, center)
            torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", [(2, 17, 3, 3), (2, 3, 17, 1), (2, 17, 23, 4), (2, 12, 9, 8)])
def test_an_image_in_floating_point_has_its_channels_first(shape):
    image = torch.rand(shape)
    _, radii, center, azimuths = make_inputs(height=shape[2], width=shape[3])
    run = sampler(azimuths, (3, 4))
    expected = with_gradients(run, (image, radii, center))
    told = sampler(azimuths, (3, 4), channels_last=False)
    for got, want in zip(with_gradients(told, (image, radii, center)), expected, strict=True):
        assert torch.equal(got, want)
    last = sampler(azimuths, (3, 4), channels_last=True)
    out, grad, *others = with_gradients(last, (image.permute(0, 2, 3, 1), radii, center))
    for got, want in zip((out, grad.permute(0, 3, 1, 2), *others), expected, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


@pytest.mark.unsanitized
@pytest.mark.parametrize("last", [False, True])
def test_one_graph_for_uint8_images_of_any_size(last):
    from torch._dynamo.testing import CompileCounter

    _, radii, center, azimuths = make_inputs()
    run = sampler(azimuths, (3, 4))
    torch._dynamo.reset()
    counter = CompileCounter()
    compiled = torch.compile(run, fullgraph=True, dynamic=True, backend=counter)
    for height, width in ((17, 23), (23, 17), (12, 5), (6, 40)):
        image = torch.randint(256, (2, 3, height, width), dtype=torch.uint8)
        image = image.permute(0, 2, 3, 1).contiguous() if last else image
        assert torch.equal(compiled(image, radii, center), run(image, radii, center))
    assert counter.frame_count == 1


def test_uint8_frames_have_lens_gradients():
    _, radii, center, azimuths = make_inputs()
    frames = torch.randint(256, (2, 3, 17, 23), dtype=torch.uint8)

    def run(radii, center):
        return polar_sample(frames, radii, azimuths, center, samples=(3, 4))

    expected = with_gradients(
        lambda r, c: sampler(azimuths, (3, 4))(frames / 255, r, c), (radii, center)
    )
    for got, want in zip(with_gradients(run, (radii, center)), expected, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


# -- near and far images, threads ------------------------------------------------------------------


PATHS = {
    # What csrc/kernels tells apart.
    "cells": dict(height=31, width=33, rows=40, columns=64),
    "cells, one channel": dict(height=31, width=33, rows=40, columns=64, channels=1),
    "cells, two channels": dict(height=31, width=33, rows=40, columns=64, channels=2),
    "cells, four channels": dict(height=31, width=33, rows=40, columns=64, channels=4),
    "packed, six channels": dict(height=31, width=33, rows=40, columns=64, channels=6),
    "packed, 64 channels": dict(height=16, width=17, rows=20, columns=32, channels=64, batch=1),
    "packed, large": dict(height=200, width=180, rows=80, columns=160, batch=1),
    "in place": dict(height=200, width=180, rows=8, columns=16),
    "in place, large": dict(height=400, width=390, rows=20, columns=16, batch=1),
    "many tokens": dict(height=31, width=33, rows=80, columns=640, batch=1),
    "long rows": dict(height=31, width=33, rows=2, columns=3000, batch=1),
    "long tokens": dict(height=31, width=33, rows=60, columns=120, batch=1),
    "narrow patches": dict(height=31, width=33, rows=40, columns=63, channels=1),
}
PATCHES = {
    "many tokens": (10, 10),
    "long rows": (1, 3000),
    "long tokens": (60, 60),
    "narrow patches": (8, 3),
}


@pytest.mark.parametrize("jitter", [0.0, 1.0])
@pytest.mark.parametrize("path", PATHS)
def test_every_path_equals_the_reference_in_float64(path, jitter):
    *inputs, azimuths = make_inputs(**PATHS[path], dtype=torch.float64)
    run = sampler(azimuths, PATCHES.get(path, (4, 4)), jitter=jitter, seed=3)
    ours = with_gradients(run, inputs)
    with use_reference():
        expected = with_gradients(run, inputs)
    for got, want in zip(ours, expected, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("path", PATHS)
def test_accuracy_rule_on_every_path(path, layout):
    azimuths, samples = make_inputs(**PATHS[path])[-1], PATCHES.get(path, (4, 4))
    assert_accurate(
        sampler(azimuths, samples, layout=layout),
        lambda: make_inputs(**PATHS[path])[:-1],
        lambda *inputs: away_from_borders(*inputs, azimuths, samples, layout),
    )


@pytest.mark.parametrize("jitter", [0.0, 1.0])
@pytest.mark.parametrize("path", PATHS)
def test_same_bits_for_any_number_of_threads_on_every_path(threads, path, jitter):
    # A batch of one is cut into as many bands of rows as there are threads.
    *inputs, azimuths = make_inputs(**PATHS[path] | dict(batch=1))
    run = sampler(azimuths, PATCHES.get(path, (4, 4)), jitter=jitter, seed=1)
    results = []
    for count in (1, 2, 3, 7):
        threads(count)
        results.append(with_gradients(run, inputs))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("columns", [16, 400])
def test_jitter_is_the_same_on_every_path_and_tier(columns):
    # Odd counts of points, so that rows begin in the middle of a group of four random words.
    image, radii, center, azimuths = make_inputs(rows=9, columns=columns - 1)
    results = []
    best = cpu_capability()
    for tier in _module.tiers():
        _module.set_tier(tier)
        results.append(
            polar_sample(image, radii, azimuths, center, samples=(3, 1), jitter=1.0, seed=5)
        )
    _module.set_tier(best)
    with use_reference():
        results.append(
            polar_sample(image, radii, azimuths, center, samples=(3, 1), jitter=1.0, seed=5)
        )
    for other in results[1:]:
        torch.testing.assert_close(other, results[0], rtol=1e-4, atol=1e-4)


def test_nothing_is_written_beyond_the_last_token():
    # Rows of three channels are stored four at a time.
    image, radii, center, azimuths = make_inputs(batch=1, rows=40, columns=64, height=31, width=33)
    for channels in (1, 2, 3):
        for count in (1, 2, 3):  # rings that different threads may write
            whole = polar_sample(image[:, :channels], radii, azimuths, center, samples=(4, 4))
            part = polar_sample(
                image[:, :channels], radii[:, : 4 * count], azimuths, center, samples=(4, 4)
            )
            assert torch.equal(part, whole[:, :count])


f32 = torch.float32


@pytest.mark.parametrize("reference", [False, True])
@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (dict(image="no"), TypeError, "image must be a tensor, got str"),
        (dict(image=torch.zeros(2, 3, 17)), ValueError, r"\(B, C, H, W\), got \(2, 3, 17\)"),
        (dict(image=torch.zeros(2, 3, 17, 23).int()), TypeError, "image must be float32"),
        (
            dict(radii=torch.zeros(2, 6).double()),
            TypeError,
            "radii must be float32, got",
        ),
        (dict(radii=torch.zeros(2, 6, device="meta")), ValueError, "radii must be on the same"),
        (dict(radii=torch.zeros(3, 6)), ValueError, r"radii must have shape .*\(2 or 1, any\)"),
        (dict(radii=torch.zeros(6)), ValueError, r"radii must have shape .*, got \(6,\)"),
        (dict(radii=torch.zeros(2, 7)), ValueError, r"must divide .* \(7, 8\), got \(3, 4\)"),
        (dict(radii=None), TypeError, "radii must be a tensor, got NoneType"),
        (dict(azimuths=torch.zeros(1, 8)), ValueError, r"azimuths must have shape \(A·S_φ,\)"),
        (dict(azimuths=torch.zeros(9)), ValueError, "must divide"),
        (dict(center=torch.zeros(2)), ValueError, r"center must have shape .*, got \(2,\)"),
        (dict(center=torch.zeros(2, 3)), ValueError, "center must have shape"),
        (dict(center=torch.zeros(3, 2)), ValueError, "center must have shape"),
        (dict(samples=(0, 4)), ValueError, "samples must be at least 1"),
        (dict(samples=3), TypeError, "samples must be a pair of ints, got 3"),
        (dict(samples=(3.0, 4)), TypeError, "samples must be a pair of ints"),
        (dict(jitter=1.5), ValueError, r"jitter must be in \[0, 1\], got 1.5"),
        (dict(jitter=-0.1), ValueError, r"jitter must be in \[0, 1\]"),
        (dict(jitter=math.nan), ValueError, r"jitter must be in \[0, 1\]"),
        (dict(jitter="much"), TypeError, "jitter must be a float"),
        (dict(jitter=0.5, seed=1.5), TypeError, "seed must be an int"),
        (dict(jitter=0.5, seed=2**63), ValueError, "seed must fit 64 bits"),
        (dict(jitter=0.5, seed=torch.zeros(1).long()), ValueError, "0-dim int64 tensor"),
        (dict(jitter=0.5, seed=torch.tensor(1.0)), ValueError, "0-dim int64 tensor"),
        (dict(layout="planes"), ValueError, "layout must be one of"),
        (dict(image=torch.zeros(2, 1, 17, 3).byte()), ValueError, r"1, 3 or 4 channels .* both"),
        (dict(image=torch.zeros(2, 3, 17, 3).byte()), ValueError, r"both .* \(2, 3, 17, 3\): pass"),
        (dict(image=torch.zeros(2, 4, 4, 4).byte()), ValueError, "pass channels_last=True for"),
        (dict(image=torch.zeros(2, 12, 17, 23).byte()), ValueError, r"neither .* \(2, 12, 17, 23"),
        (dict(channels_last=1), TypeError, "channels_last must be True, False or None, got 1"),
    ],
)
def test_errors_say_what_was_expected(change, error, message, reference):
    image, radii, center, azimuths = make_inputs()
    arguments = dict(image=image, radii=radii, azimuths=azimuths, center=center, samples=(3, 4))
    with use_reference(reference), pytest.raises(error, match=message):
        polar_sample(**(arguments | change))


def test_the_compiled_operator_itself_reads_nothing_outside():
    # Without the checks of the public function, wrong sizes must still not crash.
    image, radii, center, azimuths = make_inputs()
    good = (image, radii, azimuths, center, None, None, None, None, (3, 4), (), (), False, True)
    for index, value in {
        0: torch.zeros(3), 1: torch.zeros(3, 6), 3: torch.zeros(1, 1), 6: torch.tensor(0.5),
        8: (0, 4),
    }.items():  # fmt: skip
        arguments = [value if k == index else v for k, v in enumerate(good)]
        with pytest.raises(RuntimeError):
            torch.ops.darswin.polar_sample(*arguments)


@pytest.mark.parametrize(
    ("size", "rows", "columns"),
    [(9, 6, 12), (40, 8, 1031), (40, 1, 2500), (700, 12, 90), (9, 7, 1)],
)
def test_the_patch_does_not_matter_to_an_image(size, rows, columns):
    """Near and far images, rows longer than a block, and rows of no other divisor than 1."""
    image = torch.randn(2, 3, size, size)
    radii, azimuths = torch.linspace(0, size / 2, rows)[None], torch.linspace(0, 6.28, columns)
    center = torch.full((1, 2), (size - 1) / 2)
    arguments = (image, radii, azimuths, center)
    sampled = [
        polar_sample(*arguments, samples=samples, layout="image", jitter=1.0, seed=3)
        for samples in ((1, 1), (1, columns), (rows, 1), (rows, columns))
    ]
    assert all(torch.equal(sampled[0], other) for other in sampled[1:])
    with use_reference():
        expected = polar_sample(*arguments, samples=(1, 1), layout="image", jitter=1.0, seed=3)
    # The reference computes places in float32.
    torch.testing.assert_close(sampled[0], expected, rtol=0, atol=2e-6 * (10 + size))


@pytest.mark.parametrize("columns", [1025, 1026, 1027, 2049])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("channels", [1, 2, 3])
def test_a_token_longer_than_a_block_ends_where_it_ends(channels, dtype, columns, threads):
    """What is left of it behind a block may be less than the block's last store writes."""
    image = torch.rand(2, channels, 30, 30, dtype=dtype)
    radii = torch.linspace(1, 12, 3, dtype=dtype)[None]
    azimuths = torch.linspace(0, 6, columns, dtype=dtype)
    arguments = (image, radii, azimuths, torch.full((1, 2), 14.5, dtype=dtype))
    threads(1)
    alone = polar_sample(*arguments, samples=(1, columns))
    threads(2)
    for _ in range(20):
        assert torch.equal(polar_sample(*arguments, samples=(1, columns)), alone)
    with use_reference():
        expected = polar_sample(*arguments, samples=(1, columns))
    torch.testing.assert_close(alone, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.uint8])
@pytest.mark.parametrize("samples", [(4, 5), (3, 2), (1, 1), (6, 40)])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
def test_the_layout_of_a_far_image_does_not_matter(channels, samples, dtype):
    """Planes, pixels whose channels lie together, both with gaps, and one value after another."""
    size = 150  # far: more than four pixels for each of the 24 x 120 points
    image = (torch.rand(2, channels, size, size) * 255).to(dtype)
    radii = torch.stack((torch.linspace(0, 75, 24), torch.linspace(10, 90, 24)))
    arguments = (radii, torch.linspace(0, 6.2, 120), torch.full((1, 2), 74.5))
    options = dict(mean=[0.5] * channels, std=[0.25] * channels, channels_last=False)
    layouts = {"together": image.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)}
    layouts["padded"] = F.pad(layouts["together"].permute(0, 2, 3, 1), (0, 3))[..., :channels]
    layouts["padded"] = layouts["padded"].permute(0, 3, 1, 2)
    layouts["wide"] = torch.stack((image, image), -1)[..., 0]
    layouts["turned"] = image.transpose(2, 3).contiguous().transpose(2, 3)
    for output in ("tokens", "image"):
        planes = polar_sample(image, *arguments, samples=samples, layout=output, **options)
        with use_reference():
            expected = polar_sample(image, *arguments, samples=samples, layout=output, **options)
        torch.testing.assert_close(planes, expected, rtol=1e-2, atol=0.05)
        for name, other in layouts.items():
            assert torch.equal(other, image)
            sampled = polar_sample(other, *arguments, samples=samples, layout=output, **options)
            assert torch.equal(sampled, planes), name


@pytest.mark.unsanitized
def test_an_image_of_patches_of_one_point_is_as_fast_as_one_of_whole_rows(threads):
    threads(1)
    image, center = torch.rand(2, 3, 64, 64), torch.full((1, 2), 31.5)
    radii, azimuths = torch.linspace(0, 32, 160)[None], torch.linspace(0, 6.28, 640)
    best = {(1, 1): math.inf, (1, 640): math.inf}
    for _ in range(40):  # in turns; the fastest of each is the least disturbed
        for samples in best:
            start = time.perf_counter()
            polar_sample(image, radii, azimuths, center, samples=samples, layout="image")
            best[samples] = min(best[samples], time.perf_counter() - start)
    assert best[1, 1] < 1.5 * best[1, 640]
