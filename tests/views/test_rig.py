"""Views of rigs, against scenes whose every ray is known, and OpenCV's projections."""

import math
import warnings

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from darswin import Rig
from darswin.boxes import Instances
from darswin.lens import Equidistant, Equisolid, KannalaBrandt, Spherical
from darswin.views import CameraView, GroundView, PolarView, make_view

SIDE = 64
WIDE = math.radians(95)
COEFFICIENTS = [0.02, -0.01, 0.003, -0.0005]


def fisheye(size=(120, 160), focal=48.0):
    return KannalaBrandt(focal, radial=COEFFICIENTS, theta_max=WIDE, image_size=size)


def pose(yaw=0.0, pitch=0.0, place=(0.0, 0.0, 0.0)):
    """Of a camera in a vehicle's frame (x forward, y left, z up), turned to the left and down."""
    axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turn = Rotation.from_euler("ZY", (yaw, pitch), degrees=True).as_matrix()
    return np.block([[turn @ axes, np.array(place)[:, None]], [np.eye(4)[3]]])


def car(**changed):
    """Four cameras of 190° on a car; `changed` replaces poses."""
    poses = dict(
        front=pose(0, 30, (3.7, 0, 0.7)), right=pose(-90, 40, (1.9, -0.95, 1.0)),
        back=pose(180, 30, (-1.0, 0, 0.9)), left=pose(90, 40, (1.9, 0.95, 1.0)),
    ) | changed  # fmt: skip
    return Rig({name: (fisheye(), None, at) for name, at in poses.items()})


def colour(at):
    """A smooth colour of each direction or place (..., 3), by which pictures are known exactly."""
    x, y, z = np.moveaxis(at, -1, 0)
    return 120 + 50 * np.sin(3 * x + y) + 40 * np.cos(2 * y - z) + 30 * np.sin(2.5 * z)


def rays_of(camera):
    """The rays (H, W, 3) of a camera's pixels in the rig's frame, NaN where it has none."""
    y, x = np.mgrid[: camera.size[0], : camera.size[1]].astype(float)
    rays = camera.lens.unproject_points(torch.from_numpy(np.stack((x, y), -1))[None])[0].numpy()
    return rays @ camera.pose[:3, :3].T


def on_ground(camera):
    """What a camera sees of the ground, in units of 3.3 m."""
    rays = rays_of(camera)
    with np.errstate(invalid="ignore", divide="ignore"):
        far = np.where(rays[..., 2] < -0.02, -camera.pose[2, 3] / rays[..., 2], np.nan)
    return 0.3 * (camera.pose[:3, 3] + far[..., None] * rays)


def pictures(rig, at_pixels=rays_of):
    return {
        name: np.nan_to_num(colour(at_pixels(camera))).astype(np.float32)
        for name, camera in rig.cameras.items()
    }


def room(rays):
    """The distances of the walls of a room, (±3, ±2, ±4), with a pillar in front of one."""
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.min(np.array([3, 2, 4]) / np.abs(rays), -1)
        front = 1.5 / rays[..., 2]
    pillar = (rays[..., 2] > 0.3) & (np.abs(rays[..., 0] / rays[..., 2] - 0.3) < 0.1)
    return np.where(pillar, np.minimum(front, walls), walls), walls, front


def places_of(remap):
    """The directions or places of all pixels of a view in the rig's frame."""
    y, x = np.mgrid[: remap.view_size[0], : remap.view_size[1]].astype(float)
    at = remap.view.places(torch.from_numpy(np.stack((x, y), -1))[None])[0].numpy()
    return at @ remap.rig.level.T


LENSES = {
    "KannalaBrandt": fisheye((SIDE, SIDE), 18.0),
    "Equisolid": Equisolid(17.0, theta_max=WIDE, image_size=(SIDE, SIDE)),
    "Spherical": Spherical(1.0, 40.0, theta_max=1.5, image_size=(SIDE, SIDE)),
    "whole sphere": Equidistant(9.0, theta_max=math.radians(179), image_size=(SIDE, SIDE)),
}


@pytest.mark.parametrize("name", LENSES)
def test_a_fisheye_from_a_cube_shows_what_the_lens_would(name):
    rig, lens = Rig.cube(128), LENSES[name]
    remap = CameraView(lens).at(rig)
    picture, distance = remap(pictures(rig)), remap.depth(
        {n: np.float32(room(r)[0] * (r @ rig[n].pose[:3, 2])) for n, r in
         ((n, rays_of(c)) for n, c in rig.cameras.items())})  # fmt: skip
    rays = rays_of(Rig.single(lens)["camera"])
    seen = np.isfinite(rays).all(-1)
    assert (picture[~seen & ~remap.shown] == 0).all() and remap.shown[seen].all()
    assert np.isnan(distance[~seen]).all()
    # The mean over a pixel differs from its middle by the curvature of the colours.
    assert np.abs(picture - colour(rays))[seen].max() < 4
    error = np.abs(distance - room(rays)[0])[seen]
    assert np.quantile(error, 0.9) < 2e-3
    # No surface stands between the pillar and the walls: each distance is one of both.
    got, walls, front = distance[seen], *(of[seen] for of in room(rays)[1:])
    apart = np.minimum(np.abs(got - walls) / walls, np.abs(got - front) / np.abs(front))
    assert apart.max() < 0.05


@pytest.mark.parametrize("seam", ["hard", "narrow", "wide"])
def test_the_ground_around_a_car_is_where_it_is(seam):
    rig = car()
    remap = GroundView((80, 60), 9.0, (1.4, 0.5)).at(rig, seam=seam)
    y, x = np.mgrid[:80, :60]
    ahead, left = 1.4 + (39.5 - y) * 0.15, 0.5 + (29.5 - x) * 0.15
    truth = np.stack((ahead, left, np.zeros_like(left)), -1)
    np.testing.assert_allclose(places_of(remap), truth, atol=1e-12)
    shown = remap.shown & ~((np.abs(ahead - 1.4) < 2.7) & (np.abs(left) < 1.2))
    picture = remap(pictures(rig, on_ground))
    assert shown.mean() > 0.8 and np.abs(picture - colour(0.3 * truth))[shown].max() < 12
    assert np.abs(picture - colour(0.3 * truth))[shown].mean() < 0.5
    sums = np.bincount(remap.reads.pixels, remap.reads.weights, 80 * 60)
    np.testing.assert_allclose(sums, remap.shown.ravel(), atol=1e-5)


def test_places_are_those_of_opencv():
    rig = car()
    remap = GroundView((40, 40), 9.0, (1.4, 0)).at(rig)
    pixels = np.random.default_rng(0).uniform(0, 39, (200, 2))
    sources, onto = remap.to_image(pixels)
    ahead, left = 1.4 + (19.5 - pixels[:, 1]) * 0.225, (19.5 - pixels[:, 0]) * 0.225
    matrix = np.array([[48.0, 0, 79.5], [0, 48.0, 59.5], [0, 0, 1]])
    assert {*sources.tolist()} == {-1, 0, 1, 2, 3}
    for k, camera in enumerate(rig.cameras.values()):
        inverse, places = np.linalg.inv(camera.pose), np.stack((ahead, left, 0 * left), -1)
        # OpenCV is wrong behind a camera.
        mine = (sources == k) & ((places @ inverse[2, :3] + inverse[2, 3]) > 0.01)
        places = places[mine, None]
        turn = cv2.Rodrigues(inverse[:3, :3])[0]
        points = cv2.fisheye.projectPoints(
            places, turn, inverse[:3, 3], matrix, np.array(COEFFICIENTS)
        )
        np.testing.assert_allclose(onto[mine], points[0][:, 0], atol=1e-6)
        np.testing.assert_allclose(remap.to_view(onto[mine], k), pixels[mine], atol=1e-6)


@st.composite
def rigs(draw):
    turns = Rotation.random(draw(st.integers(1, 4)), random_state=draw(st.integers(0, 999)))
    spread = draw(st.sampled_from([0.0, 0.02]))
    numbers = np.random.default_rng(draw(st.integers(0, 999)))
    cameras = {
        f"c{k}": (fisheye((8 + 7 * k, 20), 7.0), None,
                  np.block([[turn, spread * numbers.normal(size=(3, 1))], [np.eye(4)[3]]]))
        for k, turn in enumerate(turns.as_matrix())
    }  # fmt: skip
    return Rig(cameras, up=numbers.normal(size=3), forward=numbers.normal(size=3))


@given(
    rig=rigs(),
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    seam=st.sampled_from(["hard", "narrow", "wide"]),
    name=st.sampled_from(["equirectangular", "perspective", "camera", "stereographic"]),
    distance=st.sampled_from([None, 3.0]),
    kind=st.sampled_from([np.uint8, np.uint16, np.float32, np.float64]),
    channels=st.sampled_from([(), (1,), (2,), (3,)]),
)
def test_any_rig_in_any_view(rig, size, seam, name, distance, kind, channels):
    view = CameraView(fisheye(size, 3.0)) if name == "camera" else make_view(name, size)
    remap = view.at(rig, seam=seam, distance=distance)
    numbers = np.random.default_rng(0)
    frames = {n: numbers.integers(0, 256, (*c.size, *channels)).astype(kind)
              for n, c in rig.cameras.items()}  # fmt: skip
    with warnings.catch_warnings(action="ignore"):
        try:
            picture = remap(frames)
        except ValueError as error:
            assert "sees anything" in str(error)
            return
    assert picture.shape == (*size, *channels) and picture.dtype == kind
    assert (picture[~remap.shown] == 0).all()
    # The mean of the four neighbours of each read, computed one by one.
    sums = np.zeros((math.prod(size), *channels))
    for pixel, source, (x, y), weight in zip(*remap.reads, strict=True):
        frame = list(frames.values())[source].astype(np.float64)
        x, y = np.clip(x, 0, frame.shape[1] - 1), np.clip(y, 0, frame.shape[0] - 1)
        for column in (math.floor(x), math.ceil(x)):
            for row in (math.floor(y), math.ceil(y)):
                across = 1 - abs(x - column) if x % 1 else 0.5
                down = 1 - abs(y - row) if y % 1 else 0.5
                sums[pixel] += weight * across * down * frame[row, column]
    tolerance = 1.0 if np.dtype(kind).kind == "u" else 2e-3
    np.testing.assert_allclose(picture, sums.reshape(picture.shape), atol=tolerance)
    y, x = np.nonzero(remap.shown)
    sources, onto = remap.to_image(np.stack((x, y), -1))
    for k, n in enumerate(rig.names):
        back = remap.to_view(onto[sources == k], n)
        np.testing.assert_allclose(back, np.stack((x, y), -1)[sources == k], atol=1e-5)
    ids = {n: numbers.integers(0, 5, c.size).astype(np.uint8) for n, c in rig.cameras.items()}
    assert {*np.unique(remap.target(ids))} <= {0, 1, 2, 3, 4, 255}


def test_things_at_a_distance_meet_in_one_place():
    """Two lenses 6 cm apart, and a sphere of 2 m around their middle."""
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    back[2, 3] = -0.06
    rig = Rig({"one": (fisheye(), None, np.eye(4)), "two": (fisheye(), None, back)}, up=(0, -1, 0))

    def on_sphere(camera):
        rays, out = rays_of(camera), camera.pose[:3, 3] - rig.middle
        along = rays @ out
        far = np.sqrt(along**2 - out @ out + 4) - along
        return out + far[..., None] * rays

    frames = {name: np.nan_to_num(colour(on_sphere(c))) for name, c in rig.cameras.items()}
    view = make_view("equirectangular", (60, 120))
    near = view.at(rig, seam="wide", distance=2.0)
    truth = colour(2 * places_of(near))
    errors = [np.abs(m(frames) - truth)[m.shown].mean() for m in (near, view.at(rig, seam="wide"))]
    assert errors[0] < 0.5 < errors[1]


def test_gains_and_disagreement():
    rig = car()
    frames = pictures(rig, on_ground)
    remap = GroundView((60, 60), 9.0, (1.4, 0)).at(rig, seam="wide", gain=True)
    darker = frames | {"left": frames["left"] * np.float32(0.9)}
    gains = remap.gains(darker)
    np.testing.assert_allclose(gains[3] / gains[:3], 1 / 0.9, rtol=5e-3)
    assert math.prod(gains) == pytest.approx(1)
    dark, bright = remap(darker)[remap.shown], remap(frames)[remap.shown]
    np.testing.assert_allclose(dark / bright, 0.9**0.25, rtol=0.02)
    tensors = [torch.from_numpy(f)[None, None] for f in darker.values()]
    np.testing.assert_allclose(remap(tensors)[0, 0], remap(darker), atol=1e-3)
    right = remap.disagreement(frames)[0]
    assert remap.disagreement(darker)[0] == pytest.approx(right, rel=0.05)
    for wrong in (pose(92, 40, (1.9, 0.95, 1.0)), pose(90, 40, (1.9, 0.95, 1.05))):
        means, picture = (
            GroundView((60, 60), 9.0, (1.4, 0)).at(car(left=wrong)).disagreement(frames)
        )
        assert means["front", "left"] > 2 * right["front", "left"] and picture.shape == (60, 60)


def test_tensors_carry_gradients_and_agree_with_arrays():
    rig = Rig.cube(16)
    remap = make_view("equirectangular", (10, 20)).at(rig, seam="narrow")
    frames = pictures(rig)
    tensors = [torch.from_numpy(f)[None, None].requires_grad_() for f in frames.values()]
    seen = remap(tensors)
    np.testing.assert_allclose(seen[0, 0].detach(), remap(frames), atol=1e-3)
    seen.sum().backward()
    assert sum(t.grad.sum().item() for t in tensors) == pytest.approx(200, rel=1e-4)
    assert torch.autograd.gradcheck(
        lambda a: remap([a, *(t.detach().double() for t in tensors[1:])]), tensors[0].double()
    )


def test_boxes_move_both_ways():
    rig = car()
    remap = GroundView((200, 200), 12.0, (1.4, 0)).at(rig)
    front = remap.source("front")
    boxes = Instances(np.array([[90.0, 20, 110, 40]])).through(front.to_image, (120, 160))
    assert boxes.more["visible"][0] == 1
    back = boxes.through(front.to_view, (200, 200)).boxes
    np.testing.assert_allclose(back, [[90, 20, 110, 40]], atol=12)


def test_a_bowl_is_level_and_then_rises():
    remap = GroundView((50, 50), 30.0, rise=0.1, flat=5.0).at(car())
    at = places_of(remap)
    radius = np.hypot(at[..., 0], at[..., 1])
    np.testing.assert_allclose(at[..., 2], 0.1 * np.clip(radius - 5, 0, None) ** 2, atol=1e-9)
    pixels = np.array([[25.0, 2.0], [3, 30], [24, 20]])
    sources, onto = remap.to_image(pixels)
    for source, pixel, place in zip(sources.tolist(), pixels, onto, strict=True):
        np.testing.assert_allclose(remap.to_view(place, source), pixel, atol=1e-6)


CAR, CUBE = car(), Rig.cube(8)
VIEW = make_view("equirectangular", (4, 8))
FACES = [np.zeros((8, 8), np.uint8)] * 6
WRONG = {
    "seam": (lambda: VIEW.at(CUBE, seam="soft"), "`seam` must be one of hard, narrow, wide"),
    "distance": (lambda: VIEW.at(CAR, distance=1.0), "`distance` must be above"),
    "distance of ground": (lambda: GroundView((4, 4), 5.0).at(CAR, distance=9.0), "left out"),
    "size": (lambda: VIEW.at(CUBE, (8, 8)), "a rig knows the sizes"),
    "on the ground": (lambda: GroundView((4, 4), 5.0).at(CUBE), "camera front is 0 m above"),
    "span": (lambda: GroundView((4, 4), 0.0), "`span` must be above 0 m"),
    "center": (lambda: GroundView((4, 4), 5.0, (1.0,)), "`center` must be two finite numbers"),
    "rise": (lambda: GroundView((4, 4), 5.0, rise=-1.0), "`rise` must be at least 0"),
    "ground of a lens": (lambda: GroundView((4, 4), 5.0).at(fisheye(), (120, 160))(
        np.zeros((120, 160))), "GroundView shows a rig"),
    "polar": (lambda: PolarView(4, 8, (1, 1)).at(CUBE), "has no attribute|follows one lens"),
    "square": (lambda: make_view("square", (8, 8)).at(CUBE), "follows one lens"),
    "nothing seen": (lambda: make_view("perspective", (4, 4), fov=0.5, direction=(0, 0, -1)).at(
        Rig.single(fisheye()))(FACES[:1]), "sees anything of the view|frame of camera"),
    "too few": (lambda: VIEW.at(CUBE)(FACES[:5]), "there must be 6 frames"),
    "missing": (lambda: VIEW.at(CUBE)(dict(zip(CUBE.names[1:], FACES, strict=False))),
                "the frame of front is missing"),
    "unknown": (lambda: VIEW.at(CUBE)(dict(zip(CUBE.names, FACES, strict=True)) | {"top": 0}),
                "no camera 'top', only front"),
    "another size": (lambda: VIEW.at(CUBE)([*FACES[:5], np.zeros((8, 9), np.uint8)]),
                     "the frame of down must be"),
    "ids": (lambda: VIEW.at(CUBE)([f.astype(int) for f in FACES]), "remap.target moves ids"),
    "mixed": (lambda: VIEW.at(CUBE)([*FACES[:5], FACES[5].astype(float)]), "one type"),
    "text": (lambda: VIEW.at(CUBE)([*FACES[:5], "down.png"]), "the frame of down must be an array"),
    "maps": (lambda: VIEW.at(CUBE).target([f[..., None] for f in FACES]), "must be \\(H, W\\)"),
    "depth of a car": (lambda: VIEW.at(CAR).depth([]), "all cameras are at its place"),
    "kind of depth": (lambda: VIEW.at(CUBE).depth(FACES, to="y"), "`to` must be distance or z"),
    "source": (lambda: VIEW.at(CUBE).source("top"), "no camera 'top'"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_named(name):
    call, message = WRONG[name]
    with pytest.raises((ValueError, TypeError, KeyError, AttributeError), match=message):
        call()


def test_a_camera_that_sees_nothing_of_the_view_is_named():
    view = make_view("perspective", (8, 8), fov=0.5)
    with pytest.warns(UserWarning, match="shows nothing of back"):
        view.at(car())(pictures(car()))
