"""Turned boxes of darswin.boxes, against OpenCV, polygons cut one by one, and algebra."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from darswin import boxes
from darswin.lens import Equidistant
from darswin.views import make_view


def same(points):
    return points


def nothing(points):
    return np.full(points.shape, np.nan)


def corners_of(box):
    """By complex numbers."""
    x, y, w, h, angle = box
    turn = complex(math.cos(angle), math.sin(angle))
    aside = [complex(a * w, b * h) / 2 * turn for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return [complex(x, y) + one for one in aside]


def area_of(polygon):
    ahead = polygon[1:] + polygon[:1]
    return sum((a.conjugate() * b).imag for a, b in zip(polygon, ahead, strict=True)) / 2


def slow_common(box, other):
    """A polygon is cut by one side of the other after the other, as Sutherland and Hodgman do."""
    polygon, sides = corners_of(box), corners_of(other)
    for start, end in zip(sides, sides[1:] + sides[:1], strict=True):
        cut = []
        for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            of_a, of_b = (((end - start).conjugate() * (p - start)).imag for p in (a, b))
            cut += [a] if of_a >= 0 else []
            cut += [a + of_a / (of_a - of_b) * (b - a)] if of_a * of_b < 0 else []
        polygon = cut
    return area_of(polygon) if len(polygon) > 2 else 0.0


def slow_iou(box, other):
    if not np.isfinite([*box, *other]).all() or min(*box[2:4], *other[2:4]) <= 0:
        return 0.0
    common = slow_common(box, other)
    return common / (box[2] * box[3] + other[2] * other[3] - common)


def any_boxes(most, least=0):
    """Sides of 0 and 1, quarter turns, and many boxes that share sides."""
    numbers = st.integers(0, 4).map(float) | st.integers(0, 4000).map(lambda k: k / 1000)
    angles = st.integers(-4, 4).map(lambda k: k * math.pi / 4) | st.floats(-7, 7)
    one = st.tuples(numbers, numbers, numbers, numbers, angles)
    return st.lists(one, min_size=least, max_size=most).map(
        lambda rows: np.array(rows, float).reshape(-1, 5)
    )


@given(any_boxes(4), any_boxes(4))
@example(np.array([[1.0, 1, 2, 2, 0]]), np.array([[1.0, 1, 2, 2, math.pi / 2]]))  # the same
@example(np.array([[1.0, 1, 2, 2, 0]]), np.array([[3.0, 1, 2, 2, math.pi]]))  # they touch
@example(np.array([[np.nan] * 5, [np.inf, 1, 1, 1, 0]]), np.array([[1.0, 1, 0, 4, 1], [1] * 5]))
def test_the_overlap_of_any_turned_boxes(table, others):
    found = boxes.iou(table, others)
    want = [[slow_iou(box, other) for other in others] for box in table]
    np.testing.assert_allclose(found, np.reshape(want, found.shape), atol=1e-6)
    assert (found >= 0).all() and (found <= 1).all()


def test_the_overlap_is_that_of_opencv():
    rng = np.random.default_rng(0)
    table, others = (
        np.concatenate((rng.uniform(0, 9, (300, 2)), rng.uniform(0, 8, (300, 2)),
                        rng.uniform(-4, 4, (300, 1))), 1) for _ in range(2)
    )  # fmt: skip
    found = np.diagonal(boxes.iou(table, others))
    for box, other, share in zip(table, others, found, strict=True):
        given = [(tuple(b[:2]), tuple(b[2:4]), math.degrees(b[4])) for b in (box, other)]
        _, points = cv2.rotatedRectangleIntersection(*given)
        common = 0.0 if points is None else cv2.contourArea(cv2.convexHull(points))
        areas = box[2] * box[3] + other[2] * other[3]
        assert share == pytest.approx(common / (areas - common), abs=2e-3)  # in float32
    assert (found > 0).sum() > 100


def test_upright_boxes_are_turned_by_nothing():
    rng = np.random.default_rng(1)
    low = rng.uniform(0, 20, (30, 2))
    table = np.concatenate((low, low + rng.uniform(0, 9, (30, 2))), 1)
    turned = boxes.turned(table)
    assert turned.shape == (30, 5) and boxes.turned(turned) is not table
    want = boxes.iou(table, table)
    for a, b in ((turned, turned), (table, turned), (turned, table)):
        np.testing.assert_allclose(boxes.iou(a, b), want, atol=1e-12)
    scores, labels = rng.random(30), np.zeros(30)
    want = boxes.merge(table, scores, labels)
    assert boxes.merge(turned, scores, labels).tolist() == want.tolist()
    np.testing.assert_allclose(boxes.corners(table), boxes.corners(turned))
    np.testing.assert_allclose(boxes.corners([[1, 2, 4, 8]])[0], [[1, 2], [4, 2], [4, 8], [1, 8]])
    turned[:, 4] = rng.uniform(-4, 4, 30)
    rows = [[(corner.real, corner.imag) for corner in corners_of(box)] for box in turned]
    np.testing.assert_allclose(boxes.corners(turned), rows, atol=1e-12)


@given(any_boxes(12), st.sampled_from([0.0, 0.3, 0.5, 1.0]), st.sampled_from([0.0, 0.7, 1.0]))
def test_merging_is_the_rule_box_by_box(table, iou, inside):
    table = np.round(table, 2)  # so that no overlap is a limit but for rounding
    scores, kept = np.arange(len(table))[::-1] / 16, []
    for k, box in enumerate(table):
        area = box[2] * box[3]
        shares = [(slow_iou(box, table[j]), area and slow_common(box, table[j]) / area)
                  for j in kept]  # fmt: skip
        if any(abs(a - iou) < 1e-9 or abs(b - inside) < 1e-9 for a, b in shares if a):
            return  # a tie
        if not any(a > iou or (a and b > inside) for a, b in shares):
            kept.append(k)
    found = boxes.merge(table, scores, np.zeros(len(table)), iou=iou, inside=inside)
    assert found.tolist() == kept


def test_a_part_stays_if_nothing_is_inside_enough():
    """`inside=1` is never exceeded, whatever the rounding."""
    rng = np.random.default_rng(2)
    large = np.tile([0.0, 0, 40, 40, 0.3], (500, 1))
    small = np.concatenate((rng.uniform(-9, 9, (500, 2)), rng.uniform(1, 9, (500, 2)),
                            rng.uniform(-3, 3, (500, 1))), 1)  # fmt: skip
    for pair in np.stack((large, small), 1):
        assert boxes.merge(pair, [0.9, 0.8], [0, 0], iou=1, inside=1).tolist() == [0, 1]
        assert boxes.merge(pair, [0.9, 0.8], [0, 0]).tolist() == [0]


# -- carrying -----------------------------------------------------------------------------------


def is_the_same_box(box, other, atol=1e-6):
    """Whether each corner of a box is one of the other."""
    gaps = np.abs(np.subtract.outer(corners_of(box), corners_of(other)))
    return (gaps.min(0) < atol).all() and (gaps.min(1) < atol).all()


@given(any_boxes(3), st.floats(-4, 4), st.floats(0.2, 5), st.booleans())
def test_a_turned_picture_turns_boxes(table, angle, scale, mirrored):
    turn = scale * complex(math.cos(angle), math.sin(angle))

    def move(points):
        z = (points + 0.5) @ [1, 1j]
        z = (z.conj() if mirrored else z) * turn + (3 - 2j)
        return np.stack((z.real, z.imag), -1) - 0.5

    carried, visible = boxes.carry(table, move)
    assert carried.shape == table.shape and (visible == 1).all()
    for (x, y, w, h, own), found in zip(table, carried, strict=True):
        middle = complex(x, -y if mirrored else y) * turn + (3 - 2j)
        known = (
            middle.real,
            middle.imag,
            scale * w,
            scale * h,
            (-own if mirrored else own) + angle,
        )
        assert is_the_same_box(found, known, 1e-4)
        np.testing.assert_allclose(found[:4], known[:4], atol=1e-4)
        if w > 0.01 and (h == 0 or abs(w - h) < 1e-9 or abs(w - h) > 1e-2):  # which way w looks
            assert math.cos(found[4] - known[4]) == pytest.approx(1, abs=1e-4)


def test_an_affine_map_is_exact():
    """The inverse brings the very boxes back, since ellipses become ellipses."""
    matrix = np.array([[1.3, 0.4], [-0.2, 0.8]])
    table = np.array([[3.0, 4, 30, 10, 0.4], [-5.0, 2, 8, 20, -1.0], [0, 0, 6, 9, 2.5]])
    there, _ = boxes.carry(table, lambda p: (p + 0.5) @ matrix.T - 0.5)
    back, _ = boxes.carry(there, lambda p: (p + 0.5) @ np.linalg.inv(matrix).T - 0.5)
    np.testing.assert_allclose(back, table, atol=2e-3)
    for box, found in zip(table, there, strict=True):
        cos, sin = math.cos(box[4]), math.sin(box[4])
        axes = matrix @ [[cos, -sin], [sin, cos]] @ np.diag(box[2:4] / 2)
        values, vectors = np.linalg.eigh(axes @ axes.T)
        longer, along = 2 * math.sqrt(values[1]), vectors[:, 1]
        assert found[2:4].max() == pytest.approx(longer, rel=1e-5)
        assert found[2] * found[3] == pytest.approx(box[2] * box[3] * np.linalg.det(matrix), 1e-4)
        of_longer = found[4] + (math.pi / 2 if found[3] > found[2] else 0)
        assert abs(along @ (math.cos(of_longer), math.sin(of_longer))) == pytest.approx(1, abs=1e-6)
        assert abs(found[4] - box[4]) < 0.7  # w stays w


def test_boxes_under_a_ceiling_are_along_the_radius():
    """An upright box of a panorama, in the picture of a camera that looks straight down."""
    lens = Equidistant.from_fov(math.radians(180), 256, image_size=(512, 512))
    remap = make_view("panorama", (288, 864), up=(0, 0, -1)).at(lens, (512, 512))
    x = np.arange(30, 800, 70.0)
    upright = np.stack((x, 0 * x + 150, x + 24, 0 * x + 220), 1)
    upright = upright[np.abs(upright[:, 0] - 420) > 0]
    carried, visible, rays = remap.boxes_to_image(boxes.turned(upright))
    np.testing.assert_allclose(visible, 1)
    middle = (carried[:, :2] - 256) @ [1, 1j]
    aside = np.exp(1j * carried[:, 4]) * middle.conj() / np.abs(middle)
    assert np.abs(aside.real).max() < 1e-3  # w is at right angles to the radius
    assert (carried[:, 3] > 1.5 * carried[:, 2]).all()
    ellipse = np.linspace(0, 2 * np.pi, 2000)
    circle = np.stack((np.cos(ellipse), np.sin(ellipse)), -1)
    half = (upright[:, None, 2:] - upright[:, None, :2]) / 2
    points = remap.to_image(upright[:, None, :2] + half + half * circle - 0.5) + 0.5
    for box, outline in zip(carried, points, strict=True):  # it touches all four sides
        turn = np.exp(-1j * box[4])
        there = ((outline - box[:2]) @ [1, 1j]) * turn
        assert there.real.max() == pytest.approx(box[2] / 2, abs=0.02) == -there.real.min()
        assert there.imag.max() == pytest.approx(box[3] / 2, abs=0.02) == -there.imag.min()
    whole, _, others = remap.boxes_to_image(upright)
    np.testing.assert_allclose(rays, others, atol=1e-9)
    assert (carried[:, 2] * carried[:, 3] < 1.01 * np.prod(whole[:, 2:] - whole[:, :2], 1)).all()


def test_a_box_that_is_cut_keeps_its_angle():
    """A box across the border of the new picture becomes that of what is left of its ellipse."""
    box = np.array([[2.0, 10, 20, 8, 0.5]])
    ((x, y, w, h, angle),), (share,) = boxes.carry(box, same, (40, 40))
    radius = np.sqrt((np.arange(300) + 0.5) / 300)[:, None]
    z = radius * np.exp(1j * np.linspace(0, 2 * np.pi, 3000))
    z = (10 * z.real + 4j * z.imag) * np.exp(0.5j) + (2 + 10j)
    seen = z[z.real >= 0]
    assert share == pytest.approx(len(seen) / z.size, abs=2e-3)
    assert angle == pytest.approx(0.5, abs=1e-6)
    there = (seen - complex(x, y)) * np.exp(-0.5j)
    assert there.real.max() == pytest.approx(w / 2, abs=0.05) == -there.real.min()
    assert there.imag.max() == pytest.approx(h / 2, abs=0.05) == -there.imag.min()


@given(
    arrays(
        np.float64,
        st.tuples(st.integers(0, 3), st.just(5)),
        elements=st.floats(-50, 50) | st.sampled_from([0.0, 1.0, np.nan, np.inf]),
    )
)
def test_any_turned_boxes_are_carried(table):
    for points_map in (same, nothing):
        carried, visible = boxes.carry(table, points_map)
        lost = ~np.isfinite(table).all(1) | (points_map is nothing)
        np.testing.assert_array_equal(np.isnan(carried).all(1), lost)
        np.testing.assert_array_equal(visible, np.where(lost, 0, 1))
    carried, visible = boxes.carry(table, same, (20, 30))
    assert (np.isnan(carried).any(1) == np.isnan(carried).all(1)).all()
    assert ((visible > 0) <= ~np.isnan(carried).any(1)).all()
    assert boxes.spherical(table, lambda p: np.insert(p, 2, 60, -1)).ray.shape == (len(table), 3)


def test_tensors_give_tensors():
    table = torch.tensor([[4.0, 4, 8, 4, 0.5]], requires_grad=True)
    carried, _ = boxes.carry(table, same)
    torch.testing.assert_close(carried, table.detach())
    assert boxes.iou(table, table).item() == pytest.approx(1) and boxes.merge(
        table, torch.tensor([0.5]), torch.tensor([1])
    ).tolist() == [0]
    assert boxes.corners(table).shape == (1, 4, 2) and boxes.turned(table).dtype == table.dtype
    with pytest.raises(ValueError, match=r"shape \(K, 4\) or \(K, 5\), got \(1, 6\)"):
        boxes.iou(table, torch.zeros(1, 6))
    with pytest.raises(ValueError, match=r"shape \(K, 4\), got \(1, 5\)"):
        boxes.clip(table, (4, 4))
