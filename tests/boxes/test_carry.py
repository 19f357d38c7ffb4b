"""Boxes, points, polygons and masks through maps, against OpenCV, brute force, and algebra."""

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import map_coordinates

from darswin import boxes
from darswin.boxes.carried import cut_polygon
from darswin.data.labels.labels import move_instances
from darswin.lens import Equidistant, KannalaBrandt, Perspective
from darswin.views import CameraView, make_view

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


def test_the_half_pixel():
    """A mirrored picture of 10 px: the pixel 0 becomes the pixel 9, the border 0 the border 10."""

    def mirror(points):
        return np.stack((9 - points[..., 0], points[..., 1]), -1)

    carried, _ = boxes.carry([[0, 0, 4, 2]], mirror)
    np.testing.assert_allclose(carried, [[6, 0, 10, 2]], atol=1e-12)
    np.testing.assert_allclose(boxes.carry_points([[0.5, 0.5]], mirror), [[9.5, 0.5]])


FLAT = Perspective(focal=215.0, theta_max=1.2, image_size=(512, 512))
WIDE = Equidistant(193.0, 1.65, image_size=(240, 640))
NARROW = Equidistant(200.0, 0.6, image_size=(256, 256))
CUT = {
    "border": (FLAT, WIDE, [[164.5, 90, 437.6, 96.5], [20, 20, 300, 300]]),
    "θ_max": (FLAT, NARROW, [[60, 60, 452, 452], [90, 200, 300, 240]]),
    "source": (WIDE, FLAT, [[-300, -50, 200, 100], [450, 60, 640, 200]]),
}


@pytest.mark.parametrize("way", CUT)
def test_a_box_that_is_cut_is_that_of_what_is_left_of_its_ellipse(way):
    """By every point of the ellipse, for bare boxes and for the polygons of their ellipses."""
    own, lens, table = CUT[way]
    to = warped(own, lens)
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
        both = boxes.Instances(np.tile(box, (2, 1)), outlines=[[], [outline]])
        moved = move_instances(both, to)
        assert boxes.iou(found[None], moved.boxes).min() > 0.99
        assert moved.more["visible"] == pytest.approx([share] * 2, abs=2e-3)
        mask = np.zeros(to.view_size, np.uint8)
        outlines = [np.rint((one - 0.5) * 16).astype(np.int32) for one in moved.outlines[1]]
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
    there, back, polygons, rectangles, worst = [], [], [], [], 0.0
    for _ in range(8):
        (old, k_old, d_old), (new, k_new, d_new) = fisheye(rng), fisheye(rng)
        middles = rng.uniform(190, 450, (12, 1, 2))
        shapes = middles + rng.uniform(12, 60, (12, 1, 1)) * outlines(rng, 12)
        flat = shapes.reshape(-1, 1, 2) - 0.5
        flat = cv2.fisheye.undistortPoints(flat, k_old, d_old, criteria=PRECISE)
        exact = cv2.fisheye.distortPoints(flat, k_new, d_new).reshape(shapes.shape) + 0.5
        maps, table = warped(old, new), box_of(shapes)
        worst = max(worst, np.abs(boxes.carry_points(shapes, maps.to_view) - exact).max())
        carried, visible = boxes.carry(table, maps.to_view)
        assert (visible == 1).all()
        there.extend(paired_iou(carried, box_of(exact)))
        back.extend(paired_iou(boxes.carry(carried, maps.to_image)[0], table))
        corners = boxes.carry_points(boxes.corners(table), maps.to_view)
        rectangles.extend(paired_iou(box_of(corners), box_of(exact)))
        # Polygons of 40 corners.
        coarse = [boxes.carry_polygon(shape[::18], maps.to_view) for shape in shapes]
        polygons.extend(paired_iou(np.stack([box_of(one) for one in coarse]), box_of(exact)))
    assert worst < 1e-6
    assert np.mean(there) >= 0.998 and np.mean(polygons) >= 0.98 and np.mean(back) >= 0.98
    assert np.mean(rectangles) < np.mean(there) - 0.002  # what the ellipse is better than


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
    (x, y, w, h), *new = (cv2.boundingRect(of) for of in (mask, found))
    carried, _ = boxes.carry([[x, y, x + w, y + h]], maps.to_view)
    x, y, w, h = new[0]
    assert boxes.iou(carried, [[x, y, x + w, y + h]])[0, 0] > 0.95


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


@given(
    arrays(np.float64, (2, 5), elements=st.floats(0, 4)), st.floats(-4, 4), st.floats(0.2, 5),
    st.booleans(),
)  # fmt: skip
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
        turned = (-own if mirrored else own) + angle
        known = middle.real, middle.imag, scale * w, scale * h, turned
        corners = (boxes.corners([box])[0] @ [1, 1j] for box in (found, known))
        gaps = np.abs(np.subtract.outer(*corners))  # each corner is one of the other box
        assert (gaps.min(0) < 1e-4).all() and (gaps.min(1) < 1e-4).all()
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


numbers = st.floats(-50, 50) | st.sampled_from([0.0, 1.0, np.nan, np.inf])
shapes = st.tuples(st.integers(0, 3), st.sampled_from((4, 5)))


@given(arrays(np.float64, shapes, elements=numbers))
def test_any_boxes_are_carried(table):
    for points_map in (same, nothing):
        carried, visible = boxes.carry(table, points_map)
        assert carried.shape == table.shape and visible.shape == (len(table),)
        lost = ~np.isfinite(table).all(1) | (points_map is nothing)
        np.testing.assert_array_equal(np.isnan(carried).all(1), lost)
        np.testing.assert_array_equal(visible, np.where(lost, 0, 1))
        assert not np.isinf(carried).any()
        if table.shape[1] == 4 and points_map is same:
            ordered = np.sort(table[~lost].reshape(-1, 2, 2), 1).reshape(-1, 4)
            np.testing.assert_allclose(carried[~lost], ordered, atol=1e-9)
    carried, visible = boxes.carry(table, same, (20, 30))
    assert (np.isnan(carried).any(1) == np.isnan(carried).all(1)).all()
    assert ((visible > 0) <= ~np.isnan(carried).any(1)).all()
    assert boxes.spherical(table, lambda p: np.insert(p, 2, 60, -1)).ray.shape == (len(table), 3)
    assert len(boxes.merge(table, np.zeros(len(table)), np.zeros(len(table)))) <= len(table)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("box", [[0.0, 0, 8, 4], [4.0, 4, 8, 4, 0.5]], ids=["upright", "turned"])
def test_tensors_give_tensors_and_arrays_keep_their_precision(box, dtype):
    integers = [list(map(int, box))]
    assert boxes.carry(np.array([box], np.float32), same)[0].dtype == np.float32
    assert boxes.carry(np.array(integers), same)[0].dtype == np.float64
    assert boxes.carry(torch.tensor(integers), same)[0].dtype == torch.float64
    table = torch.tensor([box, [2, 2, 6, 6, 0][: len(box)]], dtype=dtype, requires_grad=True)
    carried, visible = boxes.carry(table, same)
    assert carried.dtype == visible.dtype == dtype
    torch.testing.assert_close(carried, table.detach())
    assert boxes.carry_points(table[:, :2], same).dtype == dtype
    assert boxes.carry_polygon(table[:, :2], same).dtype == dtype
    assert boxes.clip(table[:, :4], (3, 3)).dtype == dtype
    assert boxes.iou(table, table).dtype == dtype and boxes.iou(table, table)[0, 0] == 1
    assert boxes.corners(table).shape == (2, 4, 2)
    assert boxes.corners(table).dtype == boxes.turned(table).dtype == dtype
    kept = boxes.merge(table, torch.tensor([0.5, 0.9], dtype=dtype), torch.tensor([1, 2]))
    assert kept.tolist() == [1, 0] and table[kept].shape == table.shape
    assert boxes.spherical(table, lambda p: np.insert(p, 2, 60, -1)).ray.dtype == dtype
    mask = boxes.carry_mask(torch.ones(3, 4, dtype=torch.bool), same, (5, 5))
    assert mask.dtype == torch.bool and mask.sum() == 12


def test_wrong_shapes_are_named():
    for call, said in (
        (lambda: boxes.carry(np.zeros(4), same), r"have shape \(K, 4\) or \(K, 5\), got \(4,\)"),
        (lambda: boxes.iou(np.ones((1, 4)), torch.zeros(1, 6)), r"or \(K, 5\), got \(1, 6\)"),
        (lambda: boxes.clip(np.zeros((2, 5)), (3, 3)), r"have shape \(K, 4\), got \(2, 5\)"),
        (lambda: boxes.carry_points(np.zeros(3), same), r"\(\.\.\., 2\), got \(3,\)"),
        (lambda: boxes.carry_polygon(np.zeros(6), same), r"\(P, 2\), got \(6,\)"),
        (lambda: boxes.carry_polygon(np.zeros((3, 2)), same, 0), "step must be above 0 px"),
        (lambda: boxes.carry_mask(np.zeros((2, 2, 1)), same, (2, 2)), r"\(H, W\), got \(2, 2, 1"),
        (lambda: boxes.encode_rle(np.zeros(3)), r"\(H, W\), got \(3,\)"),
    ):
        refused(said, call)


@pytest.mark.slow
def test_boxes_need_numpy_alone():
    code = """if True:
        import sys, darswin.boxes, darswin
        darswin.boxes.carry([[0, 0, 1, 1]], lambda p: p)
        assert darswin.boxes.merge([[0, 0, 1, 1]], [0.5], [1]).tolist() == [0]
        assert not {"torch", "cv2"} & set(sys.modules)
    """
    subprocess.run([sys.executable, "-c", code], check=True)
