"""darswin.frames: the same bits as the operator, views, plans in files, and wrong input."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from frame_samples import LAYOUTS, MEAN, ROUND, STD, in_layout, random_frame
from helpers import CAMERAS, refused
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from lens_examples import RANDOM, random_lens

from darswin import create_model, frames
from darswin.deploy import camera
from darswin.frames import _frames
from darswin.frames.compiled import frames as compiled
from darswin.lens import Equidistant
from darswin.models import LensAdapter
from darswin.views import PolarView, make_view


def layer(rings=4, sectors=8, samples=(2, 3), layout="tokens", mean=MEAN, std=STD, **options):
    return PolarView(rings, sectors, samples, layout=layout, mean=mean, std=std, **options).eval()


@st.composite
def calls(draw):
    """A frame, a lens and a layer, with points inside, at the border and outside of the frame."""
    side = st.sampled_from((1, 2, 3, 7, 16, 33, 90, 300))
    height, width = draw(side), draw(side)
    radius = draw(st.sampled_from((0.1, 0.5, 0.8, 3.0))) * max(height, width)
    center = draw(st.sampled_from((None, (0.0, 0.0), (width - 1.0, height / 3), (-500.0, 2.0))))
    if draw(st.booleans()):
        lens = Equidistant.from_fov(3.0, radius, center)
    else:
        lens = random_lens(draw(st.sampled_from(RANDOM)), draw(st.integers(0, 99)), count=1)
        lens = lens.replace(focal=lens.focal * (radius / 1000), center=None)
    channels = draw(st.sampled_from(((), (1,), (3,))))
    sampling = layer(
        draw(st.sampled_from((1, 2, 5))),
        draw(st.sampled_from((1, 3, 16, 65))),
        (draw(st.sampled_from((1, 2, 5))), draw(st.sampled_from((1, 2, 3, 10)))),
        draw(st.sampled_from(("tokens", "image"))),
        *((MEAN, STD) if channels == (3,) else (0.3, 0.7)),
    )
    frame = random_frame(height, width, *channels, seed=draw(st.integers(0, 99)))
    return lens, sampling, in_layout(frame, draw(st.sampled_from(LAYOUTS)))


def by_operator(sampling, lens, frame):
    image = torch.from_numpy(np.ascontiguousarray(frame))
    image = image[None, None] if frame.ndim == 2 else image.permute(2, 0, 1)[None]
    return sampling(image, lens, channels_last=False)[0].numpy()


@given(calls(), st.integers(1, 3))
def test_samples_are_those_of_the_operator_bit_for_bit(call, threads):
    lens, sampling, frame = call
    sampler = frames.Sampler(camera.plan(sampling, lens, frame.shape[:2]))
    found = sampler(frame, threads=threads)
    np.testing.assert_array_equal(found, by_operator(sampling, lens, frame))


@pytest.mark.parametrize("size", [(96, 128), (540, 960)])  # packed by the operator, and not
@pytest.mark.parametrize("lens", CAMERAS, ids=["polynomial", "mei"])
@pytest.mark.parametrize("layout", ["tokens", "image"])
def test_real_cameras_and_many_points_give_the_same_bits(size, lens, layout):
    frame, sampling = random_frame(*size, 3), layer(32, 64, (3, 5), layout)
    lens = lens.in_picture(size) if size[0] / size[1] == 966 / 1280 else Equidistant.from_fov(
        3.2, 0.6 * size[0], (0.4 * size[1], 0.5 * size[0]), affine=[[1.0, 0.01], [0.0, 0.9]]
    )  # fmt: skip
    found = frames.Sampler(camera.plan(sampling, lens, size))
    expected = by_operator(sampling, lens, frame)
    for threads in (1, 2, 5):
        np.testing.assert_array_equal(found(frame, threads=threads), expected)


def test_a_polar_picture():
    frame, sampling = random_frame(64, 64, 3), layer()
    picture = frames.Sampler(camera.plan(sampling, ROUND, (64, 64), output="uint8"))(frame)
    plain = frames.Sampler(camera.plan(layer(layout="image", mean=0.0, std=1.0), ROUND, (64, 64)))
    assert picture.shape == (8, 24, 3)
    assert np.abs(picture - 255 * plain(frame).transpose(1, 2, 0)).max() <= 0.5 + 1e-3


def test_no_default_stands_in_for_a_missing_normalization():
    adapter = LensAdapter(torch.nn.Identity(), 32)  # it says nothing about its network
    for known in ({}, dict(mean=MEAN), dict(std=STD)):
        with pytest.raises(ValueError, match="does not say how frames are normalised"):
            camera.plan(adapter, ROUND, (64, 64), **known)
    plan = camera.plan(adapter, ROUND, (64, 64), mean=MEAN, std=STD)
    assert (plan.mean, plan.std, plan.output) == (MEAN, STD, "image")
    picture = camera.plan(adapter, ROUND, (64, 64), output="uint8")  # is not normalised
    assert frames.Sampler(picture)(random_frame(64, 64, 3)).shape == (32, 32, 3)


def test_plans_are_equal_if_their_attributes_are():
    one_number = camera.plan(layer(), ROUND, (50, 60), mean=0.25)  # for all channels
    assert (one_number.mean, one_number.std) == ((0.25,) * 3, STD)
    assert one_number == camera.plan(layer(mean=0.25), ROUND, (50, 60))
    one, same = (camera.plan(layer(), ROUND, (50, 60)) for _ in range(2))
    assert one == same and hash(one) == hash(same) and len({one, same}) == 1
    assert one == replace(one, mean=list(MEAN)) and one != "plan"
    moved = one.right.copy()
    moved.flat[-1] = 0.5 - moved.flat[-1]
    others = [
        replace(one, right=np.abs(moved)), replace(one, columns=one.columns + np.int16(1)),
        replace(one, lower=one.lower[:1]), replace(one, size=(50, 61)),
        replace(one, output="image"),
        replace(one, mean=(0.4, 0.5, 0.7)), replace(one, std=(0.2, 0.2, 0.2)),
    ]  # fmt: skip
    assert one not in others


def test_a_file_holds_the_plan(tmp_path):
    plan, frame = camera.plan(layer(), ROUND, (50, 60)), random_frame(50, 60, 3)
    path = tmp_path / "camera.safetensors"
    plan.save(path)
    loaded = frames.Plan.load(path)
    for name, value in vars(plan).items():
        found = getattr(loaded, name)
        assert type(found) is type(value)
        np.testing.assert_array_equal(found, value)
    np.testing.assert_array_equal(frames.Sampler(path)(frame), frames.Sampler(plan)(frame))
    refused(r"must end in \.safetensors", plan.save, tmp_path / "camera.npz")


@pytest.mark.parametrize("at", [0, 4, 8996, 9500])
@pytest.mark.parametrize("turned", [False, True])
def test_out_in_the_memory_of_the_frame_is_refused(at, turned):
    memory = np.zeros(40_000, np.uint8)
    frame = memory[: 50 * 60 * 3 + 500][-9000:].reshape(50, 60, 3)
    frame[:] = random_frame(50, 60, 3)
    if turned:
        frame = frame[::-1, :, ::-1]
    sampler = frames.Sampler(camera.plan(layer(), ROUND, (50, 60)))
    expected = sampler(frame)
    out = memory[at : at + expected.nbytes].view(np.float32).reshape(expected.shape)
    if at == 9500:  # just behind the frame
        np.testing.assert_array_equal(sampler(frame, out), expected)
    else:
        before = memory.copy()
        refused("out must not share memory with the frame", sampler, frame, out, threads=2)
        np.testing.assert_array_equal(memory, before)


def test_a_view_cannot_be_written_over_its_own_frame():
    plan = camera.plan(make_view("perspective", (50, 60), fov=1.0), ROUND, (50, 60), output="uint8")
    sampler, frame = frames.Sampler(plan), random_frame(50, 60, 3)
    refused("out must not share memory with the frame", sampler, frame, out=frame)
    sampler(frame, out=frame.copy())


def test_out_may_lie_in_the_gaps_of_a_frame():
    """Between the rows of a frame there may be room for the result."""
    room = np.zeros((50, 4096), np.uint8)
    frame = room[:, : 60 * 3].reshape(50, 60, 3)
    assert np.shares_memory(frame, room)
    frame[:] = random_frame(50, 60, 3)
    sampler = frames.Sampler(camera.plan(layer(2, 4), ROUND, (50, 60)))
    expected = sampler(frame)
    out = room[7, 256 : 256 + expected.nbytes].view(np.float32).reshape(expected.shape)
    assert np.may_share_memory(frame, out)
    np.testing.assert_array_equal(sampler(frame, out), expected)


def test_a_sampler_that_was_not_made_reads_nothing():
    sampler = frames.Sampler.__new__(frames.Sampler)
    with pytest.raises(AttributeError):
        sampler(random_frame(50, 60, 3))
    classes = [name for name, value in vars(_frames).items() if isinstance(value, type)]
    assert not classes  # pybind11's classes could be made without a constructor


MERCATOR = make_view("mercator", (4, 5))
NOTHING = make_view("mercator", (4, 5), theta_max=0.5, direction=(0, 0, -1))
ONE_CHANNEL, FOUR = (create_model("darswin_a_nano", in_chans=count) for count in (1, 4))


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        (dict(lens=CAMERAS[0]), ValueError, "lens belongs to images of"),
        (dict(lens=Equidistant([9.0, 8.0])), ValueError, "one lens, got 2"),
        (dict(lens=None), TypeError, "lens must be"),
        (dict(size=(50, 40_000)), ValueError, "at most 32767 pixels"),
        (dict(size=(0, 60)), ValueError, "size must be"),
        *((dict(size=size), TypeError, "size must be a pair of ints")
          for size in ((64.9, 80.2), (50, 60, 3), 60, (True, 60))),
        (dict(output="jpeg"), ValueError, "output must be one of"),
        (dict(sample=MERCATOR, output="tokens"), ValueError, "only a polar grid has tokens"),
        (dict(sample=NOTHING), ValueError, "this view sees nothing of the lens"),
        (dict(sample=torch.ones(4, 5, 3)), TypeError, "a view of darswin, got Tensor"),
        (dict(sample=torch.nn.Linear(1, 1)), TypeError, "got Linear"),
        *((given, ValueError, "one per channel") for given in (
            dict(mean=(0.4, 0.5)), dict(mean=(0.4,), std=STD), dict(std=(0.2,) * 4),
            dict(sample=ONE_CHANNEL, mean=MEAN, std=STD),
            dict(sample=create_model("darswin_a_nano"), mean=(0.4,), std=(0.2,)))),
        (dict(mean=(0.4, 0.5), std=(0.2, 0.3)), ValueError, "1 mean, or 3 for RGB, got 2"),
        (dict(sample=FOUR), ValueError, "1 mean, or 3 for RGB, got 4"),
        (dict(std=0.0), ValueError, "std must be positive"),
        (dict(std=(0.2, math.nan, 0.2)), ValueError, "std must be positive"),
        (dict(std=math.inf), ValueError, "std of a plan must be finite and above 0"),
        (dict(mean=(0.2, math.nan, 0.2)), ValueError, "mean of a plan must be finite"),
        (dict(sample=MERCATOR, mean=-math.inf), ValueError, "mean of a plan must be finite"),
    ],
)  # fmt: skip
def test_wrong_plans_are_explained(changes, error, words):
    given = dict(sample=layer(), lens=ROUND, size=(50, 60)) | changes
    with pytest.raises(error, match=words):
        camera.plan(given.pop("sample"), given.pop("lens"), given.pop("size"), **given)


PLAN = camera.plan(layer(), ROUND, (50, 60))


@pytest.mark.parametrize(
    "changes",
    [
        dict(columns=PLAN.columns[:-1]),
        dict(rows=PLAN.rows[..., :1]),
        dict(right=PLAN.right + 1.5),
        dict(lower=PLAN.lower * np.nan),
        dict(output="image"),
        dict(output="picture"),
        dict(size=(0, 60)),
        dict(size=(50, 2**40)),
        dict(size=(50.5, 60)),
        dict(mean=(0.0, 1.0)),
        dict(std=(0.0, 1.0, 1.0)),
        dict(mean=(0.0,) * 2, std=(1.0,) * 2),
        dict(columns=np.array(["a"])),
    ],
    ids=str,
)
def test_plans_that_do_not_fit_together_are_refused(changes, tmp_path):
    with pytest.raises(ValueError, match="plan"):  # by the plan itself, or by its sampler
        frames.Sampler(replace(PLAN, **changes))


def test_distances_of_0_and_1_are_pixel_centres():
    on, before = np.zeros_like(PLAN.right), np.ones_like(PLAN.right)
    inside = replace(PLAN, columns=PLAN.columns.clip(1, 40), rows=PLAN.rows.clip(1, 40), right=on)
    shifted = replace(inside, columns=inside.columns - 1, right=before)
    frame = random_frame(50, 60, 3)
    np.testing.assert_array_equal(frames.Sampler(shifted)(frame), frames.Sampler(inside)(frame))


def test_raw_calls_are_checked():
    radii, azimuths = np.ones(4, np.float32), np.ones(6, np.float32)
    for center, affine, offsets in [
        (np.ones(3), None, None), (np.ones(2), np.ones(3), None), (np.ones(2), None, np.ones(5)),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match="do not fit together"):
            _frames.polar_places(radii, azimuths, center, affine, offsets, (9, 9))
    for nothing in (radii[:0], radii):
        columns, *_ = _frames.polar_places(
            nothing, azimuths[: len(nothing)], np.full(2, math.nan), None, None, (9, 9)
        )
        assert columns.shape == (len(nothing), len(nothing)) and (columns == -3).all()


@given(st.data())
def test_a_picture_is_read_at_any_points(data):
    """Against weights of the four pixels around each point, in float64."""
    side, channels, k = (
        st.integers(1, 5),
        data.draw(st.integers(1, 4)),
        data.draw(st.integers(1, 3)),
    )
    height, width, rows, columns = (data.draw(side) for _ in range(4))
    number = st.one_of(
        st.floats(-3, 8, width=32), st.sampled_from([math.nan, math.inf, -math.inf, 3e38, -1e9])
    )
    points = data.draw(arrays(np.float32, (rows * k, columns * k, 2), elements=number))
    random = np.random.default_rng(data.draw(st.integers(0, 9)))
    picture = random.integers(0, 256, (height, width, channels), np.uint8)
    y, x = np.mgrid[:height, :width]
    with np.errstate(invalid="ignore"):
        weight = np.clip(1 - np.abs(points[..., 0, None, None].astype(float) - x), 0, None)
        weight = weight * np.clip(1 - np.abs(points[..., 1, None, None].astype(float) - y), 0, None)
    expected = np.einsum("ijyx,yxc->ijc", np.nan_to_num(weight), picture.astype(float))
    expected = expected.reshape(rows, k, columns, k, channels).mean((1, 3))
    found = compiled.read(picture, points, k)
    assert found.dtype == np.uint8 and np.abs(found - expected).max() <= 0.5 + 1e-3
    exact = compiled.read(picture.astype(np.float32), points, k)
    np.testing.assert_allclose(exact, expected, atol=1e-3)


def test_what_cannot_be_read_is_refused():
    picture, points = np.zeros((3, 4, 1), np.uint8), np.zeros((2, 4, 2), np.float32)
    for wrong in ((picture[0], points, 1), (picture, points[0], 1), (picture, points, 3),
                  (picture, points, 0), (picture, points[..., :1], 1)):  # fmt: skip
        refused("expected a picture", compiled.read, *wrong)
    for empty in (picture[:0], picture[:, :0], picture[..., :0]):
        refused("1 to 2\\^24 rows", compiled.read, empty, points, 1)
    with pytest.raises(TypeError):
        compiled.read(picture.astype(np.int16), points, 1)
