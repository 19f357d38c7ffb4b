"""Scenes in which a label and a distance are functions of the ray keep them in every frame."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import CALIBRATIONS, distance_of, labels_of, rays_of
from scipy import ndimage

from darswin.data import IGNORE, Scene
from darswin.data.reframing import _points, resize_scene, turn_scene, warp_scene
from darswin.data.warping import Crop, Turn, taken_part
from darswin.lens import BrownConrady, Equidistant, OCam, Polynomial, Spherical, load
from darswin.lens.pixels import pixel_angles, reprojection

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


def scene_of(lens, target="labels"):
    """Labels or distances of the ray, and an image in which a label is a grey."""
    theta, azimuth = rays_of(lens, size_of(lens))
    known = ~np.isnan(theta)
    labels = labels_of(theta, azimuth)
    image = np.where(known, 60 + 80 * labels, 0).astype(np.uint8)[..., None]
    if target == "labels":
        return Scene(image, np.where(known, labels, IGNORE).astype(np.uint8), lens)
    return Scene(image, np.where(known, distance_of(theta, azimuth), 0).astype(np.float32), lens)


def before(lens, turn=None):
    """The rays of an image's pixels, as they were before a turn; θ is NaN where none is seen."""
    theta, azimuth = rays_of(lens, size_of(lens))
    if turn is not None:
        x, y = np.linalg.inv(turn.matrix) @ [np.cos(azimuth).ravel(), np.sin(azimuth).ravel()]
        azimuth = np.arctan2(y, x).reshape(azimuth.shape)
    return theta, azimuth


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


def check(scenes, sources, turn=None):
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


SCENES = {name: scene_of(lens) for name, lens in LENSES.items()}


@pytest.mark.parametrize("name", LENSES)
def test_a_ray_keeps_its_content(name):
    sources = SCENES[name], scene_of(LENSES[name], "distance")
    for framing, crop, turn in (
        ("crop", None, TURNS[0]),
        ("stretch", Crop(0.6, 0.2, 0.9), TURNS[1]),
        ("crop", Crop(0.8, 1, 0), TURNS[2]),
    ):
        taken = taken_part(sources[0].target.shape, framing, crop)
        resized = [resize_scene(source, taken, 128, turn.mirrored) for source in sources]
        check(resized, sources, Turn(0.0, turn.mirrored))
        check([turn_scene(source, turn, taken, 128) for source in sources], sources, turn)
    for lens, turn in zip(TARGETS, (None, *TURNS[1:]), strict=True):
        scenes = [warp_scene(source, lens, 128, turn) for source in sources]
        assert scenes[0].lens is lens
        check(scenes, sources, turn)


@given(
    turn=st.builds(Turn, st.floats(-math.pi, math.pi), st.booleans()),
    crop=st.builds(Crop, st.floats(0.3, 1), st.floats(0, 1), st.floats(0, 1)),
    size=st.integers(16, 90),
    name=st.sampled_from(sorted(LENSES)),
)
def test_image_and_labels_move_together(turn, crop, size, name):
    source = SCENES[name]
    taken = taken_part(source.target.shape, "crop", crop)
    top, left, height, width = taken
    assert top >= 0 and left >= 0 and height == width
    assert top + height <= source.target.shape[0] and left + width <= source.target.shape[1]
    center = [size * crop.across, size * crop.down]
    drawn = Spherical.from_fov(crop.share, 2.4, size * crop.share, center=center)
    drawn = drawn.replace(image_size=torch.tensor([[float(size)] * 2]))
    for scene in (
        turn_scene(source, turn, taken, size),
        resize_scene(source, taken, size, turn.mirrored),
        warp_scene(source, drawn, size, turn),
    ):
        assert scene.target.shape == (size, size) and size_of(scene.lens) == (size, size)
        inner = even(scene.target) & (scene.target != IGNORE)
        np.testing.assert_allclose(scene.image[inner, 0], 60.0 + 80 * scene.target[inner], atol=1)
        theta = pixel_angles(scene.lens, (size, size))[0].numpy()
        beyond = np.isnan(theta)
        assert (scene.target[beyond] != IGNORE).sum() <= 0.02 * beyond.size


@pytest.mark.parametrize("name", ["woodscape", "oblong", "pinhole"])
def test_the_places_are_those_of_the_exact_reprojection(name):
    height, width = SIZE
    y, x = np.mgrid[:height, :width].astype(np.float32)
    source = Scene(np.stack((x, y), -1), np.zeros(SIZE, np.float32), LENSES[name])
    for lens in TARGETS:
        pair = (source.lens.to(torch.float64), SIZE, lens.to(torch.float64), (128, 128))
        exact = reprojection(*pair)[0]
        got = torch.from_numpy(warp_scene(source, lens, 128).image)
        inside = ((exact > 2) & (exact < exact.new_tensor([width - 3, height - 3]))).all(-1)
        inside = torch.from_numpy(ndimage.binary_erosion(inside.numpy(), iterations=2))
        # A mean over the pixel, and OpenCV's 1/32 px.
        error = (got - exact)[inside].abs()
        assert error.mean() < 0.03 and error.quantile(0.99) < 0.3


def test_what_is_much_larger_is_averaged():
    assert [_points(scale) for scale in (0.5, 1, 1.5, 2, 4.5, 5, 20)] == [1, 1, 1, 3, 3, 5, 5]
    lens = Equidistant.from_fov(3.0, 400.0, image_size=(800, 800), center=[399.5, 399.5])
    noise = np.random.default_rng(0).integers(256, size=(800, 800, 1), dtype=np.uint8)
    source = Scene(noise, np.zeros((800, 800), np.uint8), lens)
    small = Equidistant.from_fov(3.0, 40.0, image_size=(80, 80), center=[39.5, 39.5])
    middle = (slice(20, 60), slice(20, 60))
    taken = (0, 0, 800, 800)
    for scene in (warp_scene(source, small, 80), turn_scene(source, Turn(0.5, False), taken, 80)):
        # Of 10 × 10 pixels that are read at 5 × 5 points: a sixth of the noise at most.
        assert scene.image[middle].std() < noise.std() / 6
    assert resize_scene(source, taken, 80, False).image[middle].std() < noise.std() / 9


# -- targets are not shifted ------------------------------------------------------------------


def ramp(size, axis=0, dtype=np.float32):
    """A scene whose image is x + 1 and y + 1, and whose target is one of them."""
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float32) + 1
    lens = Equidistant(max(size), 2.5, (size[1] / 2 - 0.5, size[0] / 2 - 0.5), image_size=size)
    return Scene(np.stack((x, y), -1), (x, y)[axis].astype(dtype), lens)


def smaller(source, taken, size):
    """A lens of the same model, through which the picture becomes `size` px wide."""
    focal = source.lens.focal.item() * size / taken[3]
    lens = Equidistant(focal, 0.8, (size / 2 - 0.5, size / 2 - 0.5), image_size=(size, size))
    return warp_scene(source, lens, size)


SIZES = [
    ((240, 320), 120), ((512, 512), 256), ((512, 512), 128), ((90, 120), 45), ((300, 300), 100),
    ((320, 320), 120), ((768, 1024), 128), ((100, 133), 128), ((64, 64), 96), ((50, 40), 150),
    ((60, 250), 120), ((90, 640), 128), ((480, 80), 160), ((128, 128), 128),
]  # fmt: skip
FRAMES = {
    "resized": lambda *scene: resize_scene(*scene, mirrored=False),
    "mirrored": lambda *scene: resize_scene(*scene, mirrored=True),
    "upside down": lambda source, *taken: turn_scene(source, Turn(math.pi, False), *taken),
    "turned": lambda source, *taken: turn_scene(source, Turn(0.3, True), *taken),
    "smaller": smaller,
}


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize(("whole", "size"), SIZES)
def test_targets_are_not_shifted(whole, size, frame):
    for framing in ("crop", "stretch"):
        if (frame, framing) == ("smaller", "stretch"):
            continue  # another lens shows a picture that is not stretched
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


@pytest.mark.parametrize(("whole", "size"), SIZES)
def test_a_mirrored_picture_has_mirrored_targets(whole, size):
    taken = 0, 0, *whole
    plain, mirrored = (resize_scene(ramp(whole), taken, size, m).target for m in (False, True))
    same = plain[:, ::-1] == mirrored
    same[:, size // 2] |= size % 2 == 1  # which may be between two pixels, and mirrors itself
    assert same.all()
