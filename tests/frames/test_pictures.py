"""Plans of pictures: several reads of a pixel, several tiles, and points that go to the frame."""

import math

import numpy as np
import pytest
import torch
from frame_samples import MEAN, STD, bilinear, random_frame

from darswin import frames
from darswin.deploy import camera
from darswin.frames.compiled import frames as compiled
from darswin.lens import Equidistant, KannalaBrandt
from darswin.views import make_view

SIZE = (120, 160)
LENS = KannalaBrandt(40.0, [0.01], math.radians(95), center=[81.0, 58.0])


@pytest.mark.parametrize("name", ["tiles", "mercator", "panorama", "square", "perspective"])
@pytest.mark.parametrize("output", ["image", "uint8"])
def test_the_frames_of_a_plan_are_what_the_view_sees(name, output, tmp_path):
    options = {} if name == "square" else dict(supersampling=2, up=(0.1, -1, 0.2))
    mean, std = (MEAN, STD) if output == "image" else (0.0, 1.0)  # bytes are not normalized
    view = make_view(name, (48, 48), mean=mean, std=std, **options)
    plan = camera.plan(view, LENS, SIZE, output=output)
    frame = random_frame(*SIZE, 3)
    found = frames.Sampler(plan)(frame)
    seen = view(torch.from_numpy(frame)[None], LENS).numpy()
    seen = seen if name == "tiles" else seen[0]
    if output == "uint8":
        seen = np.moveaxis(seen, -3, -1) * 255
    assert found.shape == seen.shape
    np.testing.assert_allclose(found, seen, atol=3e-3 if output == "image" else 0.6)
    plan.save(tmp_path / "plan.safetensors")
    again = frames.Plan.load(tmp_path / "plan.safetensors")
    assert again == plan and again.supersampling == plan.supersampling == (2 if options else 1)
    np.testing.assert_array_equal(frames.Sampler(again)(frame), found)


@pytest.mark.parametrize("name", ["tiles", "mercator", "square", "perspective"])
@pytest.mark.parametrize("reads", [1, 3])
def test_points_of_a_plan_are_those_of_the_lens(name, reads):
    options = {} if name == "square" else dict(supersampling=reads)
    view = make_view(name, (200, 240) if name != "square" else (200, 200), mean=0, std=1, **options)
    plan = camera.plan(view, LENS, SIZE)
    points = np.random.default_rng(0).uniform(-0.5, 199.5, (500, 2))
    for tile, remap in enumerate(view.at(LENS, SIZE).tiles):
        found, expected = plan.points(points, tile), remap.to_image(points)
        seen = ~np.isnan(found + expected).any(-1)  # a plan ends within a pixel of the border
        inside = ((expected > 1) & (expected < [158, 118])).all(-1)
        assert seen[inside].mean() > 0.95 and seen.mean() > 0.05
        np.testing.assert_allclose(found[seen], expected[seen], atol=0.2)
        if name != "square":  # whose map has corners
            np.testing.assert_allclose(found[seen], expected[seen], atol=4e-3)
        far = plan.points(np.array([[-0.6, 5.0], [5.0, 200.0], [np.nan, 3.0]]), tile)
        assert np.isnan(far).all()
    assert plan.points(np.zeros((0, 2))).shape == (0, 2)
    assert plan.points(np.zeros((2, 3, 2))).shape == (2, 3, 2)


def test_plans_that_do_not_fit_are_refused():
    places = np.zeros((4, 5, 4), np.int16), np.zeros((4, 5, 4), np.int16)
    parts = np.zeros((4, 5, 4), np.float32), np.zeros((4, 5, 4), np.float32)
    frames.Sampler(frames.Plan(*places, *parts, (8, 9), "image", supersampling=2))
    for output, reads in (("image", 3), ("image", 0), ("image", 17), ("tokens", 2), ("image", -1)):
        with pytest.raises(ValueError, match="do not fit together"):
            frames.Sampler(frames.Plan(*places, *parts, (8, 9), output, supersampling=reads))
    with pytest.raises(ValueError, match="tokens has no pixels"):
        tokens = [array.reshape(2, 2, 5, 4) for array in (*places, *parts)]
        frames.Plan(*tokens, (8, 9), "tokens").points(np.zeros((1, 2)))
    view = make_view("tiles", (8, 8))
    with pytest.raises(IndexError):
        camera.plan(view, Equidistant(40.0, 1.5), SIZE).points(np.zeros((1, 2)), tile=5)
    with pytest.raises(ValueError, match="sees nothing of the lens"):
        narrow = make_view("perspective", (8, 8), direction=(0, 0, -1))
        camera.plan(narrow, Equidistant(40.0, 1.5), SIZE)


@pytest.mark.parametrize("name", ["perspective", "equirectangular", "square", "tiles"])
def test_plans_are_exact_for_lenses_in_single_precision_too(name):
    view = make_view(name, 30)
    exact = camera.plan(view, LENS.to(torch.float64), SIZE)
    assert camera.plan(view, LENS, SIZE) == exact == view.at(LENS, SIZE).plan("image")


@pytest.mark.parametrize("side", [1, 2, 3, 4, 8, 9, 1024])
def test_points_at_the_edges_are_read_inside(side):
    """Also those that are one rounding before the edge, where a neighbour has no weight."""
    zero = np.float32(0)
    picture = np.random.default_rng(0).random((side, side, 2), np.float32) + 1
    ends = [np.nextafter(np.float32(end), zero) for end in (-1, side - 1, side)]
    x, y = np.meshgrid([-1, *ends, -1e-9, 0, side - 1, side], [*ends, 0, side - 1])
    x, y = x.astype(np.float32), y.astype(np.float32)
    expected = bilinear(picture.astype(np.float64), x.astype(float), y.astype(float))
    np.testing.assert_allclose(compiled.read(picture, x, y, 1), expected, atol=1e-3)
