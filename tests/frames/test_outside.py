"""What a sampler reads: any places of a plan, of which some lie outside of the frame, in runs, at
random or all of them. NumPy's means of bilinear samples are the oracle."""

import numpy as np
import pytest
from frame_samples import LAYOUTS, STD, by_numpy, in_layout, random_frame
from hypothesis import given
from hypothesis import strategies as st

from darswin import frames

OUTPUTS = ("tokens", "image", "uint8")
MEAN = (0.41, 0.53, 0.62)  # no pixel has it, so that only what lies outside is zero


def plan_of(outside, size, output="image", *, reads=1, seed=0, gray=False):
    """A plan with random places in the frame or at its border, and any outside."""
    height, width = size
    rng = np.random.default_rng(seed)
    shape = outside.shape
    columns, rows = (rng.integers(-1, side, shape) for side in (width, height))
    far = [
        rng.choice(
            [-(2**15), -3, -2, side, side + 1, 2**15 - 1, *rng.integers(side, 2**15, 3)], shape
        )
        for side in size[::-1]
    ]
    beside = rng.integers(0, 3, shape)  # outside of both sides, or of one
    columns = np.where(outside & (beside != 1), far[0], columns).astype(np.int16)
    rows = np.where(outside & (beside != 2), far[1], rows).astype(np.int16)
    right, lower = rng.random((2, *shape), np.float32)
    mean, std = ((0.3,), (0.7,)) if gray else (MEAN, STD)
    return frames.Plan(columns, rows, right, lower, size, output, mean, std, reads)


def check(plan, frame, threads=(1, 2, 5)):
    """Every number of the result is written, and is right."""
    sampler, expected = frames.Sampler(plan), by_numpy(plan, frame)
    kind, rubbish = (np.uint8, 99) if plan.output == "uint8" else (np.float32, np.nan)
    for count in threads:
        found = sampler(frame, np.full(expected.shape, rubbish, kind), threads=count)
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, atol=0.51 if kind == np.uint8 else 2e-5)
        assert (found[expected == 0] == 0).all()  # exactly


@st.composite
def runs(draw, count):
    """Whether each of so many places is outside: runs of any length, one after the other."""
    lengths = draw(st.lists(st.sampled_from((1, 2, 7, 8, 9, 16, 40, 256, 257, 1000)), min_size=1))
    flags = np.arange(len(lengths)) % 2 == draw(st.integers(0, 1))
    return np.resize(np.repeat(flags, lengths), count)


@st.composite
def calls(draw):
    output, reads = draw(st.sampled_from(OUTPUTS)), draw(st.sampled_from((1, 1, 2, 3, 5, 16)))
    side = st.sampled_from((0, 1, 2, 9, 40) if reads <= 3 else (1, 2, 9))
    if output == "tokens":
        reads, shape = 1, (draw(side), draw(side), draw(st.integers(0, 3)), draw(st.integers(1, 3)))
    else:
        shape = (draw(side), draw(side))
        shape = (draw(st.integers(0, 3)), *shape) if draw(st.booleans()) else shape
    count, each = int(np.prod(shape)), (reads**2,) * (reads > 1)
    how = draw(st.sampled_from(("runs", "pixels", "points")))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    share = draw(st.sampled_from((0.0, 0.05, 0.5, 0.95, 1.0)))
    outside = draw(runs(count)) if how == "runs" else rng.random(count) < share
    outside = np.broadcast_to(outside.reshape(*shape, *(1,) * len(each)), shape + each)
    if how == "points":
        outside = rng.random(shape + each) < share
    size = draw(st.sampled_from((1, 2, 30))), draw(st.sampled_from((1, 2, 50)))
    gray = draw(st.booleans())
    seed = draw(st.integers(0, 99))
    plan = plan_of(outside, size, output, reads=reads, seed=seed, gray=gray)
    frame = random_frame(*size, *(draw(st.sampled_from(((), (1,)))) if gray else (3,)), seed=seed)
    return plan, in_layout(frame, draw(st.sampled_from(LAYOUTS)))


@given(calls())
def test_what_lies_outside_is_zero_and_the_rest_is_right(call):
    check(*call)


# More pixels than one thread samples in one go; a circle, halves, rows and random places.
Y, X = np.mgrid[:150, :256]
SHAPES = {
    "circle": np.hypot(Y - 75, X - 128) > 70,
    "corner": (Y < 75) | (X < 128),
    "first half": Y < 75,
    "second half": Y >= 75,
    "rows": Y % 2 == 0,
    "one place": (Y != 149) | (X != 3),
    "all but one place": (Y == 149) & (X == 3),
    "random": np.random.default_rng(0).random(Y.shape) < 0.5,
    "all": Y >= 0,
    "none": Y < 0,
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("output", OUTPUTS)
def test_large_plans(name, output):
    outside = SHAPES[name].reshape((50, 64, 3, 4) if output == "tokens" else (3, 50, 256))
    check(plan_of(outside, (30, 50), output), random_frame(30, 50, 3))
