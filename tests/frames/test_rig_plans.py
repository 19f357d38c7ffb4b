"""Plans of several cameras: their samples against NumPy in float64, files, and wrong input."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from frame_samples import LAYOUTS, MEAN, STD, bilinear, in_layout, random_frame
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from darswin.frames import Plan, Sampler, _frames
from darswin.frames.rig_plans import RigPlan

NAMES = ("front", "left", "rear", "right", "up")


def random_plan(sizes, counts, seed=0, ones=False, **parts):
    """Reads of random cameras anywhere in their frames, also at whole pixels and with weight 0."""
    rng = np.random.default_rng(seed)
    reads = int(counts.sum())
    sources = rng.integers(0, len(sizes), reads, np.uint8)
    height, width = np.array(sizes)[sources].T
    right, lower = rng.random((2, reads), np.float32)
    right[::5], lower[::7] = 0, 1
    weights = rng.random(reads, np.float32) * 2 / np.repeat(counts, counts.ravel()).clip(1)
    weights[::3] = 0.0
    return RigPlan(
        counts.astype(np.uint16), sources, rng.integers(0, width - 1, reads).astype(np.int16),
        rng.integers(0, height - 1, reads).astype(np.int16), right, lower,
        np.ones_like(right) if ones else weights.astype(np.float32), sizes, NAMES[: len(sizes)],
        **parts,
    )  # fmt: skip


def by_numpy(plan, frames):
    """The sums in float64, before they are rounded to 8 bits."""
    shape, channels = plan.counts.shape, frames[0][0, 0].size
    sums, pixel = (
        np.zeros((*shape, channels)),
        np.repeat(np.arange(plan.counts.size), plan.counts.ravel()),
    )
    for k, frame in enumerate(frames):
        chosen = plan.sources == k
        x = plan.columns[chosen] + plan.right[chosen].astype(float)
        y = plan.rows[chosen] + plan.lower[chosen].astype(float)
        samples = bilinear(frame.reshape(*frame.shape[:2], -1), x, y)
        np.add.at(sums.reshape(-1, channels), pixel[chosen], samples * plan.weights[chosen, None])
    if plan.output == "uint8":
        return sums.clip(0, 255).reshape(*shape, *frames[0].shape[2:])
    sums = (sums / 255 - np.array(plan.mean)) / np.array(plan.std)
    return np.where((plan.counts > 0)[..., None], sums, 0).transpose(2, 0, 1)


def assert_near(found, plan, frames):
    expected = by_numpy(plan, frames)
    assert found.shape == expected.shape
    if plan.output == "uint8":
        assert found.dtype == np.uint8 and np.abs(found - expected).max(initial=0) <= 0.5 + 1e-3
    else:
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


@st.composite
def calls(draw):
    """A plan, and frames of any sizes and layouts."""
    side, seed = st.sampled_from((2, 3, 7, 40)), draw(st.integers(0, 99))
    sizes = tuple((draw(side), draw(side)) for _ in range(draw(st.integers(1, 5))))
    shape = (draw(st.sampled_from((0, 1, 2, 9))), draw(st.sampled_from((1, 5, 159, 161, 330))))
    most = draw(st.lists(st.sampled_from((0, 1, 1, 2, 4, 16, 300, 512)), min_size=1, max_size=4))
    rng = np.random.default_rng(seed)
    counts = rng.choice(most, shape) * (rng.random(shape) < draw(st.sampled_from((0.02, 0.5, 1.0))))
    channels = draw(st.sampled_from(((), (1,), (3,))))
    normalization = dict(mean=MEAN, std=STD) if channels == (3,) else dict(mean=(0.3,), std=(0.7,))
    plan = random_plan(
        sizes, counts, seed, draw(st.booleans()), output=draw(st.sampled_from(("uint8", "image"))),
        **normalization,
    )  # fmt: skip
    return plan, [
        in_layout(random_frame(*size, *channels, seed=k), draw(st.sampled_from(LAYOUTS)))
        for k, size in enumerate(sizes)
    ]


@given(calls(), st.integers(2, 5))
def test_pixels_are_weighted_sums_of_reads_with_the_same_bits_on_any_number_of_threads(
    call, threads
):
    plan, frames = call
    sampler = Sampler(plan)
    found = sampler(frames)
    assert_near(found, plan, frames)
    named = dict(zip(plan.names, frames, strict=True))
    out = np.full_like(found, 77)
    again = sampler(dict(reversed(named.items())), out=out, threads=threads)  # names decide
    assert again is out
    np.testing.assert_array_equal(again, found)


@pytest.mark.parametrize("output", ["uint8", "image"])
def test_large_pictures_give_the_same_bits_on_any_number_of_threads(output):
    """As many reads as threads need: two cameras with a seam, a blend, and a hole."""
    counts = np.ones((301, 401), int)
    counts[:, 190:200], counts[100:200, 50:90] = 2, 0
    plan = random_plan(((90, 70), (66, 80)), counts, ones=True, output=output)
    column = np.repeat(np.broadcast_to(np.arange(401), counts.shape), counts.ravel())
    second = np.diff(np.repeat(np.arange(counts.size), counts.ravel()), prepend=-1) == 0
    sources = np.where(column < 190, 0, np.where(column < 200, second, 1)).astype(np.uint8)
    room = dict(columns=plan.columns % 68, rows=plan.rows % 64)
    weights = np.where((column >= 190) & (column < 200), 0.5, 1).astype(np.float32)
    plan = replace(plan, sources=sources, weights=weights, **room)
    frames = [random_frame(90, 70, 3), random_frame(66, 80, 3, seed=1)[..., ::-1]]
    sampler = Sampler(plan)
    found = sampler(frames)
    assert_near(found, plan, frames)
    for threads in (2, 3, 7):
        np.testing.assert_array_equal(sampler(frames, threads=threads), found)


def test_the_places_of_one_camera_give_the_bits_of_its_plan():
    rng = np.random.default_rng(0)
    points, frame = rng.random((40, 300, 2)) * (58, 48), random_frame(50, 60, 3)
    plan = Plan.of_points(points, (50, 60), output="uint8")
    places = {name: getattr(plan, name).ravel() for name in ("columns", "rows", "right", "lower")}
    ones = np.ones((40, 300))
    alone = RigPlan(
        ones.astype(np.uint16), sources=np.zeros(ones.size, np.uint8),
        weights=ones.astype(np.float32).ravel(), sizes=((50, 60),), names=("camera",), **places,
    )  # fmt: skip
    np.testing.assert_array_equal(Sampler(alone)([frame]), Sampler(plan)(frame))


SIZES = ((6, 9), (5, 4))
PLAN = random_plan(SIZES, np.array([[1, 0, 2], [3, 1, 1]]), mean=MEAN, std=STD)
FRAMES = [random_frame(*size, 3, seed=k) for k, size in enumerate(SIZES)]


def test_a_file_holds_the_plan(tmp_path):
    path = tmp_path / "rig.safetensors"
    plan = replace(PLAN, names=("vorne", "où ©"), output="image")
    plan.save(path)
    for loaded in (RigPlan.load(path), Sampler(path).plan):
        assert loaded == plan and hash(loaded) == hash(plan)
        assert {name: type(value) for name, value in vars(loaded).items()} == {
            name: type(value) for name, value in vars(plan).items()
        }
    np.testing.assert_array_equal(Sampler(path)(FRAMES), Sampler(plan)(FRAMES))
    refused("'darswin_plan' is missing", Plan.load, path)
    content = bytearray(path.read_bytes())
    content[-20] ^= 1
    path.write_bytes(content)
    refused("is no plan that darswin.frames can read", Sampler, path)


def test_plans_are_equal_if_their_attributes_are():
    others = [
        replace(PLAN, weights=PLAN.weights / 2), replace(PLAN, names=("front", "rear")),
        replace(PLAN, sizes=((6, 9), (5, 5))), replace(PLAN, output="image"),
        replace(PLAN, counts=PLAN.counts.T),
    ]  # fmt: skip
    assert replace(PLAN) == PLAN and PLAN not in others and PLAN != "plan"


def with_first(name, value):
    array = getattr(PLAN, name).copy()
    array.flat[0] = value
    return {name: array}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        *((with_first(name, value), "places outside of the frame of (front|left)")
          for name, value in [
              ("columns", -1), ("columns", 8), ("rows", -3), ("rows", 5), ("right", 1.01),
              ("lower", np.nan)]),
        *((with_first("weights", value), "finite and not below 0")
          for value in (-0.1, np.nan, np.inf)),
        (with_first("sources", 2), "a camera that it does not name"),
        (with_first("counts", 2), "do not fit together"),
        *(({name: getattr(PLAN, name)[:-1]}, "do not fit together")
          for name in ("sources", "columns", "rows", "right", "lower", "weights")),
        (dict(sources=PLAN.sources.astype(int)), "sources of a plan must be uint8"),
        (dict(counts=PLAN.counts.ravel()), "counts of a plan must be uint16 with 2 axes"),
        (dict(sizes=((6, 9), (5, 3))), "places outside of the frame of left"),
        (dict(sizes=((6, 9), (1, 40))), "2 to 32767 rows and columns"),
        (dict(sizes=((6, 40_000), (5, 4))), "2 to 32767 rows and columns"),
        (dict(sizes=SIZES[:1]), "a name of its own for each camera"),
        (dict(names=("front", "front")), "a name of its own for each camera"),
        (dict(output="tokens"), "no tokens"),
        (dict(output="jpeg"), "output must be one of"),
        (dict(std=(0.0,) * 3), "above 0"),
    ],
    ids=str,
)  # fmt: skip
def test_damaged_plans_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):  # by the plan itself, or by its sampler
        Sampler(replace(PLAN, **changes))


def test_a_plan_needs_a_camera_and_pixels_can_be_blind():
    nothing = random_plan(SIZES, np.zeros((2, 3), int), output="image")
    assert not Sampler(nothing)(FRAMES).any()
    empty = {name: getattr(nothing, name) for name in nothing.kinds if name not in ("mean", "std")}
    refused("do not fit together", Sampler, RigPlan(**empty | dict(sizes=(), names=())))


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        (FRAMES[:1], "there must be 2 frames, those of front, left, got 1"),
        (dict(front=FRAMES[0]), "the frame of left is missing"),
        (dict(front=FRAMES[0], left=FRAMES[1], top=FRAMES[1]), "no camera 'top', only front"),
        (FRAMES[::-1], r"frame of front must be of the plan's size, \(H, W\) = \(6, 9\)"),
        ([FRAMES[0], FRAMES[1][..., 0]], "frame of left must have the plan's 3 channels, got 1"),
        ([FRAMES[0], FRAMES[1][..., :2]], "frame of left must have shape"),
    ],
)
def test_wrong_frames_are_explained(frames, words):
    refused(words, Sampler(PLAN), frames)


def test_other_wrong_calls_are_explained():
    sampler = Sampler(PLAN)
    with pytest.raises(TypeError, match=r"frames must be a list.* got ndarray"):
        sampler(FRAMES[0])
    with pytest.raises(TypeError, match="frame of left must be a NumPy array of uint8, got float"):
        sampler([FRAMES[0], FRAMES[1].astype(float)])
    gray = Sampler(replace(PLAN, mean=(0.0,), std=(1.0,)))
    refused("frame of left must have as many channels as that of front, 3, got 1", gray,
            [FRAMES[0], FRAMES[1][..., 0]])  # fmt: skip
    refused("threads must be at least 1", sampler, FRAMES, threads=0)
    refused("out must be a writeable, C-contiguous array of uint8", sampler, FRAMES, FRAMES[0])
    memory = np.zeros(1000, np.uint8)
    left = memory[:60].reshape(5, 4, 3)
    refused("must not share memory", sampler, [FRAMES[0], left], memory[42:60].reshape(2, 3, 3))
    refused(r"shape \(H, W\)", _frames.rig_sampler, *[np.zeros(1)] * 7, [(2, 2)], ["a"], [1.0],
            [0.0], "uint8")  # fmt: skip


def test_frames_are_sampled_without_torch(tmp_path):
    PLAN.save(tmp_path / "rig.safetensors")
    np.savez(tmp_path / "frames.npz", *FRAMES)
    code = """if True:
        import sys
        import numpy as np
        from darswin.frames import Sampler
        frames = np.load("frames.npz")
        np.save("found.npy", Sampler("rig.safetensors")([frames["arr_0"], frames["arr_1"]]))
        assert not {"torch", "cv2"} & set(sys.modules)
    """
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=os.environ, check=True)
    np.testing.assert_array_equal(np.load(tmp_path / "found.npy"), Sampler(PLAN)(FRAMES))
