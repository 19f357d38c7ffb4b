import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import assert_accurate, assert_equals_reference, with_gradients

from darswin.layers.polar import polar_grid
from darswin.lens import Equidistant
from darswin.ops import polar_sample, polar_to_image, use_reference


def make_inputs(
    batch=2, rings=4, sectors=8, channels=3, size=(19, 23), rows=1, dtype=torch.float32
):
    """x, radii and center."""
    x = torch.randn(batch, rings, sectors, channels, dtype=dtype)
    radii = ((torch.rand(rows, rings, dtype=torch.float64) + 0.3).cumsum(1) * 9 / rings).to(dtype)
    middle = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=torch.float64)
    center = (middle + 0.3 + 0.1 * torch.rand(rows, 2, dtype=torch.float64)).to(dtype)
    return x, radii, center


def back(size=(19, 23), **options):
    """polar_to_image as a function of its differentiable inputs."""

    def run(x, radii, center, *affine):
        return polar_to_image(x, radii, center, size, affine=affine[0] if affine else None,
                              **options)  # fmt: skip

    return run


CASES = {
    "small": (dict(), dict()),
    "tokens": (dict(channels=33), dict(layout="tokens")),
    "a lens an image": (dict(rows=2, channels=17), dict(r_max=8.7)),
    "one ring": (dict(rings=1, sectors=16), dict(r_max=7.3)),
    "one sector": (dict(sectors=1, channels=16), dict(layout="tokens")),
    "odd sectors": (dict(sectors=7, channels=40), dict()),
    "one channel": (dict(channels=1, sectors=64, rings=16), dict()),
    "wide": (dict(channels=20, size=(5, 150)), dict(size=(5, 150))),
    "one pixel": (dict(size=(1, 1)), dict(size=(1, 1))),
    "empty batch": (dict(batch=0), dict()),
    "no channels": (dict(channels=0), dict()),
    "no pixels": (dict(size=(0, 4)), dict(size=(0, 4))),
}


@pytest.mark.parametrize("case", CASES)
def test_equals_reference_in_float64(case):
    sizes, options = CASES[case]
    inputs = make_inputs(**sizes, dtype=torch.float64)
    assert_equals_reference(back(**options), inputs, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("case", CASES)
def test_accuracy_rule(case):
    sizes, options = CASES[case]
    assert_accurate(back(**options), lambda: make_inputs(**sizes))


def test_a_matrix_is_undone():
    x, radii, center = make_inputs(dtype=torch.float64)
    affine = torch.tensor([[[1.1, 0.1], [-0.05, 0.9]]], dtype=torch.float64)
    assert_equals_reference(back(), (x, radii, center, affine), rtol=1e-9, atol=1e-10)
    y, across = (torch.arange(n, dtype=torch.float64) for n in (19, 23))
    pixels = torch.stack(torch.meshgrid(across, y, indexing="xy"), -1) - center[:, None, None]
    points = torch.linalg.solve(affine[:, None, None], pixels[..., None])[..., 0]
    for reference in (False, True):
        with use_reference(reference):
            expected = polar_to_image(x, radii, center, (19, 23), affine=affine)
            torch.testing.assert_close(
                polar_to_image(x, radii, None, (19, 23), points=points), expected
            )


@pytest.mark.parametrize("rows", [1, 2])
@pytest.mark.parametrize("inputs", ["x radii center", "x radii center affine", "x radii points"])
def test_gradcheck(inputs, rows):
    torch.manual_seed(1)
    x, radii, center = make_inputs(2, 3, 5, 2, (5, 4), rows, torch.float64)
    given = dict(x=x, radii=radii / 3, center=center, points=torch.rand(rows, 5, 4, 2) * 6 - 3,
                 affine=torch.eye(2).expand(rows, 2, 2) + 0.1 * torch.rand(rows, 2, 2))  # fmt: skip
    names = inputs.split()

    def run(*tensors):
        lens = dict(zip(names, tensors, strict=True))
        return polar_to_image(lens.pop("x"), lens.pop("radii"), lens.pop("center", None), (5, 4),
                              r_max=40.0, **lens)  # fmt: skip

    leaves = [given[name].double().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(run, leaves)
    with use_reference():
        assert torch.autograd.gradcheck(run, leaves)


@pytest.mark.unsanitized
@pytest.mark.parametrize("layout", ["tokens", "image"])
@pytest.mark.parametrize("points", [False, True])
def test_opcheck(layout, points):
    x, radii, center = make_inputs(channels=5, size=(6, 7))
    affine = None if points else torch.eye(2)[None] + 0.1
    plane = torch.rand(2, 6, 7, 2) * 8 - 4 if points else None
    center = None if points else center
    for wanted in (False, True):
        leaves = [
            t if t is None else t.clone().requires_grad_(wanted)
            for t in (x, radii, center, affine, plane)
        ]
        arguments = (*leaves, torch.tensor([5.0]), [6, 7], layout == "tokens")
        torch.library.opcheck(torch.ops.darswin.polar_to_image, arguments)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize(
    "place",
    [(math.nan, 1e30), (1e30, math.nan), (math.nan, -1e30), (math.inf, -math.inf), (-math.inf, 1)],
    ids=str,
)
def test_places_that_are_no_numbers_are_zero(place, dtype):
    # Their azimuths may come out infinite, which no integer holds: `make test-asan` would tell.
    real = torch.promote_types(dtype, torch.float32)
    points = torch.tensor(place, dtype=real).expand(1, 1, 35, 2).clone().requires_grad_()
    radii = torch.tensor([[1.0, 2.0]], dtype=real)
    x = torch.ones(1, 2, 4, 3, dtype=dtype, requires_grad=True)
    out = polar_to_image(x, radii, None, (1, 35), points=points)
    assert not out.any()
    assert not any(grad.any() for grad in torch.autograd.grad(out.sum(), (x, points)))


def test_compiles_for_any_batch():
    torch._dynamo.reset()
    compiled = torch.compile(back(), fullgraph=True, dynamic=True, backend="aot_eager")
    for batch in (2, 3):
        inputs = make_inputs(batch)
        for ours, expected in zip(
            with_gradients(compiled, inputs), with_gradients(back(), inputs), strict=True
        ):
            assert torch.equal(ours, expected)


def test_equals_scipy():
    ndimage = pytest.importorskip("scipy.ndimage")  # not where a wheel alone is tested
    # Rings at equal steps, half a step from the pole: the map, mirrored across the pole and
    # repeated around, is what scipy interpolates.
    rings, sectors, size, step = 6, 10, 41, 2.5
    x = torch.randn(1, rings, sectors, 2, dtype=torch.float64)
    radii = (torch.arange(rings, dtype=torch.float64)[None] + 0.5) * step
    center = torch.tensor([[19.3, 20.6]], dtype=torch.float64)
    opposite = x.roll(sectors // 2, 2).flip(1)
    full = torch.cat((opposite, x, x[:, -1:]), 1)[0].permute(2, 0, 1).numpy()
    y, across = np.mgrid[:size, :size] - np.array([20.6, 19.3])[:, None, None]
    r, azimuth = np.hypot(across, y), np.arctan2(y, across)
    ring, column = r / step - 0.5 + rings, azimuth * sectors / (2 * np.pi) - 0.5
    expected = np.stack(
        [
            ndimage.map_coordinates(plane, (ring, column), order=1, mode="grid-wrap")
            for plane in full
        ]
    )
    expected[:, r > rings * step] = 0
    for reference in (False, True):
        with use_reference(reference):
            image = polar_to_image(x, radii, center, (size, size), r_max=rings * step)
        np.testing.assert_allclose(image[0].numpy(), expected, atol=1e-12)


def test_equals_a_padded_grid_sample():
    rings, sectors, size = 16, 64, 96
    x = torch.randn(2, rings, sectors, 5)
    radii = (torch.arange(rings)[None] + 0.5) * (size / 2 / rings)
    middle = (size - 1) / 2
    y, across = torch.meshgrid(*(torch.arange(size) - middle,) * 2, indexing="ij")
    r, column = torch.hypot(across, y), torch.atan2(y, across) * sectors / (2 * math.pi) - 0.5
    padded = F.pad(x.permute(0, 3, 1, 2), (1, 1, 0, 0), mode="circular")
    place = torch.stack(
        (
            (2 * (column % sectors + 1) + 1) / (sectors + 2) - 1,
            (2 * (r * rings / (size / 2) - 0.5) + 1) / rings - 1,
        ),
        -1,
    )
    expected = F.grid_sample(
        padded, place.expand(2, -1, -1, -1), align_corners=False, padding_mode="border"
    )
    image = polar_to_image(x, radii, torch.full((1, 2), middle), (size, size))
    inside = r > radii[0, 0]  # grid_sample knows no pole
    torch.testing.assert_close(
        torch.where(inside, image, 0), torch.where(inside, expected, 0), rtol=1e-4, atol=1e-4
    )


def test_undoes_polar_sample_on_a_smooth_image():
    size = 64
    wide = Equidistant.from_fov(3.0, size / 2)
    y, x = torch.meshgrid(*(torch.arange(size) / size,) * 2, indexing="ij")
    image = torch.stack((torch.sin(5 * x + 2 * y), torch.cos(4 * y - x)))[None]
    grid = polar_grid(wide, (size, size), rings=32, sectors=128, samples=(1, 1))
    polar = polar_sample(image, grid.radii, grid.azimuths, grid.center, samples=(1, 1))
    found = polar_to_image(polar, grid.radii, grid.center, (size, size), r_max=size / 2)
    r = torch.hypot(x * size - 31.5, y * size - 31.5)
    assert (found - image).abs().amax(1)[0][r <= grid.radii[0, -1]].max() < 0.015
    assert found[0, :, r > size / 2].count_nonzero() == 0


def test_a_turn_of_the_map_is_a_turn_of_the_image():
    x, radii, _ = make_inputs(sectors=8, dtype=torch.float64)
    center = torch.full((1, 2), 10.0, dtype=torch.float64)
    image = polar_to_image(x, radii, center, (21, 21))
    turned = polar_to_image(x.roll(2, 2), radii, center, (21, 21))
    off = torch.ones(21, 21, dtype=torch.bool)
    off[10, 10] = False  # the pole itself has no azimuth
    expected = image.rot90(-1, (2, 3))
    torch.testing.assert_close(turned[..., off], expected[..., off])


def test_a_linear_layer_commutes_with_it():
    x, radii, center = make_inputs(channels=96, rings=8, sectors=32)
    weight = torch.randn(10, 96) / 10
    later = F.linear(polar_to_image(x, radii, center, (19, 23), layout="tokens"), weight)
    first = polar_to_image(F.linear(x, weight), radii, center, (19, 23), layout="tokens")
    torch.testing.assert_close(first, later, rtol=1e-5, atol=1e-5)


def test_autocast_and_strides():
    x, radii, center = make_inputs(channels=20)
    expected = polar_to_image(x, radii, center, (19, 23))
    wide = torch.randn(2, 20, 4, 8)
    wide.copy_(x.permute(0, 3, 1, 2))
    assert torch.equal(polar_to_image(wide.permute(0, 2, 3, 1), radii, center, (19, 23)), expected)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(polar_to_image(x, radii, center, (19, 23)), expected)


one = torch.ones(1, 2, 4, 3)
rising, middle = torch.tensor([[0.5, 1.5]]), torch.ones(1, 2)
WRONG = {
    "x must be a tensor": lambda: polar_to_image(None, rising, middle, (4, 4)),
    r"x must have shape \(B, R, A, D\)": lambda: polar_to_image(one[0], rising, middle, (4, 4)),
    "x must have rings": lambda: polar_to_image(one[:, :0], rising[:, :0], middle, (4, 4)),
    r"radii must have shape \(B or 1, R\) = \(1 or 1, 2\), got \(1, 1\)": lambda: polar_to_image(
        one, rising[:, :1], middle, (4, 4)
    ),
    "radii must be float32": lambda: polar_to_image(one, rising.double(), middle, (4, 4)),
    "radii must be finite, at least 0, and rise": lambda: polar_to_image(
        one, rising.flip(1), middle, (4, 4)
    ),
    "at least 0": lambda: polar_to_image(one, rising - 1, middle, (4, 4)),
    "finite": lambda: polar_to_image(one, rising * math.nan, middle, (4, 4)),
    "takes center": lambda: polar_to_image(one, rising, None, (4, 4)),
    "or else points": lambda: polar_to_image(
        one, rising, middle, (4, 4), points=torch.ones(1, 4, 4, 2)
    ),
    r"points must have shape .* \(1 or 1, 4, 5, 2\)": lambda: polar_to_image(
        one, rising, None, (4, 5), points=torch.ones(1, 4, 4, 2)
    ),
    "size must be a pair of ints": lambda: polar_to_image(one, rising, middle, 4),
    "size must be at least 0": lambda: polar_to_image(one, rising, middle, (4, -1)),
    r"r_max must have shape \(B or 1,\)": lambda: polar_to_image(
        one, rising, middle, (4, 4), r_max=torch.ones(3)
    ),
    "layout must be one of": lambda: polar_to_image(one, rising, middle, (4, 4), layout="map"),
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_arguments(message):
    with pytest.raises((TypeError, ValueError), match=message):
        WRONG[message]()
