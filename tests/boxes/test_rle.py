"""COCO's encoding of masks, against one written from COCO's source."""

import numpy as np
from helpers import refused
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from darswin import boxes


def runs_of(mask):
    """The runs of a mask down its columns, pixel by pixel; the first is of zeros."""
    runs, value, length = [], 0, 0
    for column in mask.T.tolist():
        for pixel in column:
            if bool(pixel) != value:
                runs.append(length)
                value, length = bool(pixel), 0
            length += 1
    return [*runs, length]


def text_of(runs):
    """rleToString of COCO's maskApi.c, line by line."""
    text = ""
    for i, run in enumerate(runs):
        x = run
        if i > 2:
            x -= runs[i - 2]
        more = True
        while more:
            c = x & 0x1F
            x >>= 5
            more = x != -1 if c & 0x10 else x != 0
            if more:
                c |= 0x20
            text += chr(c + 48)
    return text


masks = arrays(bool, st.tuples(st.integers(0, 12), st.integers(0, 12)))


@given(masks)
@example(np.zeros((0, 3), bool))
@example(np.ones((1, 1), bool))
def test_run_lengths_are_those_of_coco(mask):
    plain, packed = boxes.encode_rle(mask, compressed=False), boxes.encode_rle(mask)
    assert plain == {"size": list(mask.shape), "counts": runs_of(mask)}
    assert packed == {"size": list(mask.shape), "counts": text_of(runs_of(mask))}
    for rle in (plain, packed, packed | {"counts": packed["counts"].encode()}):
        np.testing.assert_array_equal(boxes.decode_rle(rle), mask)


def test_long_runs_are_those_of_coco():
    rng = np.random.default_rng(4)
    runs = (2.0 ** rng.uniform(0, 17, 60)).astype(int).tolist()
    runs[-1] += -sum(runs) % 1000
    mask = np.repeat(np.arange(60) % 2, runs).reshape((1000, -1), order="F")
    assert boxes.encode_rle(mask)["counts"] == text_of(runs)
    np.testing.assert_array_equal(boxes.decode_rle({"size": mask.shape, "counts": text_of(runs)}),
                                  mask)  # fmt: skip


SIZES = r"must have a size \[H, W\] and counts"
WRONG = [
    ([3, 4], "sum 12, got 7"),
    ([3, -1, 10], "from 0 to 12, got \\["),
    ([2**63 - 1, 2**63 - 1, 14], "from 0 to 12, got"),
    ([[12]], "from 0 to 12"),
    ("04é", "must not contain"),
    ("0o", "ends within a number"),
    ("o" * 40 + "0", "more than 60 bits"),
    ("oooooo0", "at most"),
]
NOT_WHOLE = [2**70, 1], [float("inf")], [1.5, 10.5], ["a"], [[1], [2, 3]]


def test_wrong_encodings_are_refused():
    for counts, said in (*WRONG, *((of, "whole numbers") for of in NOT_WHOLE)):
        refused(said, boxes.decode_rle, {"size": [3, 4], "counts": counts})
    for size in (None, [2**20, 2**20], [-2, -2], [float("nan"), 2]):
        refused(SIZES, boxes.decode_rle, {"size": size, "counts": [4]})
    for rle in ({"size": [2, 2]}, {"counts": [4]}):
        refused(SIZES, boxes.decode_rle, rle)
