"""darswin.boxes, against masks, OpenCV, brute force, and an encoding written from COCO's source."""

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import map_coordinates

import darswin
from darswin import boxes
from darswin.boxes.carried import cut_polygon
from darswin.data.labels.labels import Thing, move_things
from darswin.lens import (
    Equidistant,
    Equisolid,
    KannalaBrandt,
    Mei,
    Perspective,
    Spherical,
    Stereographic,
)
from darswin.views import CameraView

SIZE = (640, 640)


def warped(own, lens):
    return CameraView(lens).at(own, tuple(own.image_size[0].int().tolist()))


PRECISE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-14)


def same(points):
    return points


def nothing(points):
    return np.full(points.shape, np.nan)


def outlines(rng, count):
    """Outlines (count, 720, 2) of things with random shapes, all in a box around (0, 0)."""
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    radius = np.ones((count, 720))
    for k in range(2, 6):
        size, phase = rng.uniform(0, 0.3 / k, (count, 1)), rng.uniform(0, 7, (count, 1))
        radius += size * np.cos(k * angle + phase)
    shape = radius[..., None] * np.stack((np.cos(angle), np.sin(angle)), -1)
    return shape * np.exp(rng.uniform(-0.5, 0.5, (count, 1, 2)))


def box_of(outline):
    return np.concatenate((np.nanmin(outline, -2), np.nanmax(outline, -2)), -1)


def paired_iou(a, b):
    return np.diagonal(boxes.iou(a, b))


# -- carrying -----------------------------------------------------------------------------------


def test_nothing_changes_where_nothing_moves():
    table = np.array([[0.0, 0.0, 10.0, 20.0], [-3.5, 2.25, 7.0, 2.25], [5.0, 5.0, 5.0, 5.0]])
    carried, visible = boxes.carry(table, same)
    np.testing.assert_allclose(carried, table, atol=1e-12)
    assert visible.tolist() == [1, 1, 1]


def test_the_half_pixel():
    """A mirrored picture of 10 px: the pixel 0 becomes the pixel 9, the border 0 the border 10."""

    def mirror(points):
        return np.stack((9 - points[..., 0], points[..., 1]), -1)

    carried, _ = boxes.carry([[0, 0, 4, 2]], mirror)
    np.testing.assert_allclose(carried, [[6, 0, 10, 2]], atol=1e-12)
    np.testing.assert_allclose(boxes.carry_points([[0.5, 0.5]], mirror), [[9.5, 0.5]])
    mask = np.zeros((2, 10), bool)
    mask[:, :4] = True
    carried_mask = boxes.carry_mask(mask, mirror, mask.shape)
    assert np.flatnonzero(carried_mask[0]).tolist() == [6, 7, 8, 9]


def test_an_affine_map_is_exact_for_ellipses():
    """The box of an ellipse after a rotation, by the quadratic form of the ellipse."""
    a, b, turn = 40.0, 25.0, 0.6
    matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    carried, _ = boxes.carry([[-a, -b, a, b]], lambda p: (p + 0.5) @ matrix.T - 0.5)
    half = np.sqrt(np.diag(matrix @ np.diag([a * a, b * b]) @ matrix.T))
    np.testing.assert_allclose(carried, [[*-half, *half]], rtol=2e-3)


def test_the_map_is_called_twice_for_all_boxes():
    calls = []
    boxes.carry(np.tile([0.0, 0, 9, 9], (100, 1)), lambda p: calls.append(p.shape) or p)
    assert calls == [(100, 72, 2), (4, 100, 33, 2)]


def flat_and_wide():
    flat = Perspective(focal=215.0, theta_max=1.2, image_size=(512, 512))
    wide = Equidistant(193.0, 1.65, image_size=(240, 640))
    narrow = Equidistant(200.0, 0.6, image_size=(256, 256))
    return {
        "border": (warped(flat, wide), [[164.5, 90, 437.6, 96.5], [20, 20, 300, 300]]),
        "θ_max": (warped(flat, narrow), [[60, 60, 452, 452], [90, 200, 300, 240]]),
        "source": (warped(wide, flat), [[-300, -50, 200, 100], [450, 60, 640, 200]]),
    }


@pytest.mark.parametrize("way", ["border", "θ_max", "source"])
def test_a_box_that_is_cut_is_that_of_what_is_left_of_its_ellipse(way):
    """By every point of the ellipse, for bare boxes and for the polygons of their ellipses."""
    to, table = flat_and_wide()[way]
    radius = np.sqrt((np.arange(400) + 0.5) / 400)[:, None, None]
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    circle = np.stack((np.cos(angle), np.sin(angle)), -1)
    carried, visible = boxes.carry(table, to.to_view, to.view_size)
    for box, found, share in zip(np.array(table, float), carried, visible, strict=True):
        middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2
        points = to.to_view(middle + radius * half * circle - 0.5) + 0.5
        seen = ((points >= 0) & (points <= to.view_size[::-1])).all(-1)
        assert share == pytest.approx(seen.mean(), abs=2e-3) and 0.01 < share < 0.99
        assert boxes.iou(found[None], box_of(points[seen])[None])[0, 0] > 0.97
        outline = middle + half * circle[::40]
        things = [Thing(1, box), Thing(1, box, [outline])]
        for thing in move_things(things, to):
            assert boxes.iou(found[None], thing.box[None])[0, 0] > 0.99
            assert thing.visible == pytest.approx(share, abs=2e-3)
        mask = np.zeros(to.view_size, np.uint8)
        outlines = [np.rint((one - 0.5) * 16).astype(np.int32) for one in thing.polygons]
        cv2.fillPoly(mask, outlines, 1, shift=4)
        y, x = np.mgrid[: to.view_size[0], : to.view_size[1]].astype(float)
        there = torch.from_numpy(np.stack((x, y), -1))[None]
        there = to.view.to_image(there, to.lens, to.size)[0].numpy()  # also beside the picture
        old = (there + 0.5 - middle) / half
        want = (old**2).sum(-1) <= 1  # not for NaN
        if want.sum() > 2000:  # OpenCV fills the border too
            assert (want & (mask > 0)).sum() / (want | (mask > 0)).sum() > 0.96


def test_the_unseen_part_of_a_box():
    def right_half(points):
        return np.where(points[..., :1] >= 4.5, points, [np.nan, 7.0])  # one coordinate is enough

    carried, visible = boxes.carry([[0, 0, 10, 10], [0, 0, 4, 4], [6, 0, 8, 2]], right_half)
    assert visible[0] == pytest.approx(0.5, abs=0.03) and visible[1:].tolist() == [0, 1]
    np.testing.assert_allclose(carried[0], [5, 0, 10, 10], atol=0.3)
    assert np.isnan(carried[1]).all()
    np.testing.assert_allclose(carried[2], [6, 0, 8, 2], atol=1e-12)
    infinite, visible = boxes.carry([[0, 0, 1, 1]], lambda p: p + np.inf)
    assert np.isnan(infinite).all() and visible == 0


def fisheye(rng, size=SIZE):
    focal = rng.uniform(220, 280)
    coefficients = rng.uniform(-0.02, 0.02, 4) * [1, 0.5, 0.2, 0.1]
    center = [size[1] / 2 + rng.uniform(-20, 20), size[0] / 2 + rng.uniform(-20, 20)]
    matrix = np.array([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]])
    lens = KannalaBrandt(
        torch.tensor(focal, dtype=torch.float64), torch.tensor(coefficients),
        math.radians(85), torch.tensor(center, dtype=torch.float64), image_size=size,
    )  # fmt: skip
    return lens, matrix, coefficients


def test_boxes_and_polygons_agree_with_opencv_through_fisheye_lenses():
    rng = np.random.default_rng(0)
    found, polygons, worst = [], [], 0.0
    for _ in range(8):
        (old, k_old, d_old), (new, k_new, d_new) = fisheye(rng), fisheye(rng)
        middles = rng.uniform(190, 450, (12, 1, 2))
        shapes = middles + rng.uniform(12, 60, (12, 1, 1)) * outlines(rng, 12)
        flat = shapes.reshape(-1, 1, 2) - 0.5
        flat = cv2.fisheye.undistortPoints(flat, k_old, d_old, criteria=PRECISE)
        want = cv2.fisheye.distortPoints(flat, k_new, d_new).reshape(shapes.shape) + 0.5
        to_new = warped(old, new).to_view
        worst = max(worst, np.abs(boxes.carry_points(shapes, to_new) - want).max())
        carried, visible = boxes.carry(box_of(shapes), to_new)
        assert (visible == 1).all()
        found.append(paired_iou(carried, box_of(want)))
        for shape, exact in zip(shapes, want, strict=True):
            carried_polygon = boxes.carry_polygon(shape[::18], to_new)  # 40 corners
            polygons.append(paired_iou(box_of(carried_polygon)[None], box_of(exact)[None]))
    assert worst < 1e-6
    assert np.mean(found) >= 0.98
    assert np.mean(polygons) >= 0.98


def random_lens(rng, fov):
    """A lens of six models with this field of view, not in the middle of its picture."""
    circle, middle = (fov, 300.0), (319.5 + rng.uniform(-9, 9, 2)).tolist()
    terms = rng.uniform(-0.02, 0.02, 2).tolist()
    makes = [
        lambda **rest: Spherical.from_fov(rng.uniform(0.3, 1), *circle, **rest),
        lambda **rest: Mei.from_fov(rng.uniform(0.5, 1), *circle, **rest),
        lambda **rest: KannalaBrandt.from_fov(*circle, radial=terms, **rest),
        lambda **rest: Equidistant.from_fov(*circle, **rest),
        lambda **rest: Equisolid.from_fov(*circle, **rest),
        lambda **rest: Stereographic.from_fov(*circle, **rest),
    ]
    return makes[rng.integers(6)](center=middle, image_size=SIZE).to(torch.float64)


def test_mean_overlap_with_exact_boxes_over_random_lenses():
    """The exact boxes are those of outlines that move point by point."""
    rng = np.random.default_rng(1)
    there, there_and_back, corners, polygons = [], [], [], []
    for _ in range(60):
        fov = math.radians(rng.uniform(100, 200))
        maps = warped(random_lens(rng, fov), random_lens(rng, fov))
        middles = rng.uniform(100, 540, (10, 1, 2))
        shapes = middles + rng.uniform(15, 60, (10, 1, 1)) * outlines(rng, 10)
        exact = boxes.carry_points(shapes, maps.to_view)
        whole = ~np.isnan(exact).any((1, 2))
        shapes, exact = shapes[whole], exact[whole]
        table = box_of(shapes)
        carried, _ = boxes.carry(table, maps.to_view)
        there.extend(paired_iou(carried, box_of(exact)))
        there_and_back.extend(paired_iou(boxes.carry(carried, maps.to_image)[0], table))
        rectangle = table[:, [[0, 1], [2, 1], [2, 3], [0, 3]]]
        corners.extend(
            paired_iou(box_of(boxes.carry_points(rectangle, maps.to_view)), box_of(exact))
        )
        for shape, true in zip(shapes, exact, strict=True):
            coarse = boxes.carry_polygon(shape[::18], maps.to_view)
            polygons.extend(paired_iou(box_of(coarse)[None], box_of(true)[None]))
    assert len(there) > 300
    assert np.mean(there) >= 0.98 and np.mean(there_and_back) >= 0.965
    assert np.mean(polygons) >= 0.98
    assert np.mean(corners) < np.mean(there) - 0.01  # what the ellipse is better than


def test_a_mask_through_a_lens_agrees_with_opencv_pixel_by_pixel():
    """An ellipse, drawn; each new pixel looks it up along its own ray, and boxes follow."""
    rng = np.random.default_rng(2)
    (old, k_old, d_old), (new, k_new, d_new) = fisheye(rng), fisheye(rng)
    mask = cv2.ellipse(np.zeros(SIZE, np.uint8), (250, 380), (70, 40), 20, 0, 360, 1, -1)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    grid = np.stack((x, y), -1)[200:560, 100:500]
    flat = cv2.fisheye.undistortPoints(grid.reshape(-1, 1, 2), k_new, d_new)
    places = cv2.fisheye.distortPoints(flat, k_old, d_old).reshape(grid.shape)
    want = map_coordinates(mask, places[..., ::-1].transpose(2, 0, 1), order=0, cval=0)
    maps = warped(old, new)
    found = boxes.carry_mask(mask, maps.to_image, SIZE)
    assert found.dtype == np.uint8 and found[200:560, 100:500].sum() == found.sum() > 0
    assert (found[200:560, 100:500] != want).sum() <= 2  # ties
    rows, columns = np.nonzero(mask)
    box = [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]
    rows, columns = np.nonzero(found)
    new_box = [[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]]
    assert boxes.iou(boxes.carry(box, maps.to_view)[0], new_box)[0, 0] > 0.95


def test_polygons_are_cut_finely_and_lose_what_is_not_seen():
    square = np.array([[0.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0]])
    cut = cut_polygon(square, 3.0)
    gaps = np.hypot(*(np.roll(cut, -1, 0) - cut).T)
    assert gaps.max() <= 3 and {tuple(p) for p in square} <= {tuple(p) for p in cut}

    def bend(points):  # a circle, by the angle and the radius
        angle, radius = points[..., 0] / 40, points[..., 1] + 20.5
        return np.stack((radius * np.cos(angle), radius * np.sin(angle)), -1)

    bent = boxes.carry_polygon(square, bend, 0.5)
    area = cv2.moments(bent.astype(np.float32))["m00"]
    assert area == pytest.approx((60.0**2 - 20.0**2) / 2, rel=1e-3)  # a sector of 1 rad
    half = boxes.carry_polygon(square, lambda p: np.where(p[..., :1] <= 19.5, p, np.nan), step=1.0)
    assert half[:, 0].max() == 20 and cv2.contourArea(half.astype(np.float32)) == 800
    assert boxes.carry_polygon(square, nothing).shape == (0, 2)
    assert boxes.carry_polygon(np.zeros((0, 2)), same).shape == (0, 2)


# -- merging ------------------------------------------------------------------------------------


def slow_merge(table, scores, labels, iou, inside):
    """The rule in plain Python, box by box."""
    kept = []
    for k in sorted(range(len(table)), key=lambda k: -scores[k]):
        x0, y0, x1, y1 = table[k]
        area = max(x1 - x0, 0) * max(y1 - y0, 0)
        for other in kept:
            a0, b0, a1, b1 = table[other]
            common = max(min(x1, a1) - max(x0, a0), 0) * max(min(y1, b1) - max(y0, b0), 0)
            union = area + max(a1 - a0, 0) * max(b1 - b0, 0) - common
            dropped = common > 0 and (common / union > iou or common / area > inside)
            if labels[k] == labels[other] and dropped:
                break
        else:
            kept.append(k)
    return kept


@given(
    st.integers(0, 40).flatmap(
        lambda n: st.tuples(
            arrays(np.int64, (n, 4), elements=st.integers(0, 12)),
            arrays(np.float64, n, elements=st.sampled_from([0.1, 0.2, 0.5, 0.75])),
            arrays(np.int64, n, elements=st.integers(0, 2)),
        )
    ),
    st.sampled_from([0.0, 0.3, 0.5, 1.0]),
    st.sampled_from([0.0, 0.7, 1.0]),
)
@example((np.zeros((0, 4), int), np.zeros(0), np.zeros(0, int)), 0.5, 0.7)
def test_merging_is_the_rule_box_by_box(detections, iou, inside):
    corners, scores, labels = detections
    table = np.concatenate((corners[:, :2], corners[:, :2] + corners[:, 2:]), 1).astype(float)
    found = boxes.merge(table, scores, labels, iou=iou, inside=inside)
    assert found.tolist() == slow_merge(table.tolist(), scores, labels, iou, inside)


def test_many_boxes_are_merged_in_blocks():
    rng = np.random.default_rng(3)
    low = rng.uniform(0, 300, (1500, 2))
    table = np.concatenate((low, low + rng.uniform(5, 60, (1500, 2))), 1)
    scores, labels = rng.random(1500), rng.integers(0, 3, 1500)
    want = slow_merge(table.tolist(), scores, labels, 0.5, 0.7)
    assert 100 < len(want) < 1400
    assert boxes.merge(table, scores, labels).tolist() == want


def test_a_part_goes_with_the_whole_and_nan_is_left_out():
    table = [[0, 0, 10, 10], [0, 0, 3, 3], [0, 0, 3, 3], [np.nan] * 4, [50, 50, 60, 60]]
    scores, labels = [0.9, 0.8, 0.7, 1.0, np.nan], ["car", "car", "bus", "car", "car"]
    assert boxes.merge(table, scores, labels).tolist() == [0, 2]
    assert boxes.merge([], [], []).tolist() == []
    with pytest.raises(ValueError, match=r"scores must have shape \(5,\), as the boxes, got \(4,"):
        boxes.merge(table, scores[:4], labels)
    with pytest.raises(ValueError, match="iou must be in"):
        boxes.merge(table, scores, labels, iou=50)


def test_overlaps():
    table = np.array([[0.0, 0, 4, 4], [2, 2, 6, 6], [1, 1, 1, 3], [np.nan] * 4])
    found = boxes.iou(table, table)
    want = np.zeros((4, 4))
    want[:2, :2] = [[1, 4 / 28], [4 / 28, 1]]
    np.testing.assert_allclose(found, want)
    assert boxes.iou(table, np.zeros((0, 4))).shape == (4, 0)


def test_boxes_end_at_the_border():
    found = boxes.clip([[-5, 2, 30, 50], [40, -9, 45, -3], [np.nan] * 4], (20, 25))
    np.testing.assert_array_equal(found, [[0, 2, 25, 20], [25, 0, 25, 0], [np.nan] * 4])


# -- on the sphere ------------------------------------------------------------------------------


def camera(points):
    """The rays of a perspective camera of 100 × 80 px with a focal length of 60 px."""
    x, y = points[..., 0] - 49.5, points[..., 1] - 39.5
    return np.stack((x, y, np.full_like(x, 60.0)), -1)


def test_spherical_boxes():
    found = boxes.spherical([[20, 10, 80, 70], [50, 30, 50, 50]], camera)
    assert found.azimuth[0] == pytest.approx(0, abs=1e-9) == found.elevation[0]
    # An ellipse around the axis: the widths are those of its diameters.
    assert found.width[0] == pytest.approx(2 * math.atan(30 / 60))
    assert found.height[0] == pytest.approx(2 * math.atan(30 / 60))
    # The solid angle of a rectangle 2a × 2b at the distance d, on the axis.
    a = b = 30.0
    d2 = 60.0**2
    omega = 4 * math.asin(a * b / math.sqrt((a * a + d2) * (b * b + d2)))
    assert found.solid_angle[0] == pytest.approx(omega)
    np.testing.assert_allclose(found.ray[0], [0, 0, 1], atol=1e-9)
    assert found.width[1] == pytest.approx(0, abs=1e-12) == found.solid_angle[1]


@pytest.mark.parametrize("azimuth", [-2.5, -0.7, 0.0, 1.2, 3.0])
@pytest.mark.parametrize("elevation", [-1.0, 0.0, 0.8])
def test_a_turned_camera_sees_the_same_box_elsewhere(azimuth, elevation):
    """The camera turns by rotations of scipy; the box at its centre keeps its angles."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("YX", [azimuth, elevation])  # y is down: to the right, then up

    def turned(points):
        rays = camera(points)
        return turn.apply(rays.reshape(-1, 3)).reshape(rays.shape)

    found = boxes.spherical([[30.0, 20, 70, 60]], turned)
    assert found.azimuth[0] == pytest.approx(azimuth, abs=1e-6)
    assert found.elevation[0] == pytest.approx(elevation, abs=1e-6)
    assert found.width[0] == pytest.approx(2 * math.atan(1 / 3), rel=1e-6)
    assert found.height[0] == pytest.approx(2 * math.atan(1 / 3), rel=1e-6)
    np.testing.assert_allclose(found.ray[0], turn.apply([0, 0, 1]), atol=1e-6)


def fisheye_rays(points):
    """θ = r / 100 px from the middle of a picture of 600 px, up to 240° across and no farther."""
    plane = (points - 299.5) / 100
    theta = np.linalg.norm(plane, axis=-1, keepdims=True)
    rays = np.concatenate((plane * np.sinc(theta / np.pi), np.cos(theta)), -1)
    return np.where(theta <= math.radians(120.1), rays, np.nan)


def test_spherical_boxes_beyond_180_degrees_and_at_the_rim():
    """What the camera that looks at the middle sees, by every point of the ellipse."""
    wide, high = math.radians(240), math.radians(71)
    sides = 100 * np.array([[wide, high], [high, wide], [wide, wide]])
    found = boxes.spherical(np.concatenate((300 - sides / 2, 300 + sides / 2), 1), fisheye_rays)
    np.testing.assert_allclose(found.width, sides[:, 0] / 100, rtol=1e-6)
    np.testing.assert_allclose(found.height, sides[:, 1] / 100, rtol=1e-6)
    assert np.isnan(found.solid_angle).all() and found.ray[:, 2] == pytest.approx(1)
    rim = np.array([[380.0, 420, 520, 490]])
    found = boxes.spherical(rim, fisheye_rays)
    radius = np.sqrt(np.linspace(0, 1, 300))[:, None]
    angle = np.linspace(0, 2 * np.pi, 3000)
    x, y = 449.5 + radius * 70 * np.cos(angle), 454.5 + radius * 35 * np.sin(angle)
    rays = fisheye_rays(np.stack((x, y), -1))
    rays = rays[np.isfinite(rays[..., 0])]
    assert len(rays) < 0.9 * x.size
    ahead = found.ray[0]
    right = np.cross([0, 1, 0], ahead) / np.linalg.norm(np.cross([0, 1, 0], ahead))
    u, v, z = (rays @ np.stack((right, np.cross(ahead, right), ahead), 1)).T
    scale = np.arctan2(np.hypot(u, v), z) / np.hypot(u, v)
    for side, size in ((u * scale, found.width[0]), (v * scale, found.height[0])):
        assert np.degrees([side.min() + size / 2, side.max() - size / 2]) == pytest.approx(
            [0, 0], abs=0.05
        )


def test_spherical_boxes_of_what_is_not_seen():
    found = boxes.spherical([[0, 0, 9, 9]], lambda p: np.zeros((*p.shape[:-1], 3)))
    assert all(np.isnan(value).all() for value in found)
    assert boxes.spherical([], camera).ray.shape == (0, 3)


# -- COCO's encoding ----------------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ([3, 4], "sum 12, got 7"),
        ([3, -1, 10], "from 0 to 12, got \\["),
        ("04é", "must not contain"),
        ("0o", "ends within a number"),
        ([2**63 - 1, 2**63 - 1, 14], "from 0 to 12, got"),
        ([2**70, 1], "whole numbers, or a text"),
        ([float("inf")], "whole numbers"),
        ([1.5, 10.5], "whole numbers"),
        (["a"], "whole numbers"),
        ([[1], [2, 3]], "whole numbers"),
        ([[12]], "from 0 to 12"),
        ("o" * 40 + "0", "more than 60 bits"),
        ("oooooo0", "at most"),
    ],
)
def test_wrong_run_lengths(counts, said):
    with pytest.raises(ValueError, match=said):
        boxes.decode_rle({"size": [3, 4], "counts": counts})


# -- kinds of arrays and wrong input --------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_tensors_give_tensors(dtype):
    table = torch.tensor([[0.0, 0, 8, 4], [2, 2, 6, 6]], dtype=dtype, requires_grad=True)
    carried, visible = boxes.carry(table, same)
    assert carried.dtype == visible.dtype == dtype
    torch.testing.assert_close(carried, table.detach())
    assert boxes.carry_points(table[:, :2], same).dtype == dtype
    assert boxes.carry_polygon(table[:, :2], same).dtype == dtype
    assert boxes.clip(table, (3, 3)).dtype == boxes.iou(table, table).dtype == dtype
    kept = boxes.merge(table, torch.tensor([0.5, 0.9], dtype=dtype), torch.tensor([1, 2]))
    assert kept.tolist() == [1, 0] and table[kept].shape == (2, 4)
    assert boxes.spherical(table, camera).ray.dtype == dtype
    mask = boxes.carry_mask(torch.ones(3, 4, dtype=torch.bool), same, (5, 5))
    assert mask.dtype == torch.bool and mask.sum() == 12


def test_arrays_keep_their_precision():
    assert boxes.carry(np.zeros((1, 4), np.float32), same)[0].dtype == np.float32
    assert boxes.carry(np.zeros((1, 4), int), same)[0].dtype == np.float64
    assert boxes.carry(torch.zeros(1, 4, dtype=torch.int64), same)[0].dtype == torch.float64


@given(
    arrays(
        np.float64,
        st.tuples(st.integers(0, 3), st.just(4)),
        elements=st.floats(-50, 50) | st.just(np.nan) | st.just(np.inf),
    )
)
def test_any_boxes_are_carried(table):
    for points_map in (same, nothing):
        carried, visible = boxes.carry(table, points_map)
        assert carried.shape == table.shape and visible.shape == (len(table),)
        lost = ~np.isfinite(table).all(1) | (points_map is nothing)
        np.testing.assert_array_equal(np.isnan(carried).all(1), lost)
        np.testing.assert_array_equal(visible, np.where(lost, 0, 1))
        assert not np.isinf(carried).any()
    assert boxes.spherical(table, camera).ray.shape == (len(table), 3)
    assert len(boxes.merge(table, np.zeros(len(table)), np.zeros(len(table)))) <= len(table)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: boxes.carry(np.zeros(4), same), r"have shape \(K, 4\) or \(K, 5\), got \(4,\)"),
        (lambda: boxes.clip(np.zeros((2, 5)), (3, 3)), r"got \(2, 5\)"),
        (lambda: boxes.carry_points(np.zeros(3), same), r"\(\.\.\., 2\), got \(3,\)"),
        (lambda: boxes.carry_polygon(np.zeros(6), same), r"\(P, 2\), got \(6,\)"),
        (lambda: boxes.carry_polygon(np.zeros((3, 2)), same, 0), "step must be above 0 px"),
        (lambda: boxes.carry_mask(np.zeros((2, 2, 1)), same, (2, 2)), r"\(H, W\), got \(2, 2, 1"),
        (lambda: boxes.encode_rle(np.zeros(3)), r"\(H, W\), got \(3,\)"),
    ],
)
def test_wrong_shapes_are_named(call, said):
    with pytest.raises(ValueError, match=said):
        call()


@pytest.mark.slow
def test_boxes_need_numpy_alone():
    code = """if True:
        import sys, darswin.boxes, darswin
        darswin.boxes.carry([[0, 0, 1, 1]], lambda p: p)
        assert darswin.boxes.merge([[0, 0, 1, 1]], [0.5], [1]).tolist() == [0]
        assert not {"torch", "cv2"} & set(sys.modules)
    """
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_package_has_boxes():
    assert darswin.boxes is boxes


@pytest.mark.parametrize(
    "rle",
    [
        {"size": [2, 2]},
        {"counts": [4]},
        {"size": None, "counts": [4]},
        {"size": [2**20, 2**20], "counts": [2**40]},
        {"size": [-2, -2], "counts": [4]},
        {"size": [float("nan"), 2], "counts": [4]},
    ],
)
def test_an_encoding_has_a_size_and_counts(rle):
    with pytest.raises(ValueError, match=r"must have a size \[H, W\] and counts"):
        boxes.decode_rle(rle)
