"""Labels that move with their pictures: the oracle is what the new picture shows."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import drawn

from darswin.boxes import Instances, decode_rle, encode_rle, iou
from darswin.boxes.regions import box_of
from darswin.data import Sample
from darswin.data.labels import Labels, moved
from darswin.data.labels.labels import LEAST_VISIBLE, labelled
from darswin.lens import Equidistant, Perspective, Spherical
from darswin.views import CameraView, CropView, Turn

SIZE = (240, 320)
LENS = Equidistant(110.0, 1.6, center=[158.0, 121.0], image_size=SIZE)
WIDE = Spherical.from_fov(0.8, 2.4, 150.0, image_size=(300, 300))
WAYS = {
    "crop": CropView((20, 50, 200, 230), (200, 230)),
    "smaller": CropView((0, 0, *SIZE), (120, 160)),
    "larger": CropView((40, 60, 160, 200), (400, 500)),
    "oblong": CropView((0, 0, *SIZE), (240, 200)),
    "turned": CropView((0, 0, *SIZE), SIZE, Turn(0.4)),
    "mirrored": CropView((0, 0, *SIZE), SIZE, Turn(0.0, True)),
    "all": CropView((10, 30, 220, 270), (330, 270), Turn(-0.3, True)),
    "other lens": CameraView(WIDE),
    "other lens, turned": CameraView(WIDE, turn=Turn(0.5, True)),
}


def blob(center, radius):
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    around = 1 + 0.2 * np.cos(3 * angle) + 0.1 * np.sin(2 * angle)
    return center + radius * around[:, None] * np.stack((np.cos(angle), np.sin(angle)), -1)


def filled(polygons, size=SIZE):
    """The pixels of which polygons cover more than a half."""
    return (drawn(polygons, size, fine=8) > 127).astype(np.uint8)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("form", ["polygon", "mask", "box"])
def test_labels_follow_the_picture(way, form):
    """The blob is white in a black picture. The new picture shows where it is."""
    outline = blob((150, 115), 40)
    mask = filled([outline])
    shape = dict(polygon={"outline": [outline]}, mask={"mask": encode_rle(mask)}, box={})[form]
    image = np.repeat(mask[..., None] * np.uint8(255), 3, 2)
    labels = Labels(labelled(7, box_of([outline]), **shape), SIZE)
    sample = Sample(image, labels, LENS).through(WAYS[way])
    assert isinstance(sample.target, Labels)
    found, size, lost = sample.target
    assert size == sample.image.shape[:2] and lost == 0 and found.labels.tolist() == [7]
    assert found.more["visible"] == pytest.approx([1], abs=1e-6)
    shown = sample.image[..., 0] > 127
    assert iou(found.boxes, mask_box(shown))[0, 0] > (0.7 if form == "box" else 0.95)
    if form == "box":
        assert not len(found.outlines[0]) and found.masks == [None]
        return
    if form == "mask":
        drawn = decode_rle(found.masks[0])
        np.testing.assert_array_equal(mask_box(drawn), found.boxes)
    else:
        drawn = filled(found.outlines[0], size) > 0
        corners = np.concatenate(found.outlines[0])
        np.testing.assert_allclose(found.boxes[0], [*corners.min(0), *corners.max(0)])
    assert (drawn & shown).sum() / (drawn | shown).sum() > 0.96
    assert found.areas == pytest.approx([shown.sum()], rel=0.03)


def mask_box(mask):
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return np.array([[x, y, x + width, y + height]])


def square(x, y, side=20.0):
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


def cropped(*part):
    return CropView(part, part[2:]).at(LENS, SIZE)


def test_what_leaves_the_picture():
    """Crops of 100 px: squares are cut at the border, and left out below a fifth."""
    outlines = [square(x, 50) for x in (-10, 85, 94, 97, 300)]
    columns = dict(boxes=np.array([box_of([outline]) for outline in outlines]), labels=np.arange(5))
    masks = [encode_rle(filled([np.clip(outline, 0, 319)])) for outline in outlines]
    # A mask ends at the picture.
    for shapes, first in ((dict(outlines=[[o] for o in outlines]), 0.5), (dict(masks=masks), 1.0)):
        squares = Labels(Instances(**columns, **shapes), SIZE, lost=3)
        found, size, lost = moved(squares, cropped(0, 0, 100, 100))
        assert found.labels.tolist() == [0, 1, 2] and lost == 3 + 2 and size == (100, 100)
        assert found.more["visible"] == pytest.approx([first, 0.75, 0.3], abs=0.03)
        assert (found.boxes >= 0).all() and (found.boxes <= 100).all()
    found, *_ = moved(Labels(Instances(**columns), SIZE), cropped(0, 0, 100, 100))
    assert found.labels.tolist() == [0, 1, 2] and LEAST_VISIBLE == 0.2
    assert found.more["visible"][1] == pytest.approx(0.80, abs=0.01)  # of the disc in the square
    np.testing.assert_allclose(found.boxes[1], [85, 50, 100, 70], atol=0.05)


def test_visible_shares_add_up_over_moves():
    whole = labelled(1, box_of([square(40, 40)]), outline=[square(40, 40)])
    once = moved(Labels(whole, SIZE), cropped(0, 0, 240, 50))
    twice = moved(once, cropped(0, 0, 50, 50))
    assert once.instances.more["visible"] == pytest.approx([0.5])
    assert twice.instances.more["visible"] == pytest.approx([0.25])
    assert not len(moved(twice, cropped(0, 0, 44, 50)).instances)


def test_two_parts_and_no_instances():
    whole = labelled(1, np.array([10.0, 10, 80, 30]), outline=[square(10, 10), square(60, 10)])
    found, *_ = moved(Labels(whole, SIZE), cropped(0, 0, 100, 50))
    assert found.more["visible"] == pytest.approx([0.5]) and len(found.outlines[0]) == 1
    assert found.areas == pytest.approx([400])
    none, *rest = moved(Labels(Instances.joined([]), SIZE), cropped(0, 0, 9, 9))
    assert len(none) == len(none.areas) == 0 and rest == [(9, 9), 0]


def test_keypoints():
    points = np.array([[50.0, 60, 2], [150, 60, 1], [0, 0, 0], [70, 70, 2]])
    box, nowhere = np.array([40.0, 50, 160, 80]), [np.nan, np.nan]
    person = Labels(labelled(1, box, keypoints=points, mirror=[1, 0, 2, 3]), SIZE)
    (crop,) = moved(person, cropped(10, 20, 100, 100)).instances.keypoints
    np.testing.assert_allclose(crop, [[30, 50, 2], [*nowhere, 1], [*nowhere, 0], [50, 60, 2]])
    (turned,) = moved(person, WAYS["mirrored"].at(LENS, SIZE)).instances.keypoints
    np.testing.assert_allclose(
        turned, [[170, 60, 1], [270, 60, 2], [*nowhere, 0], [250, 70, 2]], atol=1e-9
    )


def test_boxes_and_keypoints_of_other_forms_move_as_if_they_were_alone():
    alone = labelled(1, np.array([95.0, 15, 125, 35]), mirror=[1, 0, 2])
    box, points = np.array([40.0, 60, 30, 20, 0.5]), np.ones((2, 3))
    turned = labelled(2, box, keypoints=points, mirror=[0, 1])
    for way in ("mirrored", "other lens"):
        remap = WAYS[way].at(LENS, SIZE)
        both, *_ = moved(Labels(Instances.joined([alone, turned]), SIZE), remap)
        assert both.labels.tolist() == [1, 2] and both.boxes[0, 4] == 0 != both.boxes[1, 4]
        expected, *_ = moved(Labels(alone, SIZE), remap)
        np.testing.assert_allclose(both.upright[0], expected.boxes[0])


# A view all around of 100 px: what leaves it on one side is on the other.
SHIFTED = SimpleNamespace(
    view_size=(80, 100),
    mirrored=False,
    to_view=lambda points: np.stack(((points[..., 0] + 30.5) % 100 - 0.5, points[..., 1]), -1),
    target=lambda target: np.roll(target, 30, 1)[:80],
)
# Nothing is seen beyond the column 49.
HALF = SimpleNamespace(
    view_size=(80, 100),
    mirrored=False,
    to_view=lambda points: np.where(points[..., :1] <= 49.5, points, np.nan),
)


@pytest.mark.parametrize("form", ["polygon", "box"])
def test_an_instance_at_the_seam_of_a_view_keeps_its_larger_part(form):
    outline = square(57, 20)
    whole = labelled(1, box_of([outline]), outline=[outline] if form == "polygon" else [])
    found, *_ = moved(Labels(whole, (80, 100)), SHIFTED)
    atol = 4 if form == "polygon" else 1
    np.testing.assert_allclose(found.boxes, [[87, 20, 100, 40]], atol=atol)
    assert found.more["visible"] == pytest.approx([13 / 20], abs=0.1)


def test_an_instance_that_is_partly_unseen():
    outline = square(40, 20)
    whole = labelled(1, box_of([outline]), outline=[outline])
    found, *_ = moved(Labels(whole, (80, 100)), HALF)
    np.testing.assert_allclose(found.boxes, [[40, 20, 50, 40]], atol=2)
    assert found.more["visible"] == pytest.approx([0.5], abs=0.1)
    behind = Instances(np.tile(box_of([square(60, 20)]), (2, 1)))
    none, *rest = moved(Labels(behind, (80, 100)), HALF)
    assert not len(none) and rest == [(80, 100), 2]


@given(st.lists(st.tuples(*[st.floats(-50, 350)] * 4), max_size=4), st.sampled_from(sorted(WAYS)))
def test_any_boxes_move(corners, way):
    table = np.array([[x, y, x + abs(w), y + abs(h)] for x, y, w, h in corners]).reshape(-1, 4)
    found, size, lost = moved(Labels(Instances(table), SIZE), WAYS[way].at(LENS, SIZE))
    low, high, visible = found.boxes[:, :2], found.boxes[:, 2:], found.more["visible"]
    assert len(found) + lost == len(table)
    assert (low >= -1e-9).all() and (high <= size[::-1]).all() and (high >= low).all()
    assert ((visible >= LEAST_VISIBLE) & (visible <= 1 + 1e-9)).all()


@pytest.mark.parametrize("seed", range(5))
def test_polygons_are_cut_at_the_border_like_their_masks(seed):
    rng = np.random.default_rng(seed)
    outline = blob(rng.uniform(40, 200, 2), rng.uniform(30, 90))
    part = (60, 50, 100, 120)
    whole = Labels(labelled(1, box_of([outline]), outline=[outline]), SIZE)
    found, *_ = moved(whole, cropped(*part))
    mask = filled([outline + 200], (700, 700))
    inside = filled([outline])[60:160, 50:170]
    if inside.sum() < 0.15 * mask.sum():
        assert not len(found)
    elif inside.sum() > 0.25 * mask.sum():
        assert found.areas == pytest.approx([inside.sum()], rel=0.05)
        assert found.more["visible"] == pytest.approx([inside.sum() / mask.sum()], abs=0.02)


def test_a_perspective_picture_through_a_fisheye_lens_by_formula():
    """r = f tan θ becomes r = f θ, point by point."""
    own = Perspective.from_fov(math.radians(80), 120.0, image_size=SIZE).with_theta_max(1.0)
    new = Equidistant.from_fov(math.radians(120), 150.0, image_size=(300, 300))
    outline = blob((200, 100), 30)
    whole = Labels(labelled(1, box_of([outline]), outline=[outline]), SIZE)
    found, *_ = moved(whole, CameraView(new).at(own, SIZE))
    flat = (outline - [160, 120]) / own.focal.item()
    radius = np.linalg.norm(flat, axis=1, keepdims=True)
    want = flat / radius * np.arctan(radius) * new.focal.item() + 150
    corners = np.concatenate(found.outlines[0])
    gaps = np.linalg.norm(want[:, None] - corners[None], axis=-1).min(1)
    assert gaps.max() < 1e-3
