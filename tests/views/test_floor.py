"""People on the floor: upright cylinders, whose silhouettes are found in level views."""

import math
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refused, slow_but

from darswin.lens import Equidistant, Equisolid
from darswin.views import CropView, make_view, up_of

SIZE = (1024, 1024)
LENS = Equidistant.from_fov(math.radians(185), 512, image_size=SIZE)
RADIUS, TALL = 0.25, 1.7
LOOKING_DOWN = math.radians(35)
# The height of a camera, what is up in its frame, and its axes: what is to the right and ahead.
CAMERAS = {
    "ceiling": (3.0, (0, 0, -1), (1, 0, 0), (0, -1, 0)),
    "wall": (2.5, up_of(pitch=-LOOKING_DOWN), (1, 0, 0),
             (0, -math.sin(LOOKING_DOWN), math.cos(LOOKING_DOWN))),
    "level": (1.5, (0, -1, 0), (1, 0, 0), (0, 0, 1)),
}  # fmt: skip
RING = [
    (math.sin(0.9) * math.cos(a), math.sin(0.9) * math.sin(a), math.cos(0.9))
    for a in np.radians(range(0, 360, 60))
]
VIEWS = {
    "mercator": dict(size=(512, 512)),
    "panorama": dict(size=(288, 864)),
    "cylindrical": dict(size=(512, 512), fov=2.6),
    "equirectangular": dict(size=(512, 512)),
    "tiles": dict(size=(512, 512), count=5),
    "ring": dict(size=(512, 512), directions=RING, tile_fov=math.radians(85)),
    "perspective": dict(size=(512, 512), fov=1.7),
}


def people(camera):
    """The places of people, (N, 2), and the surfaces of their cylinders in the camera's frame."""
    height, up, right, ahead = CAMERAS[camera]
    azimuth, distance = np.meshgrid(np.radians(np.arange(-180, 180, 20)), np.arange(1, 8.5))
    places = (distance * [np.sin(azimuth), np.cos(azimuth)]).reshape(2, -1).T
    turn, above = np.meshgrid(np.linspace(0, 2 * np.pi, 361), np.linspace(0, TALL, 25))
    around = RADIUS * np.stack((np.cos(turn), np.sin(turn)), -1).reshape(-1, 2)
    x, y = np.moveaxis(places[:, None] + around, -1, 0)
    z = np.broadcast_to(above.reshape(-1) - height, x.shape)
    return places, np.stack((x, y, z), -1) @ np.array([right, ahead, up], float)


def remap_of(view, up, lens=LENS):
    options = VIEWS[view] | {"up": up}
    return make_view("tiles" if view == "ring" else view, **options).at(lens, SIZE)


@cache
def boxes_of(view, camera, up=None, lens=LENS):
    """For each tile, the boxes of the people that the picture and the tile show whole, and where
    they stand. The view takes `up` for what is up, and `LENS` for the lens of the picture."""
    places, surfaces = people(camera)
    pixels = lens.project_points(torch.from_numpy(surfaces), SIZE).numpy()
    shown = ((pixels > 0) & (pixels < SIZE[0] - 1)).all((1, 2))  # not NaN
    places, pixels = places[shown], pixels[shown]
    found = []
    for tile in remap_of(view, up or CAMERAS[camera][1]).tiles:
        points = tile.to_view(pixels) + 0.5
        box = np.concatenate((points.min(1), points.max(1)), 1)
        height, width = tile.view_size
        inside = (box[:, :2] > 0).all(1) & (box[:, 2] < width) & (box[:, 3] < height - 1)
        inside &= box[:, 2] - box[:, 0] < width / 2  # not at the seam
        found.append((tile, box[inside], places[inside]))
    return found


def errors(view, camera, *, noise=0.0, higher=0.0, up=None, lens=LENS, radius=RADIUS):
    """The errors (N,) in metres of people whom any tile shows, and how far they are, if the height
    is higher, or something else is not as `CAMERAS` and `LENS` say."""
    rng, (height, known, *_) = np.random.default_rng(0), CAMERAS[camera]
    apart, far = [], []
    for tile, box, places in boxes_of(view, camera, up, lens):
        box = box + rng.uniform(-noise, noise, box.shape)
        found = tile.floor(box, height + higher, up or known, radius)
        apart.append(np.hypot(*(found - places).T))
        far.append(np.hypot(*places.T))
    return np.concatenate(apart), np.concatenate(far)


PAIRS = sorted({*product(VIEWS, CAMERAS)} - {("cylindrical", "ceiling")})  # which shows nobody


@pytest.mark.parametrize(("view", "camera"), slow_but(PAIRS, *PAIRS[::4]))
def test_people_are_found_where_they_stand(view, camera):
    apart, far = errors(view, camera)
    assert len(apart) >= (9 if view == "perspective" else 40)
    assert (apart / far).max() < 1e-3  # the goal is 1 %
    apart, far = errors(view, camera, noise=0.5)  # px
    assert np.quantile(apart / far, 0.9) < 0.015


@pytest.mark.parametrize("view", ["mercator", "tiles"])
def test_without_a_radius_the_nearest_points_are_found(view):
    apart, _ = errors(view, "level", radius=0)
    assert apart == pytest.approx(RADIUS, abs=0.02 if view == "tiles" else 1e-4)


@pytest.mark.parametrize("lean", [(0, 0), (0.1, 0), (-0.05, 0.08)])
def test_a_camera_that_looks_down_has_the_top_of_its_picture_ahead(lean):
    """Whatever it leans by a little: the axes do not turn with it."""
    up = np.array([*lean, -1])
    remap = remap_of("panorama", up)
    ray = torch.tensor([[0.0, -1, 1]]).double()
    (x, y) = remap.to_view(LENS.project_points(ray, SIZE))[0].tolist()
    right, ahead = remap.floor([[x - 9.5, y - 60, x + 10.5, y + 0.5]], 2.0, up)[0]
    assert ahead == pytest.approx(2, abs=0.4) and abs(right) < 0.4


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("view", ["mercator", "tiles"])
def test_what_does_not_meet_the_floor_is_nan(view):
    tile = remap_of(view, (0, -1, 0)).tiles[0]
    height, width = tile.view_size
    middle = [width / 2 - 10, height / 2 - 40, width / 2 + 10]
    box = np.array([
        [*middle, height / 2 - 5],  # above the horizon
        [*middle, height / 2],  # on it
        [*middle, height / 2 + 30],
        [middle[0], middle[1], middle[0], height / 2 + 30],  # without an area
        [*middle, height],  # cut
        [*middle, height + 5],
        [np.nan] * 4,
        [-np.inf, *middle[1:], height / 2 + 30],
        [-np.inf, middle[1], np.inf, height / 2 + 30],
    ])  # fmt: skip
    found = tile.floor(box, 1.5, (0, -1, 0))
    assert np.isnan(found).all(1).tolist() == [True] * 2 + [False] + [True] * 6
    assert tile.floor(np.zeros((0, 4)), 1.5, (0, -1, 0)).shape == (0, 2)
    same = tile.floor(torch.from_numpy(box).float(), 1.5, torch.tensor([0.0, -2, 0]))
    assert same.dtype == torch.float32
    np.testing.assert_allclose(same.numpy(), found, rtol=1e-4)
    if view == "tiles":  # no upright thing has such a box
        assert np.isnan(tile.floor([[300, 300, 480, 301]], 1.5, (0, -1, 0), 0.25)).all()


def test_what_is_wrong_is_named():
    up, not_level = (0, -1, 0), "only in a level view, such as mercator"
    mercator = make_view("mercator", SIZE)
    for view, argv, said in (
        (mercator, (None, up), "`height` must be above 0 m, got None"),
        (mercator, (0, up), "`height` must be above 0 m, got 0"),
        (mercator, (1.5, None), "up must be three finite numbers that are not all 0, got None"),
        (mercator, (1.5, up, -1), "`radius` must be at least 0 m"),
        (mercator, (1.5, (0, -1, 0.2)), r"level with up=\(-?0, -1, -?0\), not \(0, -0.981, 0.1"),
        (make_view("none", SIZE), (1.5, up), not_level),
        (CropView((0, 0, 90, 90), (90, 90)), (1.5, up), not_level),
        (make_view("tiles", SIZE), (1.5, up), not_level),
    ):
        refused(said, view.at(LENS, SIZE).floor, [[400, 400, 450, 520]], *argv)


def tilted(camera, degrees):
    """What is up for a camera that looks higher than it is told, by some degrees."""
    _, up, right, _ = CAMERAS[camera]
    angle, up, right = math.radians(degrees), np.array(up), np.array(right, float)
    return tuple(np.cos(angle) * up + np.sin(angle) * np.cross(right, up))


OTHER = Equisolid.from_fov(math.radians(185), 512, image_size=SIZE)
LONGER = Equidistant(1.02 * LENS.focal, LENS.theta_max / 1.02, image_size=SIZE)
COSTS = {
    "nothing": lambda _: {},
    "the sides of boxes, by up to 0.5 px": lambda _: dict(noise=0.5),
    "the radius: 0 for 0.25 m": lambda _: dict(radius=0.0),
    "the height, by 5 cm": lambda _: dict(higher=0.05),
    "the tilt, by 1°": lambda camera: dict(up=tilted(camera, 1)),
    "the tilt, by 2°": lambda camera: dict(up=tilted(camera, 2)),
    "the focal length, by 2 %": lambda _: dict(lens=LONGER),
    "the model of the lens, for the same 185°": lambda _: dict(lens=OTHER),
}


@pytest.mark.slow
def test_the_page_tells_what_errors_cost():
    page = (Path(__file__).parents[2] / "docs/howto/floor.md").read_text()
    for name, case in COSTS.items():
        cells = []
        for camera in ("ceiling", "wall", "level"):
            apart, _ = errors("tiles", camera, **case(camera))
            cells.append("{:.0f} / {:.0f}".format(*(100 * np.nanquantile(apart, (0.5, 0.9)))))
        assert f"| {name} | {' | '.join(cells)} |" in page
