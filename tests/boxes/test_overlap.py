"""Overlaps and merges of upright and turned boxes, against OpenCV, polygons cut one by one, and the
rule box by box."""

import math

import cv2
import numpy as np
import pytest
from helpers import refused
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from darswin import boxes


def corners_of(box):
    """By complex numbers."""
    x, y, w, h, angle = box
    turn = complex(math.cos(angle), math.sin(angle))
    aside = [complex(a * w, b * h) / 2 * turn for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [complex(x, y) + corner for corner in aside]


def area_inside(polygon):
    ahead = polygon[1:] + polygon[:1]
    return sum((a.conjugate() * b).imag for a, b in zip(polygon, ahead, strict=True)) / 2


def slow_common(box, other):
    """Of turned boxes, a polygon is cut by one side of the other after the other, as Sutherland and
    Hodgman do."""
    if len(box) == 4:
        (x0, y0, x1, y1), (a0, b0, a1, b1) = box, other
        return max(min(x1, a1) - max(x0, a0), 0) * max(min(y1, b1) - max(y0, b0), 0)
    polygon, sides = corners_of(box), corners_of(other)
    for start, end in zip(sides, sides[1:] + sides[:1], strict=True):
        cut = []
        for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            of_a, of_b = (((end - start).conjugate() * (p - start)).imag for p in (a, b))
            cut += [a] if of_a >= 0 else []
            cut += [a + of_a / (of_a - of_b) * (b - a)] if of_a * of_b < 0 else []
        polygon = cut
    return area_inside(polygon) if len(polygon) > 2 else 0.0


def slow_area(box):
    x, y, w, h = box[:4]
    return w * h if len(box) == 5 else (w - x) * (h - y)


def slow_iou(box, other):
    if not np.isfinite([*box, *other]).all() or min(slow_area(box), slow_area(other)) <= 0:
        return 0.0
    common = slow_common(box, other)
    return common / (slow_area(box) + slow_area(other) - common)


def slow_merge(table, scores, labels, iou, inside):
    """The indices of the boxes that are kept, and the distance of the shares that decide from the
    limits."""
    kept, least = [], math.inf
    for k in sorted(range(len(table)), key=lambda k: -scores[k]):
        better = [table[j] for j in kept if labels[j] == labels[k]]
        shares = [
            (slow_iou(table[k], other), slow_common(table[k], other) / (slow_area(table[k]) or 1))
            for other in better
        ]
        shares = [both for both in shares if both[0] > 0]
        least = min([least, *(min(abs(a - iou), abs(b - inside)) for a, b in shares)])
        if not any(a > iou or b > inside for a, b in shares):
            kept.append(k)
    return kept, least


def any_boxes(most):
    """Turned ones: sides of 0 and 1, quarter turns, and many boxes that share sides."""
    numbers = st.integers(0, 4).map(float) | st.integers(0, 400).map(lambda k: k / 100)
    angles = st.integers(-4, 4).map(lambda k: k * math.pi / 4) | st.floats(-7, 7)
    one = st.tuples(numbers, numbers, numbers, numbers, angles)
    return st.lists(one, max_size=most).map(lambda rows: np.array(rows, float).reshape(-1, 5))


def upright_boxes(most):
    shapes = st.tuples(st.integers(0, most), st.just(4))
    corners = arrays(np.int64, shapes, elements=st.integers(0, 12))
    return corners.map(lambda rows: np.concatenate((rows[:, :2], rows[:, :2] + rows[:, 2:]), 1))


def random_upright(rng, count, far, most):
    low = rng.uniform(0, far, (count, 2))
    return np.concatenate((low, low + rng.uniform(0.2, most, (count, 2))), 1)


@given(any_boxes(4), any_boxes(4))
@example(np.array([[1.0, 1, 2, 2, 0]]), np.array([[1.0, 1, 2, 2, math.pi / 2]]))  # the same
@example(np.array([[1.0, 1, 2, 2, 0]]), np.array([[3.0, 1, 2, 2, math.pi]]))  # they touch
@example(np.array([[np.nan] * 5, [np.inf, 1, 1, 1, 0]]), np.array([[1.0, 1, 0, 4, 1], [1] * 5]))
def test_the_overlap_of_any_turned_boxes(table, others):
    shares = boxes.iou(table, others)
    expected = [[slow_iou(box, other) for other in others] for box in table]
    np.testing.assert_allclose(shares, np.reshape(expected, shares.shape), atol=1e-6)
    assert (shares >= 0).all() and (shares <= 1).all()


def test_the_overlap_is_that_of_opencv():
    rng = np.random.default_rng(0)
    table, others = (
        np.concatenate((rng.uniform(0, 9, (300, 2)), rng.uniform(0, 8, (300, 2)),
                        rng.uniform(-4, 4, (300, 1))), 1) for _ in range(2)
    )  # fmt: skip
    shares = np.diagonal(boxes.iou(table, others))
    for box, other, share in zip(table, others, shares, strict=True):
        pair = [(tuple(b[:2]), tuple(b[2:4]), math.degrees(b[4])) for b in (box, other)]
        _, points = cv2.rotatedRectangleIntersection(*pair)
        common = 0.0 if points is None else cv2.contourArea(cv2.convexHull(points))
        areas = box[2] * box[3] + other[2] * other[3]
        assert share == pytest.approx(common / (areas - common), abs=2e-3)  # in float32
    assert (shares > 0).sum() > 100


def test_upright_boxes_are_turned_by_nothing():
    rng = np.random.default_rng(1)
    table = random_upright(rng, 30, 20, 9)
    table[0], table[1, 2] = np.nan, table[1, 0]  # nothing, and a box without an area
    turned = boxes.turned(table)
    assert turned.shape == (30, 5) and boxes.turned(turned) is not table
    expected = boxes.iou(table, table)
    np.testing.assert_allclose(np.diagonal(expected), [0, 0, *[1] * 28])
    assert boxes.iou(table, np.zeros((0, 4))).shape == (30, 0)
    for a, b in ((turned, turned), (table, turned), (turned, table)):
        np.testing.assert_allclose(boxes.iou(a, b), expected, atol=1e-12)
    np.testing.assert_allclose(boxes.corners(table), boxes.corners(turned))
    np.testing.assert_allclose(boxes.corners([[1, 2, 4, 8]])[0], [[1, 2], [4, 2], [4, 8], [1, 8]])
    turned[:, 4] = rng.uniform(-4, 4, 30)
    rows = [[(corner.real, corner.imag) for corner in corners_of(box)] for box in turned]
    np.testing.assert_allclose(boxes.corners(turned), rows, atol=1e-12)


@given(
    any_boxes(12) | upright_boxes(40), st.sampled_from([0.0, 0.3, 0.5, 1.0]),
    st.sampled_from([0.0, 0.7, 1.0]), st.integers(0, 99),
)  # fmt: skip
@example(np.zeros((0, 4)), 0.5, 0.7, 0)
def test_merging_is_the_rule_box_by_box(table, iou, inside, seed):
    rng = np.random.default_rng(seed)
    scores, labels = rng.choice([0.1, 0.2, 0.5, 0.75], len(table)), rng.integers(0, 3, len(table))
    kept, least = slow_merge(table.tolist(), scores, labels, iou, inside)
    if table.shape[1] == 4 or least > 1e-9:  # of turned boxes, rounding decides a tie
        assert boxes.merge(table, scores, labels, iou=iou, inside=inside).tolist() == kept


@pytest.mark.parametrize("turned", [False, True])
def test_many_boxes_are_merged_in_blocks(turned):
    rng = np.random.default_rng(3)
    count = 200 if turned else 700
    table = random_upright(rng, count, 10 * math.sqrt(count), 60)
    table = boxes.turned(table) + turned * rng.uniform(0, 1, (count, 1)) if turned else table
    scores, labels = rng.random(count), rng.integers(0, 3, count)
    kept, _ = slow_merge(table.tolist(), scores, labels, 0.5, 0.7)
    assert 0.1 * count < len(kept) < 0.95 * count
    assert boxes.merge(table, scores, labels).tolist() == kept


def test_a_part_goes_with_the_whole_and_nan_is_left_out():
    table = [[0, 0, 10, 10], [0, 0, 3, 3], [0, 0, 3, 3], [np.nan] * 4, [50, 50, 60, 60]]
    scores, labels = [0.9, 0.8, 0.7, 1.0, np.nan], ["car", "car", "bus", "car", "car"]
    assert boxes.merge(table, scores, labels).tolist() == [0, 2]
    assert boxes.merge([], [], []).tolist() == []
    with pytest.raises(ValueError, match=r"scores must have shape \(5,\), as the boxes, got \(4,"):
        boxes.merge(table, scores[:4], labels)
    refused("iou must be in", boxes.merge, table, scores, labels, iou=50)


def test_a_part_stays_if_nothing_is_inside_enough():
    """`inside=1` is never exceeded, whatever the rounding."""
    rng = np.random.default_rng(2)
    small = np.concatenate((rng.uniform(-9, 9, (300, 2)), rng.uniform(1, 9, (300, 2)),
                            rng.uniform(-3, 3, (300, 1))), 1)  # fmt: skip
    for part in small:
        pair = np.array([[0.0, 0, 40, 40, 0.3], part])
        assert boxes.merge(pair, [0.9, 0.8], [0, 0], iou=1, inside=1).tolist() == [0, 1]
        assert boxes.merge(pair, [0.9, 0.8], [0, 0]).tolist() == [0]


def test_boxes_end_at_the_border():
    cut = boxes.clip([[-5, 2, 30, 50], [40, -9, 45, -3], [np.nan] * 4], (20, 25))
    np.testing.assert_array_equal(cut, [[0, 2, 25, 20], [25, 0, 25, 0], [np.nan] * 4])


def test_what_views_cut_is_one_thing():
    """A cut box loses against a larger whole one of another view, and cut ones are joined."""
    whole, left, right = [0.0, 0, 100, 40], [0.0, 0, 60, 40], [20.0, 0, 100, 40]
    far = [300.0, 0, 400, 40]
    for rows, scores, cuts, views, expected in (
        # the whole one has the lower score, and gets the higher one
        ([left, whole], [0.9, 0.4], [1, 0], [0, 1], [(whole, 0.9)]),
        ([left, whole], [0.9, 0.2], [1, 0], [0, 1], [(left, 0.9)]),  # much too low: merged by IoU
        ([left, whole], [0.9, 0.4], [0, 0], [0, 1], [(left, 0.9)]),
        ([whole, left], [0.9, 0.4], [1, 0], [0, 1], [(whole, 0.9)]),  # the whole one is smaller
        ([left, right], [0.9, 0.5], [1, 1], [0, 1], [(whole, 0.9)]),
        ([left, right, far], [0.5, 0.9, 0.7], [1, 1, 1], [0, 1, 1], [(whole, 0.9), (far, 0.7)]),
        # of one view, they are two things
        ([left, right], [0.9, 0.5], [1, 1], [2, 2], [(left, 0.9), (right, 0.5)]),
        ([right, left], [0.9, 0.5], [0, 1], [2, 2], [(right, 0.9), (left, 0.5)]),
        ([[0.0, 0, 20, 40], whole], [0.9, 0.5], [1, 0], [0, 1], [(whole, 0.9)]),
        ([left, [np.nan] * 4], [0.9, 0.95], [1, 1], [0, 1], [(left, 0.9)]),
    ):
        columns = np.array(rows), np.array(scores), np.zeros(len(rows), int)
        more = dict(cut=np.array(cuts, bool), view=np.array(views))
        found = boxes.Instances(*columns, more=more).merged()
        assert found.boxes.tolist() == [box for box, _ in expected]
        assert found.scores.tolist() == [score for _, score in expected]
        columns = *columns[:2], np.arange(len(rows))  # other classes
        assert len(boxes.Instances(*columns, more=more).merged()) == np.isfinite(rows).all(1).sum()
        turned = boxes.Instances(boxes.turned(np.array(rows)), *columns[1:], more=more)
        assert len(turned.merged()) == np.isfinite(rows).all(1).sum()


def test_a_box_at_the_border_of_a_view_is_cut():
    ends = np.array([[10.0, 10, 50, 50], [0, 10, 50, 50], [10, 10, 199, 50], [10, 10, 50, 120]])
    parts = [boxes.Instances(ends).through(lambda p, d=d: p + d, (900, 900), cut=(100, 200))
             for d in (0, 300)]  # fmt: skip
    found = boxes.Instances.joined(parts)
    assert found.more["cut"].tolist() == [False, True, True, True] * 2
    assert found.more["view"].tolist() == [0] * 4 + [1] * 4
    again = found.through(lambda p: p, (900, 900), cut=(900, 900))  # what was cut stays cut
    assert again.more["cut"].tolist() == found.more["cut"].tolist()
