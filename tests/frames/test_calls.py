"""What samplers and networks for frames share: layouts, threads, `out`, and wrong frames."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from frame_samples import LAYOUTS, MEAN, ROUND, STD, in_layout, model_of, network_of, random_frame
from helpers import refused

from darswin import frames
from darswin.deploy import camera
from darswin.views import PolarView


def sampler(rings, sectors, samples):
    view = PolarView(rings, sectors, samples, layout="tokens", mean=MEAN, std=STD).eval()
    return frames.Sampler(camera.plan(view, ROUND, (70, 80)))


CALLED = {
    "sampler": lambda _: sampler(4, 8, (2, 3)),
    "sampler of many points": lambda _: sampler(32, 64, (4, 4)),
    "square": lambda folder: network_of(model_of("swin_unet", view="square"), folder),
    **{
        family: lambda folder, family=family: network_of(model_of(family), folder)
        for family in ("darswin_a", "swin", "darswin_unet_a")
    },
}


@pytest.fixture(scope="module", params=CALLED)
def called(request, tmp_path_factory):
    return CALLED[request.param](tmp_path_factory.mktemp("called"))


def frame_of(called, seed=0):
    return random_frame(
        *(called.plan.size if hasattr(called, "plan") else called.size), 3, seed=seed
    )


def test_every_layout_and_number_of_threads_gives_the_same_bits(called):
    frame = frame_of(called)
    expected = called(frame)
    for layout in LAYOUTS:
        for threads in (1, 2, 5):
            found = called(in_layout(frame, layout), threads=threads)
            np.testing.assert_array_equal(found, expected)
    bgr = np.ascontiguousarray(frame[..., ::-1])
    np.testing.assert_array_equal(called(bgr[..., ::-1]), expected)
    assert not np.array_equal(called(bgr), expected)


def test_threads_of_python_may_share_it(called):
    pictures = [frame_of(called, seed) for seed in range(6)]
    expected = [called(picture) for picture in pictures]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            results = pool.map(lambda p: called(p, threads=2), pictures)
            for found, right in zip(results, expected, strict=True):
                np.testing.assert_array_equal(found, right)


def test_out_takes_the_result(called):
    frame = frame_of(called)
    expected = called(frame)
    out = np.full_like(expected, np.nan)
    assert called(frame, out) is out and called(frame, out=out, threads=2) is out
    np.testing.assert_array_equal(out, expected)
    read_only, shape = expected.copy(), ", ".join(map(str, expected.shape))
    read_only.flags.writeable = False
    for wrong in (expected.astype(np.float64), expected[:-1], read_only, np.repeat(out, 2)[::2],
                  np.empty((*expected.shape, 2), np.float32)[..., 0], expected[None]):  # fmt: skip
        refused(rf"out must be .* of float32 with shape \({shape}\)", called, frame, wrong)
    for wrong in ([out], 1, "out"):
        name = type(wrong).__name__
        refused(f"^out must be a NumPy array, got .*{name}", called, frame, wrong, error=TypeError)
    memory = np.zeros(frame.nbytes - 4 + out.nbytes, np.uint8)
    inside = memory[: frame.nbytes].reshape(frame.shape)
    end = memory[frame.nbytes - 4 :].view(np.float32).reshape(out.shape)
    refused("out must not share memory with the frame", called, inside, end)


@pytest.mark.parametrize("name", ["sampler", "darswin_a"])
def test_wrong_frames_are_explained(name, tmp_path):
    called = CALLED[name](tmp_path)
    for frame, error, words in (
        (random_frame(80, 70, 3), ValueError, r"\(H, W\) = \(70, 80\), got \(80, 70\)"),
        (random_frame(70, 80, 4), ValueError, r"shape \(H, W\).*got \(70, 80, 4\)"),
        (random_frame(70, 80)[0], ValueError, r"shape \(H, W\).*got \(80\)"),
        (random_frame(70, 80), ValueError, "(plan|network)'s 3 channels, got 1"),
        (random_frame(70, 80, 3).astype(np.float32), TypeError, "array of uint8, got float32"),
        (random_frame(70, 80, 3).astype(np.int8), TypeError, "array of uint8, got int8"),
        (random_frame(70, 80, 3).tolist(), TypeError, "array of uint8, got .*list"),
        (torch.zeros(70, 80, 3, dtype=torch.uint8), TypeError, "array of uint8, got .*Tensor"),
    ):
        with pytest.raises(error, match=words) as caught:
            called(frame)
        assert "\n" not in str(caught.value)
    refused("threads must be at least 1", called, random_frame(70, 80, 3), threads=0)
