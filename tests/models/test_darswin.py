import math

import cv2
import numpy as np
import pytest
import torch
from helpers import refused
from lens_pictures import at_size

from darswin import create_model
from darswin.lens import Equidistant, KannalaBrandt, Spherical
from darswin.models.stages import stage_sizes

LENS = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def nano(**options):
    return create_model("darswin_a_nano", **(dict(num_classes=10) | options))


def images(batch=2, height=32, width=32):
    return torch.randn(batch, 3, height, width)


@pytest.mark.parametrize(
    ("arguments", "first", "expected"),
    [
        ((16, 64, 4, "A", (1, 16)), 0, [
            ((16, 64), (1, 16), (0, 4)), ((16, 16), (1, 16), (0, 0)),
            ((16, 4), (4, 4), (2, 0)), ((16, 1), (16, 1), (0, 0)),
        ]),
        ((16, 64, 4, "A", (1, 16), ((1, 4), (1, 4), (4, 1))), 2, [
            ((16, 4), (4, 4), (2, 0)), ((4, 4), (4, 4), (0, 0)),
        ]),
        ((8, 32, 3, "A", (1, 8), [[1, 4], [4, 1]]), 0, [
            ((8, 32), (1, 8), (0, 2)), ((8, 8), (1, 8), (0, 0)), ((2, 8), (1, 8), (0, 0)),
        ]),
        ((16, 64, 4, "RA", (4, 4)), 0, [
            ((16, 64), (4, 4), (2, 2)), ((8, 32), (4, 4), (2, 2)),
            ((4, 16), (4, 4), (0, 2)), ((2, 8), (2, 8), (0, 0)),
        ]),
        ((32, 32, 4, "RA", (4, 4)), 2, [  # the sizes of Swin
            ((8, 8), (4, 4), (2, 2)), ((4, 4), (4, 4), (0, 0)),
        ]),
        ((32, 128, 1, "A", (1, 64)), 0, [((32, 128), (1, 64), (0, 16))]),
        ((16, 16, 4, "A", (1, 16)), 3, [((4, 1), (4, 1), (0, 0))]),  # merged along the radius
        ((6, 12, 2, "A", (1, 6)), 0, [((6, 12), (1, 6), (0, 1)), ((6, 3), (2, 3), (1, 0))]),
    ],
)  # fmt: skip
def test_stage_plans(arguments, first, expected):
    plans = stage_sizes(*arguments)[first:]
    assert [(p.map_size, p.window, p.shift) for p in plans] == expected
    assert [plans[0].windows(block)["shift"] for block in range(3)] == [
        (0, 0), plans[0].shift, (0, 0)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((16, 60, 4, "A", (1, 16)), r"stage 1: window \(1, 16\) must divide the map, \(16, 60\)"),
        ((16, 6, 2, "A", (1, 6)), r"stage 2: a map of \(16, 6\) cannot be merged"),
        ((6, 64, 4, "A", (1, 16)), r"stage 3: window \(4, 4\) must divide the map, \(6, 4\)"),
        ((15, 64, 2, "RA", (5, 4)), r"stage 2: a map .* cannot be merged by \(2, 2\)"),
    ],
)
def test_sizes_that_do_not_divide(arguments, message):
    refused(message, stage_sizes, *arguments)


EVEN = dict(periodic_bias=True)
LAST_ALONG_RADIUS = EVEN | dict(merges=((1, 4), (1, 4), (4, 1)))
NANO_EVEN = EVEN | dict(merges=((1, 4), (4, 1)), window=(1, 8))
SHORT = dict(embed_dim=16, depths=(2, 2, 2, 2), num_heads=(1, 2, 4, 8))


@pytest.mark.parametrize(
    ("name", "options", "exact"),
    [  # the quarter turns that turn the features exactly
        ("darswin_ra_nano", EVEN, {1, 2, 3}),
        ("darswin_ra_micro", EVEN, {1, 2, 3}),
        ("darswin_ra_tiny", EVEN | SHORT, {1, 2, 3}),
        ("darswin_ra_small", EVEN | SHORT, {1, 2, 3}),
        ("darswin_ra_micro", {}, set()),
        ("darswin_ra_micro", dict(position_bias="angular"), {1, 2, 3}),
        ("darswin_a_nano", EVEN, {2}),
        ("darswin_a_nano", NANO_EVEN, {1, 2, 3}),
        ("darswin_a_micro", EVEN, set()),
        ("darswin_a_tiny", EVEN | SHORT, set()),
        ("darswin_a_small", EVEN | SHORT, set()),
        ("darswin_a_micro", LAST_ALONG_RADIUS, {1, 2, 3}),
        ("darswin_a_tiny", LAST_ALONG_RADIUS | SHORT, {1, 2, 3}),
        ("darswin_a_small", LAST_ALONG_RADIUS | SHORT, {1, 2, 3}),
        ("darswin_a_micro", dict(merges=LAST_ALONG_RADIUS["merges"]), set()),
    ],
)
def test_turning_the_image_turns_the_features(name, options, exact):
    model = create_model(name, num_classes=10, **options).eval()
    with torch.no_grad():
        for parameter_name, parameter in model.named_parameters():
            if "position_bias" in parameter_name:
                parameter.normal_()  # new biases are too small to show an error
        x, lens = images(1, 48, 48), Spherical.from_fov(0.4, 2.6, 24.0)
        maps = model.forward_intermediates(x, lens, intermediates_only=True)
        logits = model(x, lens)
        for turns in (1, 2, 3):
            # Azimuth runs from right to down, clockwise on the screen.
            turned = x.rot90(-turns, (2, 3))
            others = model.forward_intermediates(turned, lens, intermediates_only=True)
            change = (model(turned, lens) - logits).norm() / logits.norm()
            assert change <= 1e-5 if turns in exact else change >= 1e-2, (turns, change)
            if turns in exact:
                for before, later in zip(maps, others, strict=True):
                    tokens = before.shape[2] * turns // 4
                    torch.testing.assert_close(later, before.roll(tokens, 2), rtol=1e-3, atol=1e-4)


def test_another_lens_shows_the_same_tokens():
    # The purpose of DarSwin: two lenses that see a smooth scene give nearly the same tokens.
    def scene(lens, size):
        y, x = torch.meshgrid(torch.arange(size) - (size - 1) / 2,
                              torch.arange(size) - (size - 1) / 2, indexing="ij")  # fmt: skip
        theta = lens.unproject(torch.hypot(x, y))
        phi = torch.atan2(y, x)
        return torch.stack((torch.cos(3 * theta), torch.sin(2 * theta) * torch.cos(phi)))[None]

    lenses = [Spherical.from_fov(xi, math.radians(150), 100.0) for xi in (0.2, 0.9)]
    shared = dict(in_chans=2, jitter=0.0)
    errors = {}
    for spacing in ("theta", "radius"):
        torch.manual_seed(0)
        model = nano(spacing=spacing, **shared).eval()
        with torch.no_grad():
            a, b = (model.forward_features(scene(lens, 200), lens) for lens in lenses)
        errors[spacing] = ((a - b).norm() / a.norm()).item()
    assert errors["theta"] < 0.02 < 0.1 < errors["radius"], errors


@torch.no_grad()
@pytest.mark.parametrize("name", ["darswin_a_nano", "darswin_ra_nano"])
@pytest.mark.parametrize("size", [(64, 128), (128, 64)])
def test_a_squashed_picture_gives_the_same_as_the_picture(name, size):
    model = create_model(name, num_classes=10).eval()
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(256, size=(6, 6, 3), dtype=np.uint8), size[::-1])
    aside = dict(tangential=[0.02, 0.01], affine=[[1.0, 0.05], [0.0, 0.9]])
    for lens in (
        Equidistant(30.0, 1.5, image_size=size),
        KannalaBrandt(28.0, [0.01], 1.5, [60.0, 61.0], image_size=size, **aside),
    ):
        squashed, there = at_size(picture, lens, 64, "stretch")
        logits, same, other = (
            model(torch.from_numpy(image).permute(2, 0, 1)[None], seen_by)
            for image, seen_by in (
                (picture, lens), (squashed, there), (squashed, there.replace(affine=None)),
            )
        )  # fmt: skip
        off, without = ((x - logits).norm() / logits.norm() for x in (same, other))
        assert off < 0.01 and without > 5 * off
