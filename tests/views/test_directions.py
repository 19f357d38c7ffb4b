"""Views along rays: their maps of the sphere, what they show of a lens, and which way is up."""

import math

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers import product
from hypothesis import given
from hypothesis import strategies as st
from lens_examples import every_lens
from scipy.spatial.transform import Rotation

from darswin.lens import Equidistant, KannalaBrandt, Perspective
from darswin.views import RayView, TilesView, list_views, make_view, up_of
from darswin.views.registry import _VIEWS

SIZE = (480, 640)
WIDE = KannalaBrandt(140.0, [0.01], math.radians(95), center=[322.0, 238.0])
RAY_VIEWS = sorted(n for n in list_views() if isinstance(_VIEWS[n], type)
                   and issubclass(_VIEWS[n], RayView))  # fmt: skip
UPRIGHT = [name for name in RAY_VIEWS if _VIEWS[name].upright]
OF_PIXELS = sorted(set(list_views()) - {"polar"})
every_ray_view = pytest.mark.parametrize("name", RAY_VIEWS)
f64 = torch.float64


def rays_of(count, seed=0):
    return F.normalize(torch.randn(count, 3, generator=torch.manual_seed(seed), dtype=f64), dim=1)


# -- the maps -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "warper"), [("mercator", "mercator"), ("cylindrical", "cylindrical")]
)
def test_maps_of_the_sphere_are_those_of_opencv(name, warper):
    view, camera = make_view(name, (8, 8)), np.eye(3, dtype=np.float32)
    theirs = cv2.PyRotationWarper(warper, 1.0)
    for x, y in ((0.0, 0.0), (0.3, -0.2), (-2.0, 1.0), (0.1, 3.0)):
        ray = F.normalize(torch.tensor([[x, y, 1.0]], dtype=f64), dim=1)
        np.testing.assert_allclose(
            view.to_plane(ray)[0], theirs.warpPoint((x, y), camera, camera), atol=1e-6
        )


def test_the_stereographic_picture_is_that_of_the_lens_and_the_tangent_one_of_a_pinhole():
    size, rays = (101, 151), rays_of(200)
    for name, lens in (
        ("perspective", Perspective(75.5 / math.tan(0.6), image_size=size)),
        ("stereographic", None),
    ):
        view = make_view(name, size, fov=1.2)
        points = view.to_points(rays[None], WIDE.to(f64), SIZE)[0]
        if lens is None:
            cos, sin = rays[:, 2], rays[:, :2].norm(dim=1)
            r = 75.5 / math.tan(0.3) * torch.tan(torch.atan2(sin, cos) / 2)
            expected = rays[:, :2] / sin[:, None] * r[:, None] + torch.tensor([75.0, 50.0])
        else:
            expected = lens.to(f64).project_points(rays[None])[0]
        torch.testing.assert_close(points, expected, rtol=1e-5, atol=1e-4, equal_nan=True)


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
    torch.testing.assert_close(rays[shown].norm(dim=-1), torch.ones(int(shown.sum()), dtype=f64))
    # Near the ends of the plane, an angle of rounding is many pixels.
    end = torch.tensor(view.up if name in UPRIGHT else (0.0, 0.0, -1.0), dtype=f64)
    along = rays.nan_to_num() @ end
    shown &= (along.abs() if name in UPRIGHT else along) < 1 - 1e-6
    torch.testing.assert_close(view.to_points(rays, lens, SIZE)[shown],
                               points.expand(rays.shape[0], -1, -1)[shown],
                               rtol=1e-6, atol=1e-5)  # fmt: skip


@pytest.mark.parametrize(("name", "model"), product(OF_PIXELS, every_lens()))
def test_points_go_through_every_lens_and_come_back(name, model):
    lens, size = every_lens()[model]
    view = make_view(name, size if name == "none" else (200, 200))
    places = np.random.default_rng(0).uniform(0, 1, (1000, 2)) * size[::-1] - 0.5
    shares = []
    for tile in view.at(lens, size).tiles:
        points = tile.to_view(places)
        seen = ((points > 0) & (points < (size[::-1] if name == "none" else 199))).all(-1)
        shares.append(seen.mean())
        again = tile.to_image(points[seen])
        np.testing.assert_allclose(again, places[seen], rtol=0, atol=2e-4)
    assert max(shares) > 0.01
    beyond = tile.to_view(np.array([[-2.0, 5.0], [5.0, size[0] + 1.0]]))
    assert np.isnan(tile.to_image(beyond)).any(-1).all()


@every_ray_view
def test_what_a_view_reads_is_where_its_points_go(name):
    view = make_view(name, (40, 50), supersampling=1)
    prepared = view.prepare(WIDE, SIZE)
    grid = np.stack(np.meshgrid(np.arange(50.0), np.arange(40.0)), -1)
    places = view.at(WIDE, SIZE).to_image(grid)
    read = prepared.points[0].double().numpy()
    seen = ~np.isnan(places).any(-1)
    assert (read[~seen] == -10).all()
    np.testing.assert_allclose(read[seen], places[seen], atol=2e-3)
    np.testing.assert_allclose(
        WIDE.project_points(view.rays(WIDE, SIZE), SIZE)[0][torch.from_numpy(seen)],
        places[seen], atol=2e-3,
    )  # fmt: skip


# -- what a view shows --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mercator", "equirectangular", "cylindrical", "stereographic"])
@pytest.mark.parametrize(
    ("lens", "half"),
    [
        (Equidistant(150.0, 1.5), 1.5),  # the circle is inside the picture
        (Equidistant(150.0, 1.9), 1.9),
        (Equidistant(400.0, 1.5), 320 / 400),  # the picture cuts it
    ],
)
def test_a_view_of_the_whole_lens_is_as_wide_as_the_picture(name, lens, half):
    view = make_view(name, (300, 300))
    ends = view.to_rays(torch.tensor([[[-0.5, 149.5], [299.5, 149.5]]]), lens, SIZE)[0]
    # The square picture of a lens that sees 640 × 480 pixels is as wide as its longer side.
    angles = torch.atan2(ends[:, 0], ends[:, 2])
    torch.testing.assert_close(angles, torch.tensor([-half, half]), rtol=0, atol=2e-3)
    narrow = make_view(name, (300, 300), fov=1.0).to_rays(
        torch.tensor([[[-0.5, 149.5], [299.5, 149.5]]]), lens, SIZE
    )[0]
    torch.testing.assert_close(torch.atan2(narrow[:, 0], narrow[:, 2]), torch.tensor([-0.5, 0.5]))


def test_a_view_follows_a_lens_off_the_middle():
    lens = Equidistant(150.0, 1.8, center=[200.0, 240.0])
    view = make_view("mercator", (101, 201))
    ends = view.to_rays(torch.tensor([[[-0.5, 50.0], [200.5, 50.0]]]), lens, SIZE)[0]
    expected = torch.tensor([-200.5 / 150, 1.8])
    torch.testing.assert_close(torch.atan2(ends[:, 0], ends[:, 2]), expected, rtol=0, atol=2e-3)


@every_ray_view
def test_nothing_is_shown_beyond_theta_max(name):
    view = make_view(name, (64, 64), theta_max=0.6)
    theta = view.pixel_rays(WIDE, SIZE)[0]
    assert 0.5 < theta[~theta.isnan()].max() <= 0.6 + 1e-3
    back = view.back(torch.ones(1, 1, 64, 64), view.prepare(WIDE, SIZE))
    of_image = torch.arange(640.0).expand(480, -1), torch.arange(480.0)[:, None].expand(-1, 640)
    theta = WIDE.unproject_pixels(torch.stack(of_image, -1)[None], SIZE)[0]
    assert not back[0, 0][theta[0] > 0.61].any() and back.any()


@every_ray_view
def test_pixels_are_means_of_their_points(name):
    image = torch.rand(1, 3, *SIZE)
    fine = make_view(
        name, (64, 64), supersampling=1, **({} if name == "panorama" else dict(fov=1.5))
    )
    for reads in (2, 3):
        options = {} if name == "panorama" else dict(fov=1.5)
        mean = make_view(name, (64, 64), supersampling=reads, **options)(image, WIDE)
        parts = make_view(name, (64 * reads, 64 * reads), supersampling=1, **options)(image, WIDE)
        torch.testing.assert_close(mean, F.avg_pool2d(parts, reads), rtol=0, atol=2e-4)
    assert (fine(image, WIDE) - mean).abs().mean() > 0.05
    large, small = (
        make_view(name, (side, side)).supersampling_of(WIDE, (1080, 1920)) for side in (720, 128)
    )
    assert (large, small) == (1, 4)


@pytest.mark.slow
def test_views_of_many_lenses_are_those_of_each():
    lenses = Equidistant([100.0, 150.0, 400.0], [1.9, 1.5, 1.2])
    for name in RAY_VIEWS:
        view = make_view(name, (32, 48))
        together = view.prepare(lenses, SIZE)
        for k in range(3):
            alone = view.prepare(lenses[k], SIZE)
            for field in ("points", "back"):
                torch.testing.assert_close(getattr(together, field)[k], getattr(alone, field)[0])
            rays = view.ray_channels(lenses, SIZE)[k], view.ray_channels(lenses[k], SIZE)[0]
            torch.testing.assert_close(*rays)


# -- up -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*RAY_VIEWS, "tiles"])
@pytest.mark.parametrize(("roll", "pitch"), [(0.5, 0.0), (0.0, 0.4), (-1.2, -0.5), (0.3, -1.3)])
def test_a_view_with_up_is_level_however_the_camera_is_held(name, roll, pitch):
    up = up_of(roll, pitch)
    # Camera → level frame: first the roll about the optical axis, then the pitch upwards.
    held = Rotation.from_euler("zx", [roll, pitch]).as_matrix()
    np.testing.assert_allclose(held @ up, [0, -1, 0], atol=1e-12)
    view = make_view(name, (41, 41), up=up)
    rays = view.rays(Equidistant(90.0, 2.0), SIZE)[0] @ torch.from_numpy(held.T).float()
    tiles = rays if name == "tiles" else rays[None]
    for tile in tiles:
        column = tile[:, 20][tile[:, 20].norm(dim=-1) > 0.5]
        # The middle column is vertical in the world: all its rays have one heading.
        heading = F.normalize(column[:, ::2], dim=1)
        same = (heading @ heading[0]).abs()
        assert same.min() > 1 - 1e-4
        assert (column[1:, 1] > column[:-1, 1] - 1e-6).all() or name != "mercator"


@pytest.mark.parametrize("name", UPRIGHT)
def test_all_columns_of_an_upright_view_are_vertical(name):
    held = Rotation.from_euler("zx", [0.4, -0.6]).as_matrix()
    rays = make_view(name, (30, 30), up=up_of(0.4, -0.6)).rays(Equidistant(90.0, 2.0), SIZE)[0]
    world = rays @ torch.from_numpy(held.T).float()
    heading = torch.atan2(world[..., 0], world[..., 2])
    for column, shown in zip(heading.T, (world.norm(dim=-1) > 0.5).T, strict=True):
        if shown.any():
            assert column[shown].max() - column[shown].min() < 1e-4


def test_a_panorama_of_a_camera_that_looks_down_shows_all_directions_below_the_horizon():
    lens, view = (
        Equidistant(150.0, math.radians(95)),
        make_view("panorama", (411, 1024), up=(0, 0, -1)),
    )
    rays = view.rays(lens, (600, 600))[0]
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


# -- tiles --------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", range(4, 10))
@pytest.mark.parametrize("half_deg", [60, 82.5, 95])
def test_tiles_cover_what_a_lens_sees(count, half_deg):
    half = math.radians(half_deg)
    lens, size = Equidistant(60.0 / half, half), (120, 120)
    view = make_view("tiles", (64, 64), count=count, fov=2 * half)
    back = view.prepare(lens, size).back
    grid = torch.stack(torch.meshgrid(torch.arange(120.0), torch.arange(120.0), indexing="xy"), -1)
    theta = lens.unproject_pixels(grid[None], size)[0]
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
    torch.testing.assert_close(coarse, owner, rtol=0, atol=1e-4)


def test_a_tile_that_sees_nothing_of_the_lens_has_no_rays():
    lens = Equidistant(200.0, 0.3)
    rays = make_view("tiles", (16, 16)).rays(lens, SIZE)
    assert rays.shape == (1, 5, 16, 16, 3)
    assert rays[0, 0].any() and not rays[0, 1:].any()


def test_own_directions():
    directions = [(0, 0, 1), (1, 0, 0.2), (0, -1, 0.5)]
    view = make_view("tiles", (32, 48), directions=directions, tile_fov=1.5)
    assert view.count == 3 and isinstance(view, TilesView)
    assert view(torch.rand(2, 3, *SIZE), WIDE).shape == (6, 3, 32, 48)


# -- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("mercator", dict(fov=7.0), r"fov must be in \(0, 6.283\] rad, got 7"),
        ("mercator", dict(fov=0.0), "fov must be in"),
        ("mercator", dict(fov=math.nan), "fov must be in"),
        ("perspective", dict(fov=3.2), r"fov must be in \(0, 3.14\]"),
        ("stereographic", dict(fov=120.0), r"120° is 2\.094"),
        ("mercator", dict(theta_max=4.0), "theta_max must be in"),
        ("mercator", dict(up=(0, 0, 0)), "up must be three finite numbers that are not all 0"),
        ("mercator", dict(up=(0, math.nan, 1)), "up must be three finite"),
        ("mercator", dict(direction=(1, 2)), "direction must be three finite"),
        ("mercator", dict(up=5), "up must be three finite numbers that are not all 0, got 5"),
        ("mercator", dict(up="abc"), "up must be three finite"),
        ("mercator", dict(up=torch.zeros(2, 3)), "up must be three finite"),
        ("mercator", dict(supersampling=0), "supersampling must be an int from 1 to 16, got 0"),
        ("mercator", dict(supersampling=17), "supersampling must be an int from 1 to 16, got 17"),
        ("tiles", dict(count=3), "count must be from 4 to 9, got 3"),
        ("tiles", dict(fov=-1.0), "fov must be in"),
        ("tiles", dict(count=5.0), "count must be from 4 to 9, got 5.0"),
        ("tiles", dict(tile_fov=0.0), r"tile_fov must be in \(0, 5.934\] rad, got 0.0"),
        ("tiles", dict(tile_fov=85), r"tile_fov must be in .* 85° is 1\.484"),
        ("tiles", dict(directions=[(0, 0, 1)]), "be given with tile_fov"),
        ("tiles", dict(directions=[], tile_fov=1.0), "directions must be one or more"),
        ("tiles", dict(directions=[(0, 0, 1)], tile_fov=1.0, direction=(1, 0, 0)), "leave these"),
        ("tiles", dict(directions=[(0, 0, 1)], tile_fov=1.0, count=7), "leave these out"),
    ],
)
def test_wrong_options_are_explained(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_view(name, (8, 8), **options)


@pytest.mark.parametrize("name", ["mercator", "stereographic", "perspective"])
def test_a_view_that_sees_nothing_of_the_lens_says_so(name):
    narrow = Perspective(500.0, 0.5)
    for options in (dict(direction=(0, 0, -1)), dict(direction=(0, 0, -1), fov=1.0)):
        view = make_view(name, (8, 8), **options)
        with pytest.raises(ValueError, match=r"sees nothing of the lens: .*View.* of Perspective"):
            view.prepare(narrow, SIZE)


def test_angles_and_extrinsics_are_one_or_the_other():
    with pytest.raises(ValueError, match="either extrinsics, or roll and pitch"):
        up_of(0.1, extrinsics=np.eye(3))
    for wrong in (np.ones((3, 3)), np.eye(5)):
        with pytest.raises(ValueError, match="must be a rotation"):
            up_of(extrinsics=wrong)
    with pytest.raises(ValueError, match="one lens, got 2"):
        make_view("mercator", (8, 8)).at(Equidistant([9.0, 9.0]), SIZE)


@every_ray_view
def test_a_view_for_one_lens_is_the_same_view(name):
    lens, other = (Equidistant.from_fov(f, 60.0, image_size=(120, 160)).to(f64) for f in (2.5, 1))
    view = make_view(name, (40, 50))
    known, points = view.for_lens(lens, (120, 160)), 160 * torch.rand(1, 9, 2, dtype=f64)
    for one in (lens, other):
        found = known.to_view(points, one, (120, 160)), view.to_view(points, one, (120, 160))
        same = torch.equal(*(points.nan_to_num(-1) for points in found))
        assert same == (one is lens or name == "panorama")  # which is as wide for all


@pytest.mark.parametrize("name", OF_PIXELS)
def test_sizes_of_views_are_pairs_or_the_side_of_a_square(name):
    side = 16
    for size in ([side, side], (np.int64(side), side), side):
        assert make_view(name, size).size == (side, side)
    for wrong in (16.5, (16.0, 16.0), (16,), "16"):
        with pytest.raises(TypeError, match="size must be a pair of ints, got"):
            make_view(name, wrong)
    for wrong in ((0, 0), (-4, -4)):
        with pytest.raises(ValueError, match="size must be at least 1"):
            make_view(name, wrong)


@pytest.mark.parametrize("name", OF_PIXELS)
def test_points_of_another_size_and_shape_are_refused(name):
    view, lens = make_view(name, (16, 16)), WIDE.replace(image_size=torch.tensor([SIZE]))
    with pytest.raises(ValueError, match=r"images of \(H, W\) = \(480, 640\)"):
        view.at(lens, (240, 320))
    for move in (view.at(lens, SIZE).to_image, view.at(lens, SIZE).to_view):
        with pytest.raises(ValueError, match=r"points must have shape \(..., 2\), got \(3,\)"):
            move([1.0, 2.0, 3.0])


@pytest.mark.parametrize("name", RAY_VIEWS)
def test_pixels_and_rays_that_show_nothing_go_nowhere(name):
    view = make_view(name, (64, 64), fov=2.0, theta_max=0.5)
    y, x = np.indices(view.size, float)
    shown = view.rays(WIDE, SIZE)[0].any(-1).numpy()
    places = view.at(WIDE, SIZE).to_image(np.stack((x, y), -1))
    assert 0 < shown.mean() < 1
    assert (np.isfinite(places).all(-1) == shown).all()
    nowhere = torch.tensor([[[0.0, 0.0, 0.0], [math.nan, 0.0, 1.0]]])
    assert make_view(name, (64, 64)).to_points(nowhere, WIDE, SIZE).isnan().all()


@pytest.mark.parametrize("name", RAY_VIEWS)
def test_a_lens_whose_axis_is_outside_of_the_picture(name):
    beside = WIDE.replace(center=torch.tensor([[320.0, -60.0]]))
    images, view = torch.ones(2, 1, *SIZE), make_view(name, (32, 96))
    if not view.around:
        with pytest.raises(ValueError, match="sees nothing of the lens"):
            view(images[:1], beside)
    lenses = torch.cat((WIDE.center_in(), beside.center_in()))
    both = WIDE[[0, 0]].replace(center=lenses)
    back = view.back(torch.ones(2, 1, 32, 96), view.prepare(both, SIZE))
    assert back.isfinite().all() and view.ray_channels(both, SIZE).isfinite().all()
    assert (
        back[0].max() > 0.99
        and make_view(name, (32, 96), direction=(0, 1, 1))(images, beside).any()
    )


def test_images_of_ints_are_refused():
    for name in OF_PIXELS:
        with pytest.raises(TypeError, match="images must be uint8 or in floating point, got"):
            make_view(name, (16, 16))(torch.zeros(1, 3, *SIZE, dtype=torch.int32), WIDE)


def test_degrees_and_reflections_are_no_up():
    with pytest.raises(ValueError, match=r"pitch must be in .* -35° is -0\.6109"):
        up_of(pitch=-35.0)
    with pytest.raises(ValueError, match=r"roll must be in .* 35° is 0\.6109"):
        up_of(roll=35.0)
    with pytest.raises(ValueError, match="extrinsics must be a rotation"):
        up_of(extrinsics=np.diag([1.0, 1.0, -1.0]))
