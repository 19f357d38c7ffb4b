import math

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from lens_examples import FRONT
from scipy.spatial.transform import Rotation

from darswin.lens import KannalaBrandt, Mei, Perspective
from darswin.lens.pixels import OUTSIDE
from darswin.views import SquareView, make_view, turned


def by_hand(name, size, fov, yaw=0.0, pitch=0.0):
    """The rays of the pixels of a view, unit vectors (H, W, 3), by formulas; NaN beyond a pole."""
    step = 2 * math.tan(fov / 2) / size[1] if name == "perspective" else fov / size[1]
    v, u = np.indices(size)
    x, y = (u - (size[1] - 1) / 2) * step, (v - (size[0] - 1) / 2) * step
    if name == "perspective":
        rays = np.stack((x, y, np.ones_like(x)), -1)
    elif name == "cylindrical":
        rays = np.stack((np.sin(x), y, np.cos(x)), -1)
    else:
        rays = np.stack((np.cos(y) * np.sin(x), np.sin(y), np.cos(y) * np.cos(x)), -1)
        rays[np.abs(y) > math.pi / 2] = math.nan
    turn = Rotation.from_euler("YX", [yaw, pitch]).as_matrix()  # pitched, then turned
    return F.normalize(torch.from_numpy(rays @ turn.T), dim=-1)


# Their names, sizes, fields of view, yaw and pitch.
VIEWS = {
    "perspective": ("perspective", (60, 80), math.radians(100)),
    "aside": ("perspective", (60, 80), math.radians(70), 0.8, -0.3),
    "cylindrical": ("cylindrical", (60, 160), math.radians(180)),
    "equirectangular": ("equirectangular", (90, 180), 2 * math.pi),
}


def made(name, size, fov, yaw=0.0, pitch=0.0, **options):
    return make_view(name, size, fov=fov, **turned(yaw, pitch), **options)


def undistort(image, lens, view):
    return view.at(lens, image.shape[:2])(image)


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
    for name, described in VIEWS.items():
        rays = by_hand(*described)
        theta, azimuth = angles(rays)
        there = lens.project_rays(theta, azimuth)
        inside = (theta < lens.theta_max - 0.04) & ((there >= 0) & (there <= last)).all(-1)
        assert inside.double().mean() > 0.4, name
        # Bilinear between pixels, of places that OpenCV rounds to 1/32 px.
        shown = undistort(image, lens, made(*described, supersampling=1))
        error = np.abs(shown - scene(rays))[inside]
        assert error.max() < 5e-4, name


@pytest.mark.parametrize("make", [front, mei, skewed])
def test_rays_land_where_the_lens_projects_them(make):
    lens, described = make(), VIEWS["equirectangular"]
    rays = by_hand(*described)
    theta, azimuth = angles(rays)
    size = tuple(lens.image_size[0].int().tolist())
    there = made(*described, supersampling=1).at(lens, size).points
    beyond = (theta > lens.theta_max).numpy()
    assert 0 < beyond.mean() < 1 and (there[beyond] == OUTSIDE).all()
    expected = lens.project_rays(theta, azimuth).numpy()
    np.testing.assert_allclose(there[~beyond], expected[~beyond], atol=1e-3)


def test_behind_the_camera_is_black():
    lens = front()
    image = np.ones((966, 1280), np.float32)
    around = undistort(image, lens, made("equirectangular", (91, 181), 2 * math.pi))
    assert around[45, 90] == 1 and not around[:, :20].any() and not around[:, -20:].any()
    with pytest.raises(ValueError, match="this view sees nothing of the lens"):
        undistort(image, lens, made("perspective", (20, 20), 1.0, math.pi))


TURNS = ((0.0, 0.0), (0.4, -0.2), (1.2, 0.3), (math.pi, 0.1), (-math.pi, -0.4),
         (0.0, math.pi / 2), (0.7, -math.pi / 2), (2 * math.pi, 2.5))  # fmt: skip


@pytest.mark.parametrize("name", ["perspective", "cylindrical", "equirectangular"])
@pytest.mark.parametrize("turn", TURNS)
def test_rays_are_those_of_formulas_and_turn(name, turn):
    """Fields of view are between the outer edges of pixels; yaw looks right, and pitch up."""
    for size, fov in (((4, 6), 1.4), ((9, 8), 3.0), ((9, 8), 2 * math.pi)):
        if name == "perspective" and fov > 3:
            continue
        grid = torch.from_numpy(np.stack(np.indices(size)[::-1], -1)).double()
        rays = made(name, size, fov, *turn).to_rays(grid[None], front(), (966, 1280))[0]
        torch.testing.assert_close(rays, by_hand(name, size, fov, *turn), equal_nan=True)
    middle = by_hand(name, (3, 5), 1.0, *turn)[1, 2]
    yaw, pitch = turn
    right, above = math.cos(pitch) * math.sin(yaw), -math.sin(pitch)
    assert middle.tolist() == pytest.approx([right, above, math.cos(pitch) * math.cos(yaw)])


def test_a_view_that_shrinks_is_the_mean_of_areas():
    """As more points have it, and OpenCV's reduction of a flat picture."""
    lens, noise = front(), np.random.default_rng(0).random((966, 1280)).astype(np.float32)
    described = ("perspective", (30, 40), 1.5)
    fine = undistort(noise, lens, made(described[0], (30 * 16, 40 * 16), 1.5, supersampling=1))
    means = fine.reshape(30, 16, 40, 16).mean((1, 3))
    single = np.abs(undistort(noise, lens, made(*described, supersampling=1)) - means).mean()
    assert np.abs(undistort(noise, lens, made(*described)) - means).mean() < single / 3
    flat = Perspective(60.0, 1.2, image_size=(60, 80))
    picture = (noise[:60, :80] * 255).astype(np.uint8)
    reduced = undistort(
        picture, flat, made("perspective", (30, 40), 2 * math.atan(40 / 60), supersampling=2)
    )
    expected = cv2.resize(picture, (40, 30), interpolation=cv2.INTER_AREA)
    assert reduced.dtype == np.uint8 and np.abs(reduced.astype(int) - expected).max() <= 1


def test_colours_and_types():
    lens = front()
    image = np.random.default_rng(0).integers(256, size=(966, 1280, 3), dtype=np.uint8)
    view = undistort(image, lens, made(*VIEWS["perspective"]))
    assert view.shape == (60, 80, 3) and view.dtype == np.uint8
    small = Perspective(10.0, 1.2)  # no principal point of its own: that of the image
    picture = np.arange(35, dtype=np.float32).reshape(5, 7)
    same = undistort(picture, small, made("perspective", (5, 7), 2 * math.atan(0.35)))
    np.testing.assert_allclose(same, picture, atol=1e-3)


def test_tiles_and_squares():
    lens, image = front(), np.random.default_rng(0).random((966, 1280, 3)).astype(np.float32)
    tiles = make_view("tiles", (32, 40), count=4)
    shown = undistort(image, lens, tiles)
    assert shown.shape == (4, 32, 40, 3)
    for one, tile in zip(shown, tiles.tiles, strict=True):
        np.testing.assert_array_equal(one, undistort(image, lens, tile))
    square = SquareView((50, 50), fov=3.0)
    seen = square(torch.from_numpy(image)[None].movedim(-1, 1).double(), lens)[0]
    found = undistort(image, lens, square)
    np.testing.assert_allclose(found, seen.movedim(0, -1), atol=0.05)
