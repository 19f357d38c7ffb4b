"""polar_to_image by its definition, beyond the contract."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from cases import assert_equal_results, polar_map, results

from darswin.layers.polar import polar_grid
from darswin.lens import Equidistant
from darswin.ops import polar_sample, polar_to_image, use_reference


@pytest.mark.parametrize("reference", [False, True])
def test_a_matrix_is_undone(reference):
    case = polar_map(general="affine", dtype=torch.float64)
    x, radii, center, affine = case.inputs.values()
    y, across = (torch.arange(n, dtype=torch.float64) for n in (19, 23))
    pixels = torch.stack(torch.meshgrid(across, y, indexing="xy"), -1) - center[:, None, None]
    points = torch.linalg.solve(affine[:, None, None], pixels[..., None])[..., 0]
    with use_reference(reference):
        found = polar_to_image(x, radii, None, (19, 23), points=points)
        torch.testing.assert_close(found, case.run(**case.inputs))


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
    case = polar_map(size=(21, 21), dtype=torch.float64)
    x, radii, _ = case.inputs.values()
    center = torch.full((1, 2), 10.0, dtype=torch.float64)
    turned = case.run(x.roll(2, 2), radii, center)
    off = torch.ones(21, 21, dtype=torch.bool)
    off[10, 10] = False  # the pole itself has no azimuth
    expected = case.run(x, radii, center).rot90(-1, (2, 3))
    torch.testing.assert_close(turned[..., off], expected[..., off])


def test_a_linear_layer_commutes_with_it():
    case = polar_map(channels=96, rings=8, sectors=32, layout="tokens")
    weight, (x, *lens) = torch.randn(10, 96) / 10, case.inputs.values()
    later, first = F.linear(case.run(x, *lens), weight), case.run(F.linear(x, weight), *lens)
    torch.testing.assert_close(first, later, rtol=1e-5, atol=1e-5)


def test_the_pole_and_the_axes():
    # Pixels at the pole, on the axes and the diagonals, where the pieces of the arctangent meet.
    case = polar_map(1, 3, 8, 2, (7, 7))
    case = case.replace(radii=torch.tensor([[0.5, 1.5, 3.0]]), center=torch.full((1, 2), 3.0))
    case.mask = None
    expected = results(case.to(torch.float64), is_reference=True)
    found = {name: t.double() for name, t in results(case).items()}
    assert found.pop("center").isfinite().all()
    expected.pop("center")
    assert_equal_results(found, expected, 1e-5)
