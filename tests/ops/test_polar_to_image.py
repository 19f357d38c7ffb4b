"""Tests of polar_to_image beyond the contract, against its definition."""

import math

import numpy as np
import pytest
import torch
from cases import assert_equal_results, polar_map, results

from darswin.ops import polar_to_image, polar_to_image_plan, use_reference


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
    # Their azimuths may be infinite and fit no integer, which `make test-asan` would detect.
    real = torch.promote_types(dtype, torch.float32)
    points = torch.tensor(place, dtype=real).expand(1, 1, 35, 2).clone().requires_grad_()
    radii = torch.tensor([[1.0, 2.0]], dtype=real)
    x = torch.ones(1, 2, 4, 3, dtype=dtype, requires_grad=True)
    out = polar_to_image(x, radii, None, (1, 35), points=points)
    assert not out.any()
    assert not any(grad.any() for grad in torch.autograd.grad(out.sum(), (x, points)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize(
    "lens", [dict(), dict(lenses=2, r_max=7.0), dict(general="points")], ids=str
)
def test_a_plan_changes_no_bit(lens, dtype):
    for sizes in (dict(), dict(channels=1, size=(9, 70)), dict(rings=1, sectors=1)):
        made = []
        for planned in (False, True):
            torch.manual_seed(0)
            made.append(polar_map(dtype=dtype, planned=planned, **lens, **sizes))
        plain, planned = map(results, made)
        assert_equal_results(planned, plain)


def test_both_directions_read_the_plan():
    x, radii, center = polar_map().inputs.values()
    x.requires_grad_()
    plan = polar_to_image_plan(x, radii, center, (19, 23))
    of_two = polar_to_image_plan(x, radii.expand(2, -1), center, (19, 23))
    assert torch.equal(plan.expand(2, -1, -1, -1), of_two)
    expected = polar_to_image(x, radii, center, (19, 23))
    found = polar_to_image(x, radii + 1, center - 1, (19, 23), plan=plan)
    assert torch.equal(found, expected)
    grad = torch.randn_like(found)
    assert torch.equal(*(torch.autograd.grad(out, x, grad)[0] for out in (found, expected)))
    with use_reference():
        assert polar_to_image_plan(x, radii, center, (19, 23)) is None
        assert not torch.equal(polar_to_image(x, radii + 1, center, (19, 23), plan=plan), expected)


def test_equals_scipy():
    ndimage = pytest.importorskip("scipy.ndimage")  # missing where only a wheel is tested
    # The rings have equal steps and start half a step from the pole. Then scipy can interpolate the
    # map, mirrored across the pole and repeated around.
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


def test_the_pole_and_the_axes():
    # Pixels at the pole, on the axes and on the diagonals, where the arctangent's pieces meet.
    case = polar_map(1, 3, 8, 2, (7, 7))
    case = case.replace(radii=torch.tensor([[0.5, 1.5, 3.0]]), center=torch.full((1, 2), 3.0))
    expected = results(case.to(torch.float64), is_reference=True, masked=False)
    found = {n: t.double() for n, t in results(case, masked=False).items()}
    assert found.pop("center").isfinite().all() and len(expected.pop("center")) == 1
    assert_equal_results(found, expected, 1e-5)
