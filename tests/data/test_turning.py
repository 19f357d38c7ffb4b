"""A ray stays on the same content of a picture, however picture and lens are turned together."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from frames import CALIBRATIONS, WOODSCAPE

from darswin.data import Calibrated, Calibrations, SphericalLenses, WideAngle
from darswin.data.order import TrainingOrder
from darswin.data.pictures import Arrays
from darswin.data.samples import Draw
from darswin.data.warp import RandomTurns, Turn, turned_picture
from darswin.lens import BrownConrady, Equidistant, KannalaBrandt, load
from darswin.lens.orientation import upright

SIZE = (120, 160)
# Oblong and skewed pixels, an off-middle principal point, terms that are not radial.
LENSES = {
    "round": Equidistant(60.0, 1.2, image_size=SIZE),
    "oblong": KannalaBrandt(
        60.0, [0.01], 1.0, [75.0, 64.0], affine=[[1.0, 0.05], [0.0, 0.9]], image_size=SIZE
    ),
    "tangential": BrownConrady(
        60.0, [0.01], 0.8, [75.0, 64.0], tangential=[0.02, -0.03], image_size=SIZE
    ),
    "woodscape": load(WOODSCAPE).in_picture((121, 160)),
}
TURNS = [Turn(0.0, True), Turn(0.7, False), Turn(math.pi / 2, False), Turn(-2.5, True)]


def blob(at, size):
    y, x = np.mgrid[: size[0], : size[1]]
    spot = np.exp(-((x - float(at[0])) ** 2 + (y - float(at[1])) ** 2) / (2 * 3.0**2))
    return (250 * spot).astype(np.uint8)[..., None]


def centroid(image):
    weight = image[..., 0].astype(float)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return torch.tensor([(x * weight).sum(), (y * weight).sum()], dtype=torch.float32) / float(
        weight.sum()
    )


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("name", LENSES)
def test_a_ray_stays_on_its_content(name, turn):
    lens = LENSES[name]
    size = tuple(int(side) for side in lens.image_size[0])
    for theta, azimuth in ((0.3, 0.5), (0.5, -1.0), (0.4, 2.5)):
        image, after = turned_picture(blob(lens.project_rays(theta, azimuth)[0], size), lens, turn)
        assert image.shape == (*size, 1) and tuple(after.image_size[0].tolist()) == size
        across = torch.tensor([math.cos(azimuth), math.sin(azimuth)], dtype=torch.float64)
        seen = torch.from_numpy(turn.matrix) @ across
        there = after.project_rays(theta, math.atan2(seen[1], seen[0]))[0]
        torch.testing.assert_close(centroid(image), there, atol=0.15, rtol=0)


def test_only_what_must_turn_with_a_picture_does():
    image = np.zeros((*SIZE, 1), np.uint8)
    assert str(turned_picture(image, LENSES["oblong"], TURNS[1])[1]) == str(LENSES["oblong"])
    assert str(turned_picture(image, LENSES["tangential"], TURNS[1])[1]) != str(
        LENSES["tangential"]
    )
    lens = turned_picture(image, LENSES["oblong"], TURNS[0])[1]
    assert str(lens) == str(upright(LENSES["oblong"], 2))


def test_mirrored_pixels_are_the_same_pixels():
    image = np.random.default_rng(0).integers(256, size=(*SIZE, 3), dtype=np.uint8)
    mirrored, _ = turned_picture(image, LENSES["round"], TURNS[0])
    assert (mirrored == image[:, ::-1]).all()


def pictures(count=8, side=64):
    image = blob((40.0, 25.0), (side, side))
    return Arrays(np.repeat(image[None], count, 0), np.arange(count), list("abcdefgh"), 1)


def warped(turns=None, **options):
    plain = dict(size=48, render=96, fov=2.0, mean=[0], std=[1])
    return WideAngle(pictures(), SphericalLenses(0, 1), turns=turns, **plain | options)


@pytest.mark.parametrize("turn", TURNS)
def test_a_warped_picture_turns_in_its_map(turn):
    dataset = warped()
    lens = dataset[0][1]
    picture = dataset.source[0][0]
    before, after = dataset.through(lens, picture), dataset.through(lens, picture, turn)
    middle = torch.tensor([23.5, 23.5])
    moved = torch.from_numpy(turn.matrix).float() @ (centroid(before) - middle)
    torch.testing.assert_close(centroid(after) - middle, moved, atol=0.15, rtol=0)
    # No second interpolation: a mirrored image has the same pixels, up to the map's rounding.
    if turn.angle == 0:
        np.testing.assert_allclose(after[:, ::-1].astype(int), before, atol=1)


def calibrated(turns=None, **options):
    lens = '{"model": "Equidistant", "focal": 20.0, "theta_max": 1.2}'
    plain = dict(size=48, mean=[0], std=[1])
    return Calibrated(pictures(), Calibrations(lens, "x"), turns=turns, **plain | options)


@pytest.mark.parametrize("make", [warped, calibrated])
def test_partners_turn_together_and_draws_repeat(make):
    dataset, still = make(RandomTurns(True, 180)), make()
    for draws in (list(TrainingOrder(8, 8, rank=0, world=1)),):
        images = [dataset[draw][0] for draw in draws]
        places = [centroid(image.permute(1, 2, 0).numpy()) for image in images]
        for one, other in zip(places, places[::-1], strict=True):
            torch.testing.assert_close(one, other, atol=1e-4, rtol=0)
        assert all((a - b).norm() > 0.1 for a, b in pairwise(places[:4]))
    draw = Draw(3, 2, 5)
    assert torch.equal(dataset[draw][0], dataset[draw][0])
    assert not torch.equal(dataset[draw][0], dataset[Draw(4, 2, 5)][0])
    assert torch.equal(make(RandomTurns())[draw][0], still[draw][0])  # off is as it was
    assert str(dataset[draw][1]) == str(still[draw][1])


def test_angles_and_mirrors_are_drawn_as_said():
    rng = np.random.default_rng(0)
    turns = [RandomTurns(True, 30).draw(rng) for _ in range(2000)]
    angles = np.degrees([turn.angle for turn in turns])
    assert np.abs(angles).max() <= 30 and np.abs(angles.std() - 30 / math.sqrt(3)) < 0.5
    assert 0.45 < np.mean([turn.mirrored for turn in turns]) < 0.55
    assert RandomTurns(False, 0).draw(rng) == (0.0, False)
    for angle in (-1, 181, math.nan):
        with pytest.raises(ValueError, match=r"`rotate_deg` must be in \[0, 180\]"):
            RandomTurns(rotate_deg=angle)


def test_cameras_with_tangential_terms_share_the_lens_too():
    files = CALIBRATIONS / "ros_plumb_bob.yaml"
    size = tuple(int(side) for side in load(files).image_size[0])
    images = np.zeros((4, *size, 1), np.uint8)
    source = Arrays(images, np.arange(4), list("abcd"), 1)
    dataset = Calibrated(
        source, Calibrations(files, "x"), turns=RandomTurns(True, 180), size=32, mean=[0], std=[1]
    )
    draws = list(TrainingOrder(4, 4, rank=0, world=1))
    lenses = [str(dataset[draw][1]) for draw in draws]
    assert lenses == lenses[::-1] and len(set(lenses)) == 2
