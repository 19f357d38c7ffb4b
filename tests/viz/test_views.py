import math

import numpy as np
import pytest
import torch
from lens_examples import FRONT

from darswin.lens import KannalaBrandt, Mei, Perspective
from darswin.lens.pixels import OUTSIDE
from darswin.viz.views import (
    cylindrical,
    equirectangular,
    perspective,
    rotated,
    undistort,
    view_map,
)

VIEWS = {
    "perspective": perspective((60, 80), math.radians(100)),
    "aside": perspective((60, 80), math.radians(70), yaw=0.8, pitch=-0.3),
    "cylindrical": cylindrical((60, 160), math.radians(180)),
    "equirectangular": equirectangular((90, 180)),
}


def front():
    return FRONT.with_theta_max(math.radians(110)).to(torch.float64)


def mei():
    """The camera of tests/lens/files/kitti360_03.yaml, with its tangential terms."""
    return Mei(
        2.7, 1600.4, (-0.021, 5.2), math.radians(100), (692.4, 703.1), image_size=(1400, 1400),
        affine=[[1, 0], [0, 1599.1 / 1600.4]], tangential=(-9e-4, 1.1e-3),
    ).to(torch.float64)  # fmt: skip


def skewed():
    affine = [[1.0, 0.05], [0.0, 0.8]]
    return KannalaBrandt(200.0, [0.01, -0.005], 1.8, affine=affine, image_size=(600, 700)).to(
        torch.float64
    )


def angles(rays: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    x, y, z = rays.unbind(-1)
    return torch.atan2(torch.hypot(x, y), z), torch.atan2(y, x)


def scene(rays: torch.Tensor) -> np.ndarray:
    """A smooth function of direction, in [0, 1]."""
    x, y, z = (rays / rays.norm(dim=-1, keepdim=True)).unbind(-1)
    return (0.5 + 0.2 * x - 0.1 * y + 0.1 * torch.sin(3 * z + 2 * x) * torch.cos(4 * y)).numpy()


def photograph(lens) -> np.ndarray:
    """What a lens shows of the scene, as float32; NaN where no ray of the lens lands."""
    sides = (torch.arange(int(side), dtype=torch.float64) for side in lens.image_size[0])
    y, x = torch.meshgrid(*sides, indexing="ij")
    return scene(lens.unproject_points(torch.stack((x, y), -1))).astype(np.float32)


@pytest.mark.parametrize("make", [front, mei, skewed])
def test_a_view_shows_what_lies_along_its_rays(make):
    lens = make().resized(0.25)  # so that half a pixel is more than the tolerance
    image = photograph(lens)
    last = torch.tensor(image.shape[::-1]) - 1
    for name, rays in VIEWS.items():
        theta, azimuth = angles(rays)
        there = lens.project_rays(theta, azimuth)
        inside = (theta < lens.theta_max - 0.04) & ((there >= 0) & (there <= last)).all(-1)
        assert inside.double().mean() > 0.4, name
        # Bilinear between pixels, of places that OpenCV rounds to 1/32 px.
        error = np.abs(undistort(image, lens, rays) - scene(rays))[inside]
        assert error.max() < 5e-4, name


@pytest.mark.parametrize("make", [front, mei, skewed])
def test_rays_land_where_the_lens_projects_them(make):
    lens, rays = make(), VIEWS["equirectangular"]
    theta, azimuth = angles(rays)
    there, beyond = view_map(lens, rays), (theta > lens.theta_max).numpy()
    assert 0 < beyond.mean() < 1 and (there[beyond] == OUTSIDE).all()
    expected = lens.project_rays(theta, azimuth).numpy()
    np.testing.assert_allclose(there[~beyond], expected[~beyond], atol=1e-3)


def test_behind_the_camera_is_black():
    lens = front()
    image = np.ones((966, 1280), np.float32)
    assert not undistort(image, lens, perspective((20, 20), 1.0, yaw=math.pi)).any()
    around = undistort(image, lens, equirectangular((91, 181)))
    assert around[45, 90] == 1 and not around[:, :20].any() and not around[:, -20:].any()
    assert not undistort(image, lens, torch.zeros(4, 4, 3)).any()


@pytest.mark.parametrize("make", [perspective, cylindrical, equirectangular])
def test_yaw_looks_right_and_pitch_up(make):
    def middle(**turn):
        return make((3, 5), 1.0, **turn)[1, 2]

    def direction(*xyz):
        return torch.tensor(xyz, dtype=torch.float64)

    torch.testing.assert_close(middle(), direction(0, 0, 1))
    right = direction(math.sin(0.3), 0, math.cos(0.3))
    torch.testing.assert_close(middle(yaw=0.3), right)
    torch.testing.assert_close(middle(pitch=0.3), direction(0, -math.sin(0.3), math.cos(0.3)))
    # The horizon stays level: rotated by yaw, a pitched view looks as far up as before.
    both = middle(yaw=1.2, pitch=0.3)
    torch.testing.assert_close(both[1], middle(pitch=0.3)[1])
    torch.testing.assert_close(both, rotated(direction(0, 0, 1), 1.2, 0.3))


def test_fields_of_view_are_between_the_pixels_edges():
    def longitude(rays):
        return torch.atan2(rays[..., 0], rays[..., 2])

    rays = perspective((4, 6), 1.4)
    torch.testing.assert_close(rays[0, -1, 0], torch.tensor(5 / 6 * math.tan(0.7)).double())
    torch.testing.assert_close(rays[0].diff(dim=0)[:, 0], rays[:, 0, 1].diff()[:1].expand(5))
    for make in (cylindrical, equirectangular):
        row = longitude(make((4, 6), 1.4))[2]
        torch.testing.assert_close(row, (torch.arange(6.0).double() - 2.5) * 1.4 / 6)
    sphere = equirectangular((4, 8))
    latitude = torch.asin(sphere[:, 0, 1])
    torch.testing.assert_close(latitude, (torch.arange(4.0).double() - 1.5) * math.pi / 4)
    assert not equirectangular((9, 8))[[0, -1]].any() and equirectangular((9, 8))[4].any()


def test_colours_and_types():
    lens = front()
    image = np.random.default_rng(0).integers(256, size=(966, 1280, 3), dtype=np.uint8)
    view = undistort(image, lens, VIEWS["perspective"])
    assert view.shape == (60, 80, 3) and view.dtype == np.uint8
    small = Perspective(10.0, 1.2)  # no principal point of its own: that of the image
    picture = np.arange(35, dtype=np.float32).reshape(5, 7)
    same = undistort(picture, small, perspective((5, 7), 2 * math.atan(0.35)))
    np.testing.assert_allclose(same, picture, atol=1e-3)


def test_errors():
    with pytest.raises(ValueError, match="one lens, got 2"):
        view_map(Perspective([10.0, 20.0], 1.0), torch.zeros(2, 2, 3), (4, 4))
    with pytest.raises(ValueError, match=r"\(H, W, 3\), got \(2, 2\)"):
        view_map(Perspective(10.0, 1.0), torch.zeros(2, 2), (4, 4))
    for make, fov, range_ in ((perspective, math.pi, "below π"), (cylindrical, 7.0, "at most 2π"),
                              (equirectangular, 0.0, "at most 2π")):  # fmt: skip
        with pytest.raises(ValueError, match=f"fov must be above 0 and {range_} rad, got {fov}"):
            make((4, 4), fov)
