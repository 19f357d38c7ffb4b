import math

import pytest
import torch

from darswin.lens import KannalaBrandt, Mei, Perspective, Polynomial, Spherical
from darswin.lens.pixels import OUTSIDE, perspective_view, reproject, reprojection


def test_a_ray_keeps_its_angles():
    source = Perspective.from_fov(2.4, 100.0, center=[90.0, 104.0]).to(torch.float64)
    target = Spherical.from_fov([0.2, 0.9], 2.4, 30.0).to(torch.float64)
    there = reprojection(source, (200, 200), target, (64, 61))
    assert there.shape == (2, 64, 61, 2)
    x, y = 40.0, 20.0  # of a pixel
    dx, dy = x - 30, y - 31.5
    theta = target.unproject(torch.full((2, 1), math.hypot(dx, dy), dtype=torch.float64))
    r = source.project(theta)[:, 0]
    azimuth = math.atan2(dy, dx)
    expected = torch.stack((90 + r * math.cos(azimuth), 104 + r * math.sin(azimuth)), -1)
    torch.testing.assert_close(there[:, 20, 40], expected)


def test_gradients_reach_both_lenses_also_at_the_centre():
    focal = torch.tensor([20.0], dtype=torch.float64, requires_grad=True)
    xi = torch.tensor([0.5], dtype=torch.float64, requires_grad=True)

    def places(focal, xi):
        return reprojection(Perspective(focal, 1.2), (40, 40), Spherical(xi, focal, 1.2), (9, 9))

    assert torch.autograd.gradcheck(places, (focal, xi))


def test_reproject_is_bilinear_between_pixel_centres():
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    lens = Perspective(10.0, 1.2)
    torch.testing.assert_close(reproject(image, lens, lens, (3, 4)), image, rtol=0, atol=1e-5)
    moved = Perspective(10.0, 1.2, center=[1.0, 0.75])  # half a pixel and a quarter
    got = reproject(image, lens, moved, (3, 4))
    torch.testing.assert_close(got[..., :2, :3], image[..., :2, :3] + 0.5 + 0.25 * 4)
    torch.testing.assert_close(got[0, 0, 0, 3], torch.tensor((3 + 0.25 * 4) / 2))  # half is outside


def test_reproject_of_many():
    images = torch.rand(2, 3, 20, 24)
    source = Spherical.from_fov([0.2, 0.9], 2.0, 10.0)
    target = Perspective.from_fov(1.8, 8.0)
    together = reproject(images, source, target, (16, 18))
    assert together.shape == (2, 3, 16, 18)
    for k in range(2):
        alone = reproject(images[k : k + 1], source[k], target, (16, 18))
        torch.testing.assert_close(together[k : k + 1], alone)
    half = reproject(images.bfloat16(), source, target, (16, 18))
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), together, rtol=0, atol=0.01)
    assert reproject(images[:0], source[:0], target, (16, 18)).shape == (0, 3, 16, 18)
    corner = math.hypot(7.5, 8.5)
    assert corner > 8.0 and not together[..., 0, 0].any()  # beyond θ_max


@pytest.mark.parametrize("size", [(64, 64), (40, 64), (64, 40)])
def test_perspective_view(size):
    papers = 2 * math.atan(64 / 3)  # 174.6°, of the paper's images
    wide = Polynomial([20.0], math.radians(100))
    for lens, theta_max in (
        (Spherical.from_fov(0.5, papers, 32.0), papers / 2),
        (wide, math.radians(87.5)),
    ):
        view = perspective_view(lens, size, math.radians(175))
        torch.testing.assert_close(view.theta_max, torch.tensor([theta_max]))
        torch.testing.assert_close(view.r_max, torch.tensor([min(size) / 2]), rtol=1e-4, atol=0)
        assert view.center is None


def test_general_lenses():
    source = Mei(
        1.5, 40.0, (0.05, 0.2), 1.2, (30.0, 22.5), affine=[[1.0, 0.05], [0.0, 0.8]],
        tangential=(0.02, -0.03),
    ).to(torch.float64)  # fmt: skip
    target = KannalaBrandt(20.0, [0.02], 1.7, affine=[[1.0, 0.0], [0.1, 1.1]]).to(torch.float64)
    for a, b in ((source, target), (target, source)):
        there = reprojection(a, (46, 64), b, (40, 50))[0]
        seen = there[..., 0] != OUTSIDE
        assert 0.3 < seen.double().mean() < 1
        y, x = seen.nonzero().unbind(1)
        theta, azimuth = b.unproject_pixels(torch.stack((x, y), -1).double(), (40, 50))
        expected = a.project_rays(theta, azimuth, (46, 64))
        torch.testing.assert_close(there[seen], expected)
    # There and back again.
    there = reprojection(source, (46, 64), target, (40, 50))
    seen = there[..., 0] != OUTSIDE
    theta, direction = source.rays(there[seen], (46, 64))
    y, x = seen[0].nonzero().unbind(1)
    torch.testing.assert_close(
        target.pixels(theta, direction, (40, 50)), torch.stack((x, y), -1).double(), atol=1e-6,
        rtol=0,
    )  # fmt: skip


def test_gradients_of_general_lenses_also_where_nothing_is_seen():
    def places(focal, tangential, affine, center):
        source = Mei(1.5, focal, (0.05, 0.2), 1.2, center, affine=affine, tangential=tangential)
        target = Mei(1.0, focal, None, 1.3, affine=affine, tangential=tangential)
        return reprojection(source, (40, 40), target, (9, 9))

    parameters = [[2.9], [0.01, -0.02], [[1.0, 0.1], [0.0, 0.9]], [19.0, 20.5]]
    tensors = [torch.tensor(p, dtype=torch.float64, requires_grad=True) for p in parameters]
    there = places(*tensors)
    assert (there == OUTSIDE).any() and (there[0, 4, 4] != OUTSIDE).all()
    assert torch.autograd.gradcheck(places, tensors)
