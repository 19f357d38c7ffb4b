"""Views along rays: their maps of the sphere, what they show of a lens, and which way is up."""

import math

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from darswin.lens import Equidistant, KannalaBrandt, Perspective
from darswin.views import RayView, TilesView, list_views, make_view, turned, up_of
from darswin.views.registry import _VIEWS

f64 = torch.float64
SIZE = (480, 640)
WIDE = KannalaBrandt(140.0, [0.01], math.radians(95), center=[322.0, 238.0])
RAY_VIEWS = sorted(n for n in list_views() if isinstance(_VIEWS[n], type)
                   and issubclass(_VIEWS[n], RayView))  # fmt: skip
UPRIGHT = [name for name in RAY_VIEWS if _VIEWS[name].upright]
MAPS = [name for name in RAY_VIEWS if name != "panorama"]
every_ray_view = pytest.mark.parametrize("name", RAY_VIEWS)


def narrower(name):
    """The options of a view that shows a part of the lens, if it can."""
    return {} if name == "panorama" else dict(fov=1.5)


def by_formula(name, rays, size, fov):
    """The points (..., 2) of a view at vectors (..., 3) in its frame; NaN where its map ends. Its
    field of view is between the outer edges of pixels."""
    (height, width), (x, y, z) = size, np.moveaxis(rays, -1, 0)
    step = fov / width
    if name == "perspective":
        step = 2 * math.tan(fov / 2) / width
        u, v = np.where(z > 0, (x, y), np.nan) / z
    elif name == "stereographic":
        step = 4 * math.tan(fov / 4) / width
        u, v = 2 * x / (1 + z), 2 * y / (1 + z)
    else:
        u, slope = np.arctan2(x, z), y / np.hypot(x, z)
        v = {"cylindrical": slope, "equirectangular": np.arctan(slope)}.get(name, np.arcsinh(slope))
    return np.stack((u / step + (width - 1) / 2, v / step + (height - 1) / 2), -1)


TURNS = ((0.0, 0.0), (0.4, -0.2), (1.2, 0.3), (math.pi, 0.1), (-math.pi, -0.4),
         (0.0, math.pi / 2), (0.7, -math.pi / 2), (2 * math.pi, 2.5))  # fmt: skip


@pytest.mark.parametrize("name", MAPS)
def test_points_are_those_of_formulas_and_turn(name):
    """Yaw looks right, and pitch up: a view is pitched first, and then turned."""
    rays = np.random.default_rng(0).normal(size=(300, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for yaw, pitch in TURNS:
        turn = Rotation.from_euler("YX", [yaw, pitch]).as_matrix()
        for size, fov in (((4, 6), 1.4), ((9, 8), 3.0)):
            view = make_view(name, size, fov=fov, **turned(yaw, pitch))
            points = view.to_points(torch.from_numpy(rays @ turn.T)[None], WIDE.to(f64), SIZE)[0]
            expected = by_formula(name, rays, size, fov)
            np.testing.assert_allclose(points, expected, rtol=1e-6, atol=1e-6)
        right, above = math.cos(pitch) * math.sin(yaw), -math.sin(pitch)
        assert view.direction == pytest.approx([right, above, math.cos(pitch) * math.cos(yaw)])


def test_rows_beyond_the_poles_show_nothing():
    view = make_view("equirectangular", (9, 8), fov=6.0)  # whose rows are 43° high
    shown = [False] * 2 + [True] * 5 + [False] * 2
    assert view.rays(Equidistant(90.0, 3.1), SIZE)[0].any(-1)[:, 4].tolist() == shown


@every_ray_view
@given(st.data())
def test_rays_of_pixels_come_back_to_them(name, data):
    size = data.draw(st.tuples(st.integers(1, 40), st.integers(1, 40)))
    vector = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: math.hypot(*v) > 1e-3)
    options = dict(up=data.draw(vector), direction=data.draw(vector))
    if name != "panorama":
        options["fov"] = data.draw(st.floats(0.01, min(_VIEWS[name].widest, 6.2) * 0.95))
    view, lens = make_view(name, size, **options), WIDE.to(f64)
    if name == "panorama":
        lens = lens.with_theta_max(3.0)
    last = torch.tensor([size[1] - 1.0, size[0] - 1.0], dtype=f64)
    points = torch.rand(1, 30, 2, dtype=f64) * last
    rays = view.to_rays(points, lens, SIZE)
    shown = ~rays.isnan().any(-1)
    assert_close(rays[shown].norm(dim=-1), torch.ones(int(shown.sum()), dtype=f64))
    # Near the ends of the plane, an angle of rounding is many pixels.
    end = torch.tensor(view.up if name in UPRIGHT else (0.0, 0.0, -1.0), dtype=f64)
    along = rays.nan_to_num() @ end
    shown &= (along.abs() if name in UPRIGHT else along) < 1 - 1e-6
    back = view.to_points(rays, lens, SIZE)
    assert_close(back[shown], points[shown], rtol=1e-6, atol=1e-5)


LENS = Equidistant(18.0, theta_max=1.45, center=[[31.3, 23.6]], image_size=(48, 64))
DOWN = dict(up=(0.0, 0.0, -1.0))  # a camera that looks straight down
# Each view, its size, what it is told, and whether its columns go all around.
SHOWN = {
    "mercator": ((24, 40), dict(fov=1.6), False),
    "cylindrical": ((24, 40), dict(fov=1.2), False),
    "equirectangular": ((16, 40), dict(fov=2.0), False),
    "panorama": ((20, 60), DOWN, True),
    "mercator around": ((20, 60), dict(fov=math.tau, **DOWN), True),
    "cylindrical around": ((20, 60), DOWN, True),
    "equirectangular around": ((20, 60), dict(fov=math.tau, **DOWN), True),
    "mercator not quite around": ((20, 60), dict(fov=math.tau - 0.4, **DOWN), False),
    "stereographic": ((24, 24), dict(fov=1.5), False),
    "perspective": ((24, 32), dict(fov=1.0), False),
    "perspective as far as the lens": ((24, 32), dict(reach=0.75, theta_max=0.75), False),
    "square": ((24, 24), {}, False),
}


def places_in(key):
    """The points of a view that the pixels of a picture through `LENS` show, (48, 64, 2), by
    formulas; NaN where nothing is shown."""
    name, (size, options, _) = key.split()[0], SHOWN[key]
    down, across = (np.indices((48, 64)) - [[[23.6]], [[31.3]]]) / 18
    theta, azimuth = np.hypot(across, down), np.arctan2(down, across)
    c, s = np.cos(azimuth), np.sin(azimuth)
    if name == "square":
        wide = np.abs(c) >= np.abs(s)
        edge = np.copysign(theta / 1.45, np.where(wide, c, s))
        other = edge * np.arctan(np.where(wide, s / c, c / s)) * 4 / math.pi
        plane = np.stack((np.where(wide, edge, other), np.where(wide, other, edge)), -1)
        places = (plane + 1) * 12 - 0.5
    else:
        rays = np.stack((np.sin(theta) * c, np.sin(theta) * s, np.cos(theta)), -1)
        if "up" in options:  # its picture's top is forward on the horizon
            rays = rays[..., [0, 2, 1]] * [1, 1, -1]
        fov = options.get("fov", math.tau)
        if "reach" in options:  # to the nearer edge
            fov = 2 * math.atan(math.tan(options["reach"]) * size[1] / min(size))
        places = by_formula(name, rays, size, fov)
    places[theta > options.get("theta_max", 1.45)] = np.nan
    return places


@torch.no_grad()
@pytest.mark.parametrize("key", SHOWN)
def test_a_map_comes_back_as_scipy_interpolates_it(key):
    """It is 0 beyond the view's edges, has its border up to them, and the first column after the
    last if it goes around."""
    (height, width), options, around = SHOWN[key]
    view, places = make_view(key.split()[0], (height, width), **options), places_in(key)
    if "up" in options:  # rows show what the lens sees, and lie lower than the horizon
        shift = view.at(LENS, (48, 64)).to_view(np.array([[40.0, 14]]))[0] - places[14, 40]
        assert shift[0] == pytest.approx(0, abs=1e-3)
        places[..., 1] += shift[1]
    x, y = np.moveaxis(places, -1, 0)
    gaps = [-0.5 - y, y - height + 0.5] + [-0.5 - x, x - width + 0.5] * (not around)
    beyond = np.max(np.nan_to_num(gaps, nan=9), 0)
    sure, shown = np.abs(beyond) > 1e-2, beyond < 0
    assert 0.01 < shown.mean() < 0.95 and sure.mean() > 0.95
    prepared = view.prepare(LENS, (48, 64))
    assert (shown == prepared.shown[0].numpy())[sure].all()
    for scale in (1.0, 0.5, 0.25, 2.0):
        rows, columns = round(scale * height), round(scale * width)
        maps = torch.rand(1, 2, rows, columns) + 1
        padded = np.pad(maps[0].numpy(), ((0, 0), (1, 1), (0, 0)), "edge")
        padded = np.pad(padded, ((0, 0), (0, 0), (1, 1)), "wrap" if around else "edge")
        at = (y + 0.5) * rows / height + 0.5, (x + 0.5) * columns / width + 0.5
        expected = [map_coordinates(plane, np.nan_to_num(at), order=1) for plane in padded]
        found = view.back(maps, prepared)[0].numpy()
        np.testing.assert_allclose(found[:, sure], np.where(shown, expected, 0)[:, sure], atol=2e-3)


def ends_of(view, lens):
    """The azimuths of the outer edges of the middle row."""
    (height, width) = view.size
    points = torch.tensor([[[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]]])
    ends = view.to_rays(points, lens, SIZE)[0]
    return torch.atan2(ends[:, 0], ends[:, 2]).tolist()


@pytest.mark.parametrize("name", sorted(set(MAPS) - {"perspective"}))
def test_a_view_of_the_whole_lens_is_as_wide_as_the_picture(name):
    for lens, left, right in (
        (Equidistant(150.0, 1.5), -1.5, 1.5),  # the circle is inside the picture
        (Equidistant(150.0, 1.9), -1.9, 1.9),
        (Equidistant(400.0, 1.5), -320 / 400, 320 / 400),  # the picture cuts it
        (Equidistant(150.0, 1.8, center=[200.0, 240.0]), -200.5 / 150, 1.8),
    ):
        if name != "stereographic" or left == -right:  # whose middle is that of the lens
            # The square view of a lens that sees 640 × 480 pixels is as wide as its longer side.
            ends = ends_of(make_view(name, (300, 300)), lens)
            assert ends == pytest.approx([left, right], abs=2e-3)
        assert ends_of(make_view(name, (300, 300), fov=1.0), lens) == pytest.approx([-0.5, 0.5])


@every_ray_view
def test_nothing_is_shown_beyond_theta_max(name):
    view = make_view(name, (64, 64), theta_max=0.6)
    theta = view.pixel_rays(WIDE, SIZE)[0]
    assert 0.5 < theta[~theta.isnan()].max() <= 0.6 + 1e-3
    back = view.back(torch.ones(1, 1, 64, 64), view.prepare(WIDE, SIZE))
    grid = torch.stack(torch.meshgrid(torch.arange(640.0), torch.arange(480.0), indexing="xy"), -1)
    theta = WIDE.unproject_pixels(grid[None], SIZE)[0]
    assert not back[0, 0][theta[0] > 0.61].any() and back.any()
    # Points and rays that show nothing go nowhere.
    view = make_view(name, (64, 64), theta_max=0.5, **narrower(name))
    y, x = np.indices(view.size, float)
    shown = view.rays(WIDE, SIZE)[0].any(-1).numpy()
    places = view.at(WIDE, SIZE).to_image(np.stack((x, y), -1))
    assert 0 < shown.mean() < 1 and (np.isfinite(places).all(-1) == shown).all()
    nowhere = torch.tensor([[[0.0, 0.0, 0.0], [math.nan, 0.0, 1.0]]])
    assert make_view(name, (64, 64)).to_points(nowhere, WIDE, SIZE).isnan().all()


@every_ray_view
def test_pixels_are_means_of_their_points(name):
    image, options = torch.rand(1, 3, *SIZE), narrower(name)
    mean, parts, fine = (
        make_view(name, (side, side), supersampling=reads, **options)(image, WIDE)
        for side, reads in ((64, 3), (192, 1), (64, 1))
    )
    assert_close(mean, F.avg_pool2d(parts, 3), rtol=0, atol=2e-4)
    assert (fine - mean).abs().mean() > 0.05
    for side, reads in ((720, 1), (128, 4)):
        assert make_view(name, (side, side)).supersampling_of(WIDE, (1080, 1920)) == reads


def test_a_view_that_shrinks_is_as_opencv_reduces_a_flat_picture():
    picture = np.random.default_rng(0).integers(256, size=(60, 80), dtype=np.uint8)
    view = make_view("perspective", (30, 40), fov=2 * math.atan(40 / 60), supersampling=2)
    reduced = view.at(Perspective(60.0, 1.2), (60, 80))(picture)
    expected = cv2.resize(picture, (40, 30), interpolation=cv2.INTER_AREA)
    assert reduced.dtype == np.uint8 and np.abs(reduced.astype(int) - expected).max() <= 1


@every_ray_view
def test_a_lens_whose_axis_is_outside_of_the_picture(name):
    beside = WIDE.replace(center=torch.tensor([[320.0, -60.0]]))
    images, view = torch.ones(2, 1, *SIZE), make_view(name, (32, 96))
    if not view.around:
        refused("sees nothing of the lens: .*View.* of Kannala", view, images[:1], beside)
        behind = make_view(name, (8, 8), direction=(0, 0, -1), fov=1.0)
        refused("sees nothing of the lens", behind.prepare, Perspective(500.0, 0.5), SIZE)
    both = WIDE[[0, 0]].replace(center=torch.cat((WIDE.center_in(), beside.center_in())))
    back = view.back(torch.ones(2, 1, 32, 96), view.prepare(both, SIZE))
    assert back.isfinite().all() and view.ray_channels(both, SIZE).isfinite().all()
    assert back[0].max() > 0.99
    assert make_view(name, (32, 96), direction=(0, 1, 1))(images, beside).any()


@every_ray_view
def test_a_view_for_one_lens_is_the_same_view(name):
    lens, other = (Equidistant.from_fov(f, 60.0, image_size=(120, 160)).to(f64) for f in (2.5, 1))
    view = make_view(name, (40, 50))
    known, points = view.for_lens(lens, (120, 160)), 160 * torch.rand(1, 9, 2, dtype=f64)
    for each in (lens, other):
        places = known.to_view(points, each, (120, 160)), view.to_view(points, each, (120, 160))
        same = torch.equal(*(of.nan_to_num(-1) for of in places))
        assert same == (each is lens or name == "panorama")  # which is as wide for all


@pytest.mark.parametrize("name", [*RAY_VIEWS, "tiles"])
@pytest.mark.parametrize(("roll", "pitch"), [(0.5, 0.0), (0.0, 0.4), (-1.2, -0.5), (0.3, -1.3)])
def test_a_view_with_up_is_level_however_the_camera_is_held(name, roll, pitch):
    up = up_of(roll, pitch)
    # Camera → level frame: first the roll about the optical axis, then the pitch upwards.
    held = Rotation.from_euler("zx", [roll, pitch]).as_matrix()
    np.testing.assert_allclose(held @ up, [0, -1, 0], atol=1e-12)
    view = make_view(name, (41, 41), up=up)
    rays = view.rays(Equidistant(90.0, 2.0), SIZE)[0] @ torch.from_numpy(held.T).float()
    for tile in rays if name == "tiles" else rays[None]:
        # All rays of a vertical column have one heading, or its opposite beyond the zenith.
        for k in range(41) if name in UPRIGHT else [20]:
            column = tile[:, k][tile[:, k].norm(dim=-1) > 0.5]
            heading = F.normalize(column[:, ::2], dim=1)
            assert not len(column) or (heading @ heading[0]).abs().min() > 1 - 1e-4
            assert (column[1:, 1] > column[:-1, 1] - 1e-6).all() or name not in UPRIGHT


def test_a_panorama_of_a_camera_that_looks_down_shows_all_directions_below_the_horizon():
    view = make_view("panorama", (411, 1024), up=(0, 0, -1))
    rays = view.rays(Equidistant(150.0, math.radians(95)), (600, 600))[0]
    elevation = torch.rad2deg(torch.asin(rays[..., 2].clamp(-1, 1)))  # below the horizon
    shown = rays.norm(dim=-1) > 0.5
    assert shown.float().mean() > 0.95
    assert elevation[shown].min() < 1 and elevation[shown].max() == pytest.approx(80, abs=1.5)


def test_up_from_a_cameras_angles_and_extrinsics():
    assert up_of() == pytest.approx((0, -1, 0))
    assert up_of(math.pi / 2) == pytest.approx((-1, 0, 0))  # clockwise: the left side is up
    assert up_of(pitch=-math.pi / 2) == pytest.approx((0, 0, -1))  # it looks straight down
    # x right of the camera is -y of the vehicle, y down is -z, z forward is x.
    pose = np.array([[0, 0, 1, 5.0], [-1, 0, 0, 2], [0, -1, 0, 1]])
    assert up_of(extrinsics=pose) == pytest.approx((0, -1, 0))
    tilted = pose[:, :3] @ Rotation.from_euler("x", -0.3).as_matrix()
    assert up_of(extrinsics=tilted) == pytest.approx(up_of(pitch=-0.3))
    assert up_of(extrinsics=np.eye(4), world_up=(0, -2, 0)) == pytest.approx((0, -1, 0))


@pytest.mark.parametrize("count", range(4, 10))
def test_tiles_cover_what_a_lens_sees(count):
    for half in np.radians([60, 82.5, 95]).tolist():
        lens, size = Equidistant(60.0 / half, half), (120, 120)
        view = make_view("tiles", (64, 64), count=count, fov=2 * half)
        back = view.prepare(lens, size).back
        x, y = torch.meshgrid(torch.arange(120.0), torch.arange(120.0), indexing="xy")
        theta = lens.unproject_pixels(torch.stack((x, y), -1)[None], size)[0]
        inner = theta < 0.9 * half
        assert (back[inner] > -1).all(-1).float().mean() > (0.97 if count == 5 else 0.99)
        assert len({tile.direction for tile in view.tiles}) == count


def test_each_pixel_takes_the_tile_in_which_it_is_farthest_from_a_border():
    lens, size = Equidistant(60.0, 1.5), (200, 200)
    view = make_view("tiles", (64, 64))
    ones = torch.arange(5.0)[:, None, None, None].expand(5, 1, 64, 64)  # each tile its number
    owner = view.back(ones, view.prepare(lens, size))[0, 0].round(decimals=4)
    middles = torch.stack([torch.tensor(tile.direction) for tile in view.tiles])
    places = lens.project_points(middles[None], size)[0].round().long()
    assert [owner[y, x].item() for x, y in places.tolist()] == [0, 1, 2, 3, 4]
    assert set(owner.unique().tolist()) <= {0.0, 1.0, 2.0, 3.0, 4.0}  # tiles are never mixed
    coarse = view.back(F.avg_pool2d(ones, 8), view.prepare(lens, size))[0, 0]
    assert_close(coarse, owner, rtol=0, atol=1e-4)


def test_tiles_of_own_directions_and_those_that_see_nothing():
    directions = [(0, 0, 1), (1, 0, 0.2), (0, -1, 0.5)]
    view = make_view("tiles", (32, 48), directions=directions, tile_fov=1.5)
    assert view.count == 3 and isinstance(view, TilesView)
    assert view(torch.rand(2, 3, *SIZE), WIDE).shape == (6, 3, 32, 48)
    rays = make_view("tiles", (16, 16)).rays(Equidistant(200.0, 0.3), SIZE)
    assert rays.shape == (1, 5, 16, 16, 3)
    assert rays[0, 0].any() and not rays[0, 1:].any()


WRONG = [
    ("mercator", dict(fov=7.0), r"fov must be in \(0, 6.283\] rad, got 7"),
    ("mercator", dict(fov=0.0), "fov must be in"),
    ("mercator", dict(fov=math.nan), "fov must be in"),
    ("perspective", dict(fov=3.2), r"fov must be in \(0, 3.14\]"),
    ("perspective", dict(fov=1.0, reach=0.5), "either fov or reach, got 1.0 and 0.5"),
    ("perspective", dict(reach=1.6), r"reach must be in \(0, 1.57\] rad, got 1.6"),
    ("stereographic", dict(fov=120.0), r"120° is 2\.094"),
    ("mercator", dict(theta_max=4.0), "theta_max must be in"),
    ("mercator", dict(up=(0, 0, 0)), "up must be three finite numbers that are not all 0"),
    ("mercator", dict(up=(0, math.nan, 1)), "up must be three finite"),
    ("mercator", dict(direction=(1, 2)), "direction must be three finite"),
    ("mercator", dict(up="abc"), "up must be three finite numbers that are not all 0, got 'abc'"),
    ("mercator", dict(up=torch.zeros(2, 3)), "up must be three finite"),
    ("mercator", dict(supersampling=0), "supersampling must be an int from 1 to 16, got 0"),
    ("mercator", dict(supersampling=17), "supersampling must be an int from 1 to 16, got 17"),
    ("tiles", dict(count=3), "count must be from 4 to 9, got 3"),
    ("tiles", dict(fov=-1.0), "fov must be in"),
    ("tiles", dict(count=5.0), "count must be from 4 to 9, got 5.0"),
    ("tiles", dict(tile_fov=85), r"tile_fov must be in \(0, 5.934\] rad, got 85.* 85° is 1\.484"),
    ("tiles", dict(directions=[(0, 0, 1)]), "be given with tile_fov"),
    ("tiles", dict(directions=[], tile_fov=1.0), "directions must be one or more"),
    ("tiles", dict(directions=[(0, 0, 1)], tile_fov=1.0, count=7), "leave these out"),
    ("square", dict(spacing="r"), r"spacing must be one of .*, got 'r'"),
    ("square", dict(fov=7), r"fov must be in \(0, 2π\] rad, got 7"),
    ("square", dict(spacing="g", fov=2.0), "needs spacing='theta', got 'g'"),
    ("up_of", dict(roll=0.1, extrinsics=np.eye(3)), "either extrinsics, or roll and pitch"),
    ("up_of", dict(extrinsics=np.ones((3, 3))), "must be a rotation"),
    ("up_of", dict(extrinsics=np.eye(5)), "must be a rotation"),
    ("up_of", dict(extrinsics=np.diag([1.0, 1.0, -1.0])), "extrinsics must be a rotation"),
    ("up_of", dict(pitch=-35.0), r"pitch must be in .* -35° is -0\.6109"),
    ("up_of", dict(roll=35.0), r"roll must be in .* 35° is 0\.6109"),
]


@pytest.mark.parametrize(("name", "options", "message"), WRONG)
def test_wrong_options_are_explained(name, options, message):
    given = (up_of,) if name == "up_of" else (make_view, name, (8, 8))
    refused(message, *given, **options)
