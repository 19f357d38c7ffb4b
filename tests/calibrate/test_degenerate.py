"""Corners from which no lens can be found: one sentence, never a crash or a lens of NaN."""

import itertools
import math

import pytest
import torch
from helpers import refused, slow_but
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mishaps import parallel
from rigs import board, f64, rig, true_lens

from darswin.calibrate import CalibrationError, calibrate

BOARD, SIZE = board(), (960, 1000)


@pytest.fixture(scope="module")
def true():
    return rig(true_lens("KannalaBrandt", 170), 6, least=20)


@pytest.mark.parametrize(("fov", "one_distance"), slow_but(
    itertools.product((60, 190), (True, False)), (60, True)
))  # fmt: skip
def test_boards_that_are_parallel_to_the_sensor(fov, one_distance):
    """Without noise; with some, they are a mishap."""
    true = rig(true_lens("KannalaBrandt", fov), 1)
    change = parallel(0.0, 0.2, 0.2 if one_distance else 0.5, noise=0.0)
    corners = change(true, torch.Generator().manual_seed(0)).corners
    refused("nearly parallel to the sensor: tilt them by 20 to", calibrate, corners, BOARD, SIZE,
            "KannalaBrandt", error=CalibrationError)  # fmt: skip


# What is made of good corners and their board, options, and the words of the error.
ERRORS = {
    "no picture": (lambda c, b: (c[:0], b), {}, "At least 3 pictures .* got 0"),
    "two pictures": (lambda c, b: (c[:2], b), {}, "At least 3 pictures .* got 2"),
    "nothing seen": (lambda c, b: (c * math.nan, b), {}, "At least 3 pictures .* got 0"),
    "one row seen": (lambda c, b: (
        torch.where((torch.arange(54) < 9)[:, None], c, math.nan), b), {}, "on one line"),
    "another board": (lambda c, b: (c, board(7, 5)), {},
                      r"`corners` must be of shape \(P, 35, 2\), got"),
    "turned board": (lambda c, b: (c, board(6, 9)), {}, "Are the board and the order of its"),
    "one point": (lambda c, b: (c[:, :1], b[:1]), {}, "A board needs 8 points or more"),
    "no point": (lambda c, b: (c[:, :0], b[:0]), {}, "A board needs 8 points or more"),
    "a line": (lambda c, b: (c[:, :9], b[:9]), {}, "not on one line, got 9"),
    "a spot": (lambda c, b: (c, 0 * b), {}, "not on one line"),
    "another size": (lambda c, b: (2 * c, b), {}, r"picture \d has a corner at .* of one size"),
    "infinity": (lambda c, b: (c + math.inf, b), {}, "`corners` must be finite, or NaN"),
    "infinite board": (lambda c, b: (c, b + math.inf), {}, "`board` must be finite"),
    "flat": (lambda c, b: (c[0], b), {}, r"`corners` must be of shape \(P, 54, 2\)"),
    "solid": (lambda c, b: (c, torch.zeros(54, 3)), {}, r"`board` must be a Board or points"),
    "unknown model": (lambda *of: of, {"model": "Kannala"}, "`model`: unknown lens model"),
    "names": (lambda *of: of, {"names": ["a"]}, "`names` must be 6 names"),
    "terms": (lambda *of: of, {"terms": 0}, "`terms` must be 1 to 64"),
    "one place": (lambda c, b: (c * 0 + 300, b), {}, "At least 3 pictures .* got 0"),
    "narrow model": (lambda c, b: (rig(true_lens("KannalaBrandt", 220), 6).corners, b),
                     {"model": "Orthographic"},
                     r"corners reach \d+° from the axis, but Orthographic lenses end at 90°"),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_errors(case, true):
    change, options, words = ERRORS[case]
    given, options = change(true.corners, BOARD), {"model": "KannalaBrandt"} | options
    assert "\n" not in refused(words, calibrate, *given, SIZE, **options)


def test_wrong_types_and_sizes(true):
    for arguments, words in (
        (("corners", BOARD, SIZE), "`corners` must be numbers"),
        ((true.corners, None, SIZE), "`board` must be numbers"),
        ((true.corners, BOARD, SIZE, 3), "model must be a lens class or its name"),
    ):
        refused(words, calibrate, *arguments, error=TypeError)
    for size in (960, (960,), (960.5, 1000), (0, 1000), "AB"):
        refused(r"`size` must be \(H, W\) in whole pixels", calibrate, true.corners, BOARD, size)


def test_boards_at_one_distance_blurred_corners_and_few_pictures_are_doubted(true):
    found = calibrate(true.corners[:1].expand(4, -1, -1), BOARD, SIZE, "Equidistant")
    blurred = calibrate(rig(true.lens, 3, noise=2.0).corners, BOARD, SIZE, "KannalaBrandt")
    for words, doubts in (
        ("all boards are at one distance", found.doubts),
        ("4 pictures show the board at 1 places, which are few", found.doubts),
        ("px off: the pictures are blurred", blurred.doubts),
    ):
        assert [text for text in doubts if words in text]


def test_corners_in_the_middle_only_are_doubted():
    narrow = rig(true_lens("Equidistant", 190, shift=0.0).with_theta_max(0.6), 3)
    found = calibrate(narrow.corners, BOARD, SIZE, "Equidistant")
    assert math.degrees(found.supported) == pytest.approx(math.degrees(0.6), abs=2)
    assert [text for text in found.doubts if text.startswith("corners reach 3")]


MESSES = st.sampled_from(["noise", "nan", "same", "swap", "far", "none", "row"])


@pytest.mark.slow
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    seed=st.integers(0, 10**6),
    pictures=st.integers(0, 5),
    columns=st.integers(1, 5),
    rows=st.integers(1, 4),
    fov=st.sampled_from([40.0, 90.0, 170.0, 250.0]),
    model=st.sampled_from(["KannalaBrandt", "Equidistant", "OCam", "DoubleSphere", "Tabulated"]),
    messes=st.lists(MESSES, max_size=3),
)
def test_any_rig_gives_a_lens_or_words(seed, pictures, columns, rows, fov, model, messes):
    generator = torch.Generator().manual_seed(seed)
    true = rig(true_lens("KannalaBrandt", fov, seed=seed), max(pictures, 1), board(columns, rows),
               seed=seed, least=1)  # fmt: skip
    corners = true.corners[:pictures].clone()
    for mess in messes:
        place = torch.rand(corners.shape[:2], generator=generator) < 0.3
        if mess == "noise":
            corners[place] = 900 * torch.rand(corners[place].shape, generator=generator, dtype=f64)
        elif mess == "nan":
            corners[place] = math.nan
        elif mess == "none":
            corners[:] = math.nan
        elif mess == "row":
            corners[place[:1].expand_as(place)] = math.nan
        elif mess == "same" and pictures:
            corners[:] = corners[:1].clone()
        elif mess == "swap":
            corners = corners.flip(1)
        else:
            corners[place] += 1e3
    try:
        found = calibrate(corners, true.board, true.size, model)
    except CalibrationError as error:
        assert len(str(error)) > 20 and "nan" not in str(error)
        return
    assert all(tensor.isfinite().all() for tensor in found.lens._tensors().values())
    assert found.used.sum() >= 3 and math.isfinite(found.sigma) and found.supported > 0
    assert found.rotations[found.used].isfinite().all() and found.covariance.isfinite().all()
