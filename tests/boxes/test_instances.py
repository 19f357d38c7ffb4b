"""Instances: columns that are joined, chosen and moved together."""

import numpy as np
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from darswin.boxes import Instances, corners, encode_rle

RLE = encode_rle(np.eye(4))
PARTS = st.fixed_dictionaries({
    "count": st.integers(0, 3), "columns": st.sampled_from([4, 5]),
    "points": st.sampled_from([None, 0, 1, 3]), "masks": st.booleans(), "outlines": st.booleans(),
})  # fmt: skip


def instances_of(count, columns, points, masks, outlines, first=0):
    """Instances whose labels count on from `first`, and whose other columns follow from these."""
    numbers = np.arange(first, first + count, dtype=float)
    boxes = np.stack((numbers, numbers, numbers + 2, numbers + 3, 0 * numbers)[:columns], 1)
    keypoints = None if points is None else np.tile(numbers[:, None, None], (1, points, 3))
    return Instances(
        boxes, numbers, numbers.astype(int), keypoints, masks=[RLE] * count if masks else None,
        outlines=[[np.full((3, 2), k)] for k in numbers] if outlines else None,
        more={"name": [str(k) for k in numbers]},
    )  # fmt: skip


@given(st.lists(PARTS, max_size=4), st.data())
def test_rows_stay_together_when_parts_are_joined_and_chosen(parts, data):
    starts = np.cumsum([0, *(part["count"] for part in parts)]).tolist()
    each = [instances_of(**part, first=k) for part, k in zip(parts, starts, strict=False)]
    joined = Instances.joined(each)
    assert joined.labels.tolist() == [*range(starts[-1])] and len(joined) == starts[-1]
    rows = data.draw(st.lists(st.integers(0, starts[-1] - 1)) if starts[-1] else st.just([]))
    for chosen in (joined[np.array(rows, int)], Instances.joined([joined[k] for k in rows])):
        assert chosen.labels.tolist() == rows and len(chosen) == len(rows)
        for k, row in enumerate(rows):
            part, source = next(p for p in zip(parts, each, strict=True) if row in p[1].labels)
            assert chosen.more["name"][k] == str(float(row)) and chosen.scores[k] == row
            expected = source[source.labels == row]
            np.testing.assert_array_equal(corners(chosen.boxes[k, None]), corners(expected.boxes))
            if chosen.masks is not None:
                assert chosen.masks[k] == (RLE if part["masks"] else None)
            if chosen.outlines is not None:
                assert len(chosen.outlines[k]) == part["outlines"]
            if chosen.keypoints is not None:
                known = ~np.isnan(chosen.keypoints[k, :, 2])
                assert (chosen.keypoints[k, known] == row).all()
                assert known.sum() == (part["points"] or 0)


def test_rows_are_chosen_as_those_of_an_array():
    all_three = instances_of(3, 4, 1, True, True)
    for rows in (1, slice(1, 2), [1], np.array([False, True, False])):
        assert all_three[rows].labels.tolist() == [1]
    assert [instance.labels.item() for instance in all_three] == [0, 1, 2]
    refused("out of bounds", all_three.__getitem__, 3, error=IndexError)


def test_columns_that_do_not_fit_are_named():
    for error, said, columns in (
        (TypeError, "boxes must be an array, got list", dict(boxes=[[0, 0, 1, 1]])),
        (ValueError, r"boxes must have shape \(K, 4\)", dict(boxes=np.zeros((2, 3)))),
        (ValueError, "scores must have 2 rows, as the boxes, got 1", dict(scores=np.ones(1))),
        (ValueError, "masks must have 2 rows, as the boxes, got 3", dict(masks=[None] * 3)),
        (ValueError, "name must have 2 rows, as the boxes, got 0", dict(more={"name": []})),
    ):
        refused(said, lambda c=columns: Instances(**{"boxes": np.zeros((2, 4))} | c), error=error)
    row, other = instances_of(1, 4, None, False, False), Instances(np.zeros((1, 4)))
    refused("either all parts or none must have scores", Instances.joined, [row, other])
    assert len(Instances.joined([row, other[:0]])) == 1  # a tile without detections
    refused("need scores and labels to be merged", other.merged)
    parts = [Instances(other.boxes, keypoints=np.zeros((1, 3, width))) for width in (2, 3)]
    refused("keypoints must have 2 columns in all parts", Instances.joined, parts)
