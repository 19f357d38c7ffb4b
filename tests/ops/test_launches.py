"""How many kernels the operators launch on a device, counted on "meta": nothing here ran on one."""

import pytest
import torch
from launches import fused_attention, launches

from darswin.ops import polar_embed, polar_sample, use_reference, window_attention

# The sizes of darswin_a_small: 64×64, S = 10.
SIZES = dict(image=(2, 3, 64, 64), radii=(2, 160), azimuths=(640,), center=(2, 2))
# Of (R, A), window, shift, periodic and the most launches, with torch's attention as one of them.
ATTENTION = {
    "A, stage 1": ((16, 64), (1, 16), (0, 0), (False, True), 3),
    "A, stage 1, shifted": ((16, 64), (1, 16), (0, 4), (False, True), 5),
    "A, stage 3, shifted": ((16, 4), (4, 4), (2, 0), (False, True), 10),
    "RA, shifted": ((16, 64), (4, 4), (2, 2), (False, True), 12),
    "Swin, shifted": ((16, 16), (4, 4), (2, 2), (False, False), 15),
}


def meta(*shape, dtype=torch.float32):
    return torch.empty(shape, device="meta", dtype=dtype)


def sample(**options):
    return polar_sample(**{n: meta(*s) for n, s in SIZES.items()}, samples=(10, 10), **options)


@pytest.mark.parametrize(
    ("most", "options"),
    [
        (20, dict()),
        (20, dict(layout="image")),
        (100, dict(jitter=1.0, seed=5)),
        (22, dict(offsets=meta(2, 2, 160, 640))),
        (30, dict(affine=meta(2, 2, 2), offsets=meta(2, 2, 160, 640))),
    ],
    ids=["tokens", "image", "jitter", "offsets", "general"],
)
def test_sampling(most, options):
    counted = launches(lambda: sample(**options))
    assert counted.total() <= most, counted


def test_embedding_is_one_more():
    grid = {name: meta(*shape) for name, shape in SIZES.items()}
    counted = launches(
        lambda: polar_embed(**grid, weight=meta(96, 300), bias=meta(96), samples=(10, 10))
    )
    assert counted.total() <= 21, counted


def test_camera_frames_are_normalized_without_a_copy_from_the_host():
    grid = {name: meta(*shape) for name, shape in SIZES.items()} | dict(
        image=meta(2, 3, 64, 64, dtype=torch.uint8)
    )
    for mean, most in ((0.5, 25), ([0.4, 0.5, 0.6], 34)):
        counted = launches(lambda mean=mean: polar_sample(**grid, samples=(10, 10), mean=mean))
        assert counted.total() <= most, counted


def attend(case, dtype=torch.float32):
    (rings, sectors), window, shift, periodic, _ = ATTENTION[case]
    qkv = meta(2, rings, sectors, 3, 3, 32, dtype=dtype)
    bias = meta(2, 3, 2 * window[0] - 1, 2 * window[1] - 1)
    return window_attention(qkv, bias, window=window, shift=shift, periodic=periodic)


@pytest.mark.parametrize("case", ATTENTION)
def test_attention(case):
    for dtype, more in ((torch.float32, 0), (torch.bfloat16, 2)):
        with fused_attention():
            counted = launches(attend, case, dtype)
        assert counted.total() <= ATTENTION[case][-1] + more, counted


@pytest.mark.parametrize("case", ["A, stage 1", "A, stage 1, shifted"])
def test_attention_where_torch_has_no_fused_one(case):
    counted = launches(attend, case)
    assert counted.total() <= 14, counted


def test_the_reference_counts_more():
    with use_reference():
        assert launches(sample).total() > 100
        assert launches(attend, "A, stage 1").total() > 20
    with use_reference(), pytest.raises(AssertionError, match="copies between host and device"):
        launches(lambda: sample(jitter=1.0, seed=5))
