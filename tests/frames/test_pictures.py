"""Plans of pictures: several reads of a pixel, several tiles, and points that go to the frame."""

import math

import numpy as np
import pytest
import torch
from frame_samples import MEAN, STD, bilinear, by_numpy, random_frame
from hypothesis import given
from hypothesis import strategies as st

from darswin import frames
from darswin.deploy import camera
from darswin.frames.compiled import frames as compiled
from darswin.lens import Equidistant, KannalaBrandt
from darswin.views import make_view

SIZE = (120, 160)
LENS = KannalaBrandt(40.0, [0.01], math.radians(95), center=[81.0, 58.0])


@st.composite
def plans(draw):
    """A plan with points inside, at the border and outside of its frame."""
    height, width = draw(st.sampled_from((1, 2, 3, 16, 50))), draw(st.sampled_from((1, 2, 7, 60)))
    reads = draw(st.sampled_from((1, 2, 3, 5, 16)))
    shape = (draw(st.sampled_from((1, 2, 9))), draw(st.sampled_from((1, 3, 40))))
    if draw(st.booleans()):
        shape = (draw(st.integers(1, 4)), *shape)
    shape += (reads**2,) * (reads > 1)
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    columns, rows = (rng.integers(-1, side, shape, dtype=np.int16) for side in (width, height))
    outside = rng.random(shape) < draw(st.sampled_from((0.0, 0.01, 1.0)))
    columns, rows = (np.where(outside, np.int16(-3), places) for places in (columns, rows))
    right, lower = rng.random((2, *shape), dtype=np.float32)
    output = draw(st.sampled_from(("image", "uint8")))
    gray = draw(st.booleans())
    mean, std = ((0.3,), (0.7,)) if gray else (MEAN, STD)
    plan = frames.Plan(columns, rows, right, lower, (height, width), output, mean, std, reads)
    return plan, random_frame(height, width, *(() if gray else (3,)), seed=draw(st.integers(0, 9)))


@given(plans(), st.integers(1, 4))
def test_pixels_are_the_means_of_their_points(call, threads):
    plan, frame = call
    sampler = frames.Sampler(plan)
    found, expected = sampler(frame, threads=threads), by_numpy(plan, frame)
    assert found.shape == expected.shape
    np.testing.assert_allclose(found, expected, atol=0.51 if plan.output == "uint8" else 2e-5)
    out = np.empty_like(found)
    assert sampler(frame, out) is out
    np.testing.assert_array_equal(out, found)  # on any number of threads


def view_of(name, reads=1, size=(48, 48), **options):
    averages = {} if name == "square" else dict(supersampling=reads, up=(0.1, -1, 0.2))
    return make_view(name, size, **averages, **options)


@pytest.mark.parametrize("name", ["tiles", "mercator", "panorama", "square", "perspective"])
@pytest.mark.parametrize("output", ["image", "uint8"])
def test_the_frames_of_a_plan_are_what_the_view_sees(name, output, tmp_path):
    mean, std = (MEAN, STD) if output == "image" else (0.0, 1.0)  # bytes are not normalized
    view = view_of(name, 2, mean=mean, std=std)
    plan, frame = camera.plan(view, LENS, SIZE, output=output), random_frame(*SIZE, 3)
    pixels = frames.Sampler(plan)(frame)
    seen = view(torch.from_numpy(frame)[None], LENS).numpy()
    seen = seen if name == "tiles" else seen[0]
    if output == "uint8":
        seen = np.moveaxis(seen, -3, -1) * 255
    assert pixels.shape == seen.shape
    np.testing.assert_allclose(pixels, seen, atol=3e-3 if output == "image" else 0.6)
    plan.save(tmp_path / "plan.safetensors")
    again = frames.Plan.load(tmp_path / "plan.safetensors")
    assert again == plan
    assert again.supersampling == plan.supersampling == (1 if name == "square" else 2)
    np.testing.assert_array_equal(frames.Sampler(again)(frame), pixels)
    # Plans are exact for lenses in single precision too.
    exact = camera.plan(view, LENS.to(torch.float64), SIZE, output=output)
    assert plan == exact == view.at(LENS, SIZE).plan(output)


@pytest.mark.parametrize("name", ["tiles", "mercator", "square", "perspective"])
@pytest.mark.parametrize("reads", [1, 3])
def test_points_of_a_plan_are_those_of_the_lens(name, reads):
    view = view_of(name, reads, (200, 200 if name == "square" else 240))
    plan = camera.plan(view, LENS, SIZE)
    points = np.random.default_rng(0).uniform(-0.5, 199.5, (500, 2))
    for tile, remap in enumerate(view.at(LENS, SIZE).tiles):
        places, expected = plan.points(points, tile), remap.to_image(points)
        seen = ~np.isnan(places + expected).any(-1)  # a plan ends within a pixel of the border
        inside = ((expected > 1) & (expected < [158, 118])).all(-1)
        assert seen[inside].mean() > 0.95 and seen.mean() > 0.05
        atol = 0.2 if name == "square" else 4e-3  # whose map has corners
        np.testing.assert_allclose(places[seen], expected[seen], atol=atol)
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


@pytest.mark.parametrize("side", [1, 2, 3, 4, 8, 9, 1024])
def test_points_at_the_edges_are_read_inside(side):
    """Also those that are one rounding before the edge, where a neighbour has no weight."""
    zero = np.float32(0)
    picture = np.random.default_rng(0).random((side, side, 2), np.float32) + 1
    ends = [np.nextafter(np.float32(end), zero) for end in (-1, side - 1, side)]
    x, y = np.meshgrid([-1, *ends, -1e-9, 0, side - 1, side], [*ends, 0, side - 1])
    x, y = x.astype(np.float32), y.astype(np.float32)
    expected = bilinear(picture.astype(np.float64), x.astype(float), y.astype(float))
    np.testing.assert_allclose(compiled.read(picture, np.stack((x, y), -1), 1), expected, atol=1e-3)
