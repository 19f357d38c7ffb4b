"""A ray stays on the same content, however a sample is cut, resized, turned, mirrored or warped."""

import functools
import math

import numpy as np
import pytest
import torch
from helpers import refused, slow_but
from hypothesis import given
from hypothesis import strategies as st
from scenes import CALIBRATIONS, distance_of, labels_of, rays_of
from scipy import ndimage

from darswin.data import IGNORE, RandomTurns, Sample
from darswin.data.framing import Crop, taken_part
from darswin.lens import (
    BrownConrady,
    Equidistant,
    KannalaBrandt,
    Mei,
    OCam,
    Perspective,
    Polynomial,
    Spherical,
    load,
)
from darswin.lens.orientation import upright
from darswin.lens.pixels import OUTSIDE, pixel_angles
from darswin.views import CameraView, CropView, Turn
from darswin.views.turn import STILL

SIZE = (300, 400)
LENSES = {
    "woodscape": load(CALIBRATIONS / "woodscape.json").in_picture((302, 400)).cropped(1, 0, *SIZE),
    "kitti360": load(CALIBRATIONS / "kitti360_02.yaml").in_picture((400, 400)),  # tangential terms
    "circle": Equidistant.from_fov(3.0, 150.0, center=[190.0, 155.0], image_size=SIZE),
    "oblong": Spherical(
        0.8, 150.0, 1.5, [205.0, 140.0], affine=[[1.0, 0.03], [0.0, 0.9]], image_size=SIZE
    ),
    "pinhole": BrownConrady(170.0, [0.02], 0.9, [200.0, 150.0], tangential=[0.01, -0.02],
                            image_size=SIZE),
    "omnidirectional": OCam([-120.0, 0.0, 0.002], 1.4, [199.5, 149.5], image_size=SIZE),
}  # fmt: skip
TURNS = [Turn(0.0, True), Turn(0.7, False), Turn(-2.5, True)]
TARGETS = [
    Spherical.from_fov(0.3, 2.6, 60.0, center=[63.5, 63.5], image_size=(128, 128)),
    Spherical.from_fov(1.0, 3.2, 90.0, center=[40.0, 80.0], image_size=(128, 128)),
    Polynomial([30.0, 5.0, 3.0], 1.4, [63.5, 63.5], image_size=(128, 128)),
]


def size_of(lens):
    return tuple(round(side) for side in lens.image_size[0].tolist())


@functools.cache
def scene_of(name, target="labels"):
    """Labels or distances of the ray, and an image in which a label is a grey."""
    lens = LENSES[name]
    theta, azimuth = rays_of(lens, size_of(lens))
    known, labels = ~np.isnan(theta), labels_of(theta, azimuth)
    image = np.where(known, 60 + 80 * labels, 0).astype(np.uint8)[..., None]
    if target == "labels":
        return Sample(image, np.where(known, labels, IGNORE).astype(np.uint8), lens)
    return Sample(image, np.where(known, distance_of(theta, azimuth), 0).astype(np.float32), lens)


def cropped(source, taken, size, turn=STILL):
    return source.through(CropView(taken, (size, size), turn))


def warped(source, lens, turn=STILL):
    return source.through(CameraView(lens, turn=turn))


def before(lens, turn):
    """The rays of an image's pixels, as they were before a turn; θ is NaN where none is seen."""
    theta, azimuth = rays_of(lens, size_of(lens))
    x, y = np.linalg.inv(turn.matrix) @ [np.cos(azimuth).ravel(), np.sin(azimuth).ravel()]
    return theta, np.arctan2(y, x).reshape(azimuth.shape)


def shown(source, theta, azimuth, margin):
    """True for rays in a source's image and θ_max by a margin, px, which may be below 0."""
    known = ~np.isnan(theta)
    theta = torch.from_numpy(np.where(known, theta, 0.0)).flatten()
    lens = source.to(torch.float64).with_theta_max(None)
    far = theta <= source.theta_max.item() - margin / 40
    theta = theta.clamp(max=lens.theta_max.item())
    pixels = lens.project_rays(theta[None], torch.from_numpy(azimuth).flatten()[None])[0]
    height, width = size_of(source)
    inside = (pixels >= margin - 0.5).all(-1)
    inside &= (pixels <= torch.tensor([width, height]) - 0.5 - margin).all(-1)
    return known & (inside & far).numpy().reshape(known.shape)


def even(labels):
    """Where labels are the same in a neighbourhood, which is in the image."""
    same = ndimage.maximum_filter(labels, 5) == ndimage.minimum_filter(labels, 5)
    return same & np.pad(np.ones(np.subtract(labels.shape, 4), bool), 2)


def check(scenes, sources, turn=STILL):
    """Image, labels, distances and lens agree about every ray that the source showed."""
    theta, azimuth = before(scenes[0].lens, turn)
    certain = shown(sources[0].lens, theta, azimuth, 2.0)
    possible = shown(sources[0].lens, theta, azimuth, -2.0)
    labels = labels_of(theta, azimuth)
    inner = certain & even(np.where(certain, labels, IGNORE))
    assert certain.sum() > 1000 and inner.sum() > 500
    for scene, source, nothing in zip(scenes, sources, (IGNORE, 0), strict=True):
        assert (scene.target[~possible] == nothing).all()
        assert (scene.target[certain] != nothing).all()
        made_up = ~np.isin(scene.target, source.target) & (scene.target != nothing)
        assert not made_up.any()
        np.testing.assert_allclose(scene.image[inner, 0], 60.0 + 80 * labels[inner], atol=1)
    assert (scenes[0].target[inner] == labels[inner]).all()
    # The nearest pixel of the source is up to 0.71 px away, and 8 m/rad the steepest slope.
    per_pixel = 1 / sources[0].lens._slope(torch.linspace(0, 0.85, 9)[None]).min().item()
    error = np.abs(scenes[1].target - distance_of(theta, azimuth))[certain]
    assert error.max() < 8 * per_pixel


@pytest.mark.parametrize("name", slow_but(LENSES, "kitti360", "oblong"))
def test_a_ray_keeps_its_content(name):
    sources = scene_of(name), scene_of(name, "distance")
    for framing, crop, turn in (
        ("crop", None, TURNS[0]),
        ("stretch", Crop(0.6, 0.2, 0.9), TURNS[1]),
        ("crop", Crop(0.8, 1, 0), TURNS[2]),
    ):
        taken = taken_part(sources[0].target.shape, framing, crop)
        for move in (Turn(0.0, turn.mirrored), turn):
            check([cropped(source, taken, 128, move) for source in sources], sources, move)
    for lens, turn in zip(TARGETS, (STILL, *TURNS[1:]), strict=True):
        scenes = [warped(source, lens, turn) for source in sources]
        assert scenes[0].lens is lens
        check(scenes, sources, turn)


@given(
    turn=st.builds(Turn, st.floats(-math.pi, math.pi), st.booleans()),
    crop=st.builds(Crop, st.floats(0.3, 1), st.floats(0, 1), st.floats(0, 1)),
    size=st.integers(16, 90),
    name=st.sampled_from(sorted(LENSES)),
)
def test_image_and_labels_move_together(turn, crop, size, name):
    source = scene_of(name)
    taken = taken_part(source.target.shape, "crop", crop)
    top, left, height, width = taken
    assert top >= 0 and left >= 0 and height == width
    assert top + height <= source.target.shape[0] and left + width <= source.target.shape[1]
    center = [size * crop.across, size * crop.down]
    drawn = Spherical.from_fov(crop.share, 2.4, size * crop.share, center=center)
    drawn = drawn.replace(image_size=torch.tensor([[float(size)] * 2]))
    for scene in (
        cropped(source, taken, size, turn),
        cropped(source, taken, size, Turn(0.0, turn.mirrored)),
        warped(source, drawn, turn),
    ):
        assert scene.target.shape == (size, size) and size_of(scene.lens) == (size, size)
        inner = even(scene.target) & (scene.target != IGNORE)
        np.testing.assert_allclose(scene.image[inner, 0], 60.0 + 80 * scene.target[inner], atol=1)
        theta = pixel_angles(scene.lens, (size, size))[0].numpy()
        beyond = np.isnan(theta)
        assert (scene.target[beyond] != IGNORE).sum() <= 0.02 * beyond.size


def test_what_is_much_larger_is_averaged():
    parts = [CropView((0, 0, part, part), (20, 20)) for part in (10, 20, 30, 40, 90, 100, 400)]
    assert [view.supersampling_of(None, (400, 400)) for view in parts] == [1, 1, 1, 3, 3, 5, 5]
    lens = Equidistant.from_fov(3.0, 400.0, image_size=(800, 800), center=[399.5, 399.5])
    noise = np.random.default_rng(0).integers(256, size=(800, 800, 1), dtype=np.uint8)
    source = Sample(noise, np.zeros((800, 800), np.uint8), lens)
    small = Equidistant.from_fov(3.0, 40.0, image_size=(80, 80), center=[39.5, 39.5])
    middle = (slice(20, 60), slice(20, 60))
    taken = (0, 0, 800, 800)
    for scene in (warped(source, small), cropped(source, taken, 80, Turn(0.5))):
        # Of 10 × 10 pixels that are read at 5 × 5 points: a sixth of the noise at most.
        assert scene.image[middle].std() < noise.std() / 6
    assert cropped(source, taken, 80).image[middle].std() < noise.std() / 9


@pytest.mark.parametrize("name", LENSES)
def test_the_pixels_beyond_the_view_are_those_of_the_lens(name):
    """A lens with tangential terms sees no circle, and in oblong pixels no lens does."""
    source = scene_of(name)
    for turn in (STILL, TURNS[1]):
        everything = Sample(source.image, source.target * 0, source.lens)
        scene = cropped(everything, (10, 30, 200, 260), 97, turn)
        beyond = np.isnan(pixel_angles(scene.lens, (97, 97))[0].numpy())
        assert (scene.target[beyond] == IGNORE).all()
        if turn is STILL:
            assert np.array_equal(scene.target != IGNORE, ~beyond)
            assert beyond.any() or name == "pinhole"


SHEAR = [[1.0, 0.1], [0.0, 0.8]]
OBLIQUE = KannalaBrandt(40.0, [0.01], 1.3, [70, 60], affine=SHEAR, image_size=(120, 140))
TERMS = dict(tangential=[0.02, -0.03], image_size=(120, 160))


def remaps(lens):
    """All kinds of maps of a lens's pictures."""
    for turn in (STILL, *TURNS):
        yield CropView((20, 10, 150, 210), (60, 90), turn).at(lens, size_of(lens))
        for other in (*TARGETS, OBLIQUE, BrownConrady(60.0, [0.01], 0.8, [75, 64], **TERMS)):
            yield CameraView(other, turn=turn).at(lens, size_of(lens))


@pytest.mark.parametrize("name", slow_but(LENSES, "kitti360", "oblong"))
def test_points_of_both_pictures_belong_together(name):
    lens = LENSES[name]
    azimuth = torch.linspace(-3, 3, 7, dtype=torch.float64)[None]
    for remap in remaps(lens):
        turn, exact = remap.view.turn, (lens.to(torch.float64), remap.camera.to(torch.float64))
        rays = torch.stack((azimuth.cos(), azimuth.sin()), -1)
        pairs = [*zip(exact, (rays, rays @ torch.from_numpy(turn.matrix.T)), strict=True)]
        for theta in (0.0, 0.2, 0.6):
            thetas = torch.full_like(azimuth, theta)
            old, new = (one.pixels(thetas, ray)[0].numpy() for one, ray in pairs)
            np.testing.assert_allclose(remap.to_view(old), new, atol=2e-4)
            found = remap.to_image(new)
            inside = ((old > -0.49) & (old < np.array(size_of(lens))[::-1] - 0.51)).all(-1)
            np.testing.assert_allclose(found[inside], old[inside], atol=2e-3)
        if isinstance(remap.view, CameraView):
            beyond = np.array([[1e4, 1e4], old[0]])
            assert np.isnan(remap.to_view(beyond)).all(-1).tolist() == [True, False]
            assert np.isnan(remap.to_image(beyond[:1])).all()


@pytest.mark.parametrize("name", [*LENSES, "wide pinhole"])
def test_pixels_are_read_at_their_points(name):
    """The tables of a lens's curve are exact to a hundredth of a pixel, to the rim."""
    wide = Perspective(500.0, math.radians(80), [640.0, 480.0], image_size=(960, 1280))
    for remap in remaps(LENSES.get(name, wide)):
        view, lens = remap.view, remap.lens
        if isinstance(view, CameraView) and not view.lens.is_radial:
            continue  # it has no table
        y, x = (np.linspace(-1, side, 50) for side in view.size)
        points = view._points(lens, remap.size, y, x)
        grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))[None]
        exact = view.to_image(grid, lens, remap.size)[0].numpy()
        seen = ~np.isnan(exact)
        assert seen.any() and np.abs(points - exact)[seen].max() < 0.013
        away = points[~seen.all(-1)]
        assert ((away < -1) | (away > remap.size[::-1])).any(-1).all()


def test_only_what_must_turn_with_a_picture_does():
    image = np.random.default_rng(0).integers(256, size=(*SIZE, 3), dtype=np.uint8)
    for view in (CropView((0, 0, 90, 80), (9, 8)), CameraView(TARGETS[0])):
        shown = Sample(image, 7, LENSES["circle"]).through(view)
        assert shown.target == 7 and shown.image.shape == (*size_of(shown.lens), 3)

    def whole_turned(lens, turn):
        return Sample(image, None, lens).through(CropView((0, 0, *SIZE), SIZE, turn))

    for name, changes in (("oblong", False), ("pinhole", True)):  # which has tangential terms
        assert (str(whole_turned(LENSES[name], Turn(0.7)).lens) != str(LENSES[name])) == changes
    mirrored = whole_turned(LENSES["oblong"], Turn(mirrored=True))
    assert (mirrored.image == image[:, ::-1]).all()
    assert str(mirrored.lens) == str(upright(LENSES["oblong"], 2))


def test_how_turns_are_drawn():
    rng = np.random.default_rng(0)
    turns = [RandomTurns(True, 30).draw(rng) for _ in range(2000)]
    angles = np.degrees([turn.angle for turn in turns])
    assert np.abs(angles).max() <= 30 and np.abs(angles.std() - 30 / math.sqrt(3)) < 0.5
    assert abs(angles.mean()) < 2 and 0.45 < np.mean([turn.mirrored for turn in turns]) < 0.55
    assert RandomTurns(False, 0).draw(rng) == (0.0, False)
    for angle in (-1, 181, math.nan):
        refused(r"`rotate_deg` must be in \[0, 180\]", RandomTurns, rotate_deg=angle)


def ramp(size, axis=0, dtype=np.float32):
    """A scene whose image is x + 1 and y + 1, and whose target is one of them."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32) + 1
    lens = Equidistant(max(size), 2.5, (size[1] / 2 - 0.5, size[0] / 2 - 0.5), image_size=size)
    return Sample(np.stack((x, y), -1), (x, y)[axis].astype(dtype), lens)


def smaller(source, taken, size):
    """A lens of the same model, through which the picture becomes `size` px wide."""
    focal = source.lens.focal.item() * size / taken[3]
    lens = Equidistant(focal, 0.8, (size / 2 - 0.5, size / 2 - 0.5), image_size=(size, size))
    return warped(source, lens)


SIZES = [
    ((240, 320), 120), ((512, 512), 256), ((512, 512), 128), ((90, 120), 45), ((300, 300), 100),
    ((320, 320), 120), ((768, 1024), 128), ((100, 133), 128), ((64, 64), 96), ((50, 40), 150),
    ((60, 250), 120), ((90, 640), 128), ((480, 80), 160), ((128, 128), 128),
]  # fmt: skip
FRAMES = {
    "resized": cropped,
    "mirrored": lambda *scene: cropped(*scene, Turn(mirrored=True)),
    "upside down": lambda *scene: cropped(*scene, Turn(math.pi)),
    "turned": lambda *scene: cropped(*scene, Turn(0.3, True)),
    "smaller": smaller,
}


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(("whole", "size"), SIZES)
def test_targets_are_not_shifted(whole, size, frame):
    # Another lens shows a picture that is not stretched.
    for framing in ("crop",) if frame == "smaller" else ("crop", "stretch"):
        taken = taken_part(whole, framing)
        for axis, dtype in ((0, np.float32), (1, np.float32), (0, np.uint8), (1, np.uint8)):
            if dtype == np.uint8 and max(whole) >= IGNORE:
                continue
            scene = FRAMES[frame](ramp(whole, axis, dtype), taken, size)
            pixel = taken[3 - axis] / size  # of the result, in px of the picture
            known = (scene.target != IGNORE) if dtype == np.uint8 else (scene.target > 0)
            margin = 2 + 2 * math.ceil(size / min(whole))
            known = ndimage.binary_erosion(known, iterations=margin)
            off = (scene.target - scene.image[..., axis]) / pixel
            assert known.sum() > 100 and np.abs(off[known]).max() < 0.5 + 0.8 / pixel
            # A column in the middle may have no pixel that is nearest and none that mirrors it.
            limit = 0.5 / pixel / (size - 2 * margin) * (size % 2) + 2e-3
            assert abs(off[known].mean()) < limit
    if frame == "mirrored":
        plain = cropped(ramp(whole), (0, 0, *whole), size).target
        same = plain[:, ::-1] == FRAMES[frame](ramp(whole), (0, 0, *whole), size).target
        same[:, size // 2] |= size % 2 == 1  # which may be between two pixels, and mirrors itself
        assert same.all()


def test_another_camera_is_read_bilinear_between_pixel_centres():
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    lens = Perspective(10.0, 1.2)
    torch.testing.assert_close(CameraView(lens, (3, 4))(image, lens), image, rtol=0, atol=1e-5)
    moved = Perspective(10.0, 1.2, center=[1.0, 0.75])  # half a pixel and a quarter
    got = CameraView(moved, (3, 4))(image, lens)
    torch.testing.assert_close(got[..., :2, :3], image[..., :2, :3] + 0.5 + 0.25 * 4)
    torch.testing.assert_close(got[0, 0, 0, 3], torch.tensor((3 + 0.25 * 4) / 2))  # half is outside


def test_other_cameras_of_many():
    images = torch.rand(2, 3, 20, 24)
    source = Spherical.from_fov([0.2, 0.9], 2.0, 10.0)
    for target in (Perspective.from_fov(1.8, 8.0), Spherical.from_fov([0.9, 0.3], 1.8, 8.0)):
        view = CameraView(target, (16, 18), supersampling=1)
        together = view(images, source)
        assert together.shape == (2, 3, 16, 18)
        for k, other in enumerate(target[[0, 0]] if len(target) == 1 else target):
            view = CameraView(other, (16, 18), supersampling=1)
            torch.testing.assert_close(together[k : k + 1], view(images[k : k + 1], source[k]))
            beyond = pixel_angles(other, (16, 18)).isnan()
            assert beyond.any() and not together[k][:, beyond[0]].any()
        half = CameraView(target, (16, 18), supersampling=1)(images.bfloat16(), source)
        assert half.dtype == torch.bfloat16
        torch.testing.assert_close(half.float(), together, rtol=0, atol=0.01)
    assert view(images[:0], source[:0]).shape == (0, 3, 16, 18)


@pytest.mark.parametrize("radial", [True, False])
def test_gradients_reach_both_lenses_also_at_the_centre_and_where_nothing_is_seen(radial):
    def places(focal, xi, tangential, affine, center):
        if radial:
            view = CameraView(Spherical(xi, focal, 1.2), (9, 9), supersampling=1)
            return view.image_points(Perspective(focal, 1.2), (4, 4))
        source = Mei(xi, focal, (0.05, 0.2), 1.2, center, affine=affine, tangential=tangential)
        target = Mei(1.0, focal, None, 1.3, affine=affine, tangential=tangential)
        return CameraView(target, (9, 9), supersampling=1).image_points(source, (40, 40))

    parameters = [[2.9], [1.5], [0.01, -0.02], [[1.0, 0.1], [0.0, 0.9]], [19.0, 20.5]]
    tensors = [torch.tensor(p, dtype=torch.float64, requires_grad=True) for p in parameters]
    there = places(*tensors)
    assert (there == OUTSIDE).any() and (there[0, 4, 4] != OUTSIDE).all()
    assert torch.autograd.gradcheck(places, tensors, fast_mode=True)


@pytest.mark.parametrize("turn", TURNS)
def test_rays_of_another_camera_come_back_to_its_points(turn):
    view = CameraView(TARGETS[0], turn=turn)
    points = 20 + 88 * torch.rand(50, 2)
    rays = view.to_rays(points, LENSES["circle"], SIZE)
    assert not rays.isnan().any()
    back = view.to_points(rays, LENSES["circle"], SIZE)
    torch.testing.assert_close(back, points, rtol=0, atol=1e-3)
