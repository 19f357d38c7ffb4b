"""Labels that move with their pictures: the oracle is what the new picture shows."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from darswin.boxes import decode_rle, encode_rle, iou
from darswin.data import Sample
from darswin.data.labels import Labels, Thing, moved
from darswin.data.labels.labels import LEAST_VISIBLE
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


def box_of(polygon):
    return np.concatenate((polygon.min(0), polygon.max(0)))


def filled(polygons, size=SIZE, fine=8):
    """The pixels of which polygons cover more than a half, by OpenCV in a finer picture."""
    points = [np.round((p * fine - 0.5) * 16).astype(np.int32) for p in polygons]
    sides = np.array(size) * fine
    mask = cv2.fillPoly(np.zeros(sides, np.uint8), points, 255, shift=4)
    return (cv2.resize(mask, size[::-1], interpolation=cv2.INTER_AREA) > 127).astype(np.uint8)


def mask_box(mask):
    y, x = np.nonzero(mask)
    return np.array([[x.min(), y.min(), x.max() + 1, y.max() + 1]])


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("form", ["polygon", "mask", "box"])
def test_labels_follow_the_picture(way, form):
    """The thing is white in a black picture. The new picture shows where it is."""
    outline = blob((150, 115), 40)
    mask = filled([outline])
    shape = dict(polygon={"polygons": [outline]}, mask={"rle": encode_rle(mask)}, box={})[form]
    image = np.repeat(mask[..., None] * np.uint8(255), 3, 2)
    labels = Labels([Thing(7, box_of(outline), **shape)], SIZE)
    sample = Sample(image, labels, LENS).through(WAYS[way])
    assert isinstance(sample.target, Labels)
    (found,), size, lost = sample.target
    assert size == sample.image.shape[:2] and lost == 0 and found.category == 7
    assert found.visible == pytest.approx(1, abs=1e-6)
    shown = sample.image[..., 0] > 127
    assert iou(found.box[None], mask_box(shown))[0, 0] > (0.7 if form == "box" else 0.95)
    if form == "box":
        assert not len(found.polygons) and found.rle is None
        return
    if form == "mask":
        drawn = decode_rle(found.rle)
        np.testing.assert_array_equal(mask_box(drawn)[0], found.box)
    else:
        drawn = filled(found.polygons, size) > 0
        np.testing.assert_allclose(found.box, box_of(np.concatenate(found.polygons)))
    assert (drawn & shown).sum() / (drawn | shown).sum() > 0.96
    assert found.area == pytest.approx(shown.sum(), rel=0.03)


def square(x, y, side=20.0):
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


def cropped(*part):
    return CropView(part, part[2:]).at(LENS, SIZE)


def test_what_leaves_the_picture():
    """Crops of 100 px: things are cut at the border, and left out below a fifth."""
    outlines = [*enumerate(square(x, 50) for x in (-10, 85, 94, 97, 300))]
    polygons = [Thing(k, box_of(outline), [outline]) for k, outline in outlines]
    boxes = [Thing(k, box_of(outline)) for k, outline in outlines]
    masks = [encode_rle(filled([np.clip(outline, 0, 319)])) for _, outline in outlines]
    masks = [Thing(k, box_of(outline), rle=masks[k]) for k, outline in outlines]
    # A mask ends at the picture.
    for things, first in ((polygons, 0.5), (masks, 1.0)):
        found = moved(Labels(things, SIZE, lost=3), cropped(0, 0, 100, 100))
        visible = {thing.category: round(thing.visible, 2) for thing in found.things}
        assert visible == pytest.approx({0: first, 1: 0.75, 2: 0.3}, abs=0.03)
        assert found.lost == 3 + 2 and found.size == (100, 100)
        for thing in found.things:
            assert (thing.box >= 0).all() and (thing.box <= 100).all()
    found = moved(Labels(boxes, SIZE), cropped(0, 0, 100, 100))
    assert [t.category for t in found.things] == [0, 1, 2] and LEAST_VISIBLE == 0.2
    assert found.things[1].visible == pytest.approx(0.80, abs=0.01)  # of the disc in the square
    np.testing.assert_allclose(found.things[1].box, [85, 50, 100, 70], atol=0.05)


def test_visible_shares_add_up_over_moves():
    thing = Thing(1, box_of(square(40, 40)), [square(40, 40)])
    once = moved(Labels([thing], SIZE), cropped(0, 0, 240, 50))
    twice = moved(once, cropped(0, 0, 50, 50))
    assert once.things[0].visible == pytest.approx(0.5)
    assert twice.things[0].visible == pytest.approx(0.25)
    assert not moved(twice, cropped(0, 0, 44, 50)).things


def test_two_parts_and_no_things():
    whole = Thing(1, np.array([10.0, 10, 80, 30]), [square(10, 10), square(60, 10)])
    (found,) = moved(Labels([whole], SIZE), cropped(0, 0, 100, 50)).things
    assert found.visible == pytest.approx(0.5) and len(found.polygons) == 1
    assert found.area == pytest.approx(400)
    assert moved(Labels([], SIZE), cropped(0, 0, 9, 9)) == Labels([], (9, 9), 0)


def test_keypoints():
    points = np.array([[50.0, 60, 2], [150, 60, 1], [0, 0, 0], [70, 70, 2]])
    person = Thing(1, np.array([40.0, 50, 160, 80]), keypoints=points, mirror=[1, 0, 2, 3])
    (crop,) = moved(Labels([person], SIZE), cropped(10, 20, 100, 100)).things
    np.testing.assert_allclose(crop.keypoints, [[30, 50, 2], [0] * 3, [0] * 3, [50, 60, 2]])
    (turned,) = moved(Labels([person], SIZE), WAYS["mirrored"].at(LENS, SIZE)).things
    np.testing.assert_allclose(
        turned.keypoints, [[170, 60, 1], [270, 60, 2], [0] * 3, [250, 70, 2]], atol=1e-9
    )


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
def test_a_thing_at_the_seam_of_a_view_keeps_its_larger_part(form):
    outline = square(57, 20)
    thing = Thing(1, box_of(outline), [outline] if form == "polygon" else [])
    (found,) = moved(Labels([thing], (80, 100)), SHIFTED).things
    np.testing.assert_allclose(found.box, [87, 20, 100, 40], atol=4 if form == "polygon" else 1)
    assert found.visible == pytest.approx(13 / 20, abs=0.1)


def test_a_thing_that_is_partly_unseen():
    outline = square(40, 20)
    (found,) = moved(Labels([Thing(1, box_of(outline), [outline])], (80, 100)), HALF).things
    np.testing.assert_allclose(found.box, [40, 20, 50, 40], atol=2)
    assert found.visible == pytest.approx(0.5, abs=0.1)
    behind = Thing(1, box_of(square(60, 20)))
    assert moved(Labels([behind, behind], (80, 100)), HALF) == Labels([], (80, 100), 2)


@given(st.lists(st.tuples(*[st.floats(-50, 350)] * 4), max_size=4), st.sampled_from(sorted(WAYS)))
def test_any_boxes_move(corners, way):
    things = [Thing(1, np.array([x, y, x + abs(w), y + abs(h)])) for x, y, w, h in corners]
    found = moved(Labels(things, SIZE), WAYS[way].at(LENS, SIZE))
    assert len(found.things) + found.lost == len(things)
    for thing in found.things:
        assert (thing.box[:2] >= -1e-9).all() and (thing.box[2:] <= found.size[::-1]).all()
        assert (thing.box[2:] >= thing.box[:2]).all()
        assert LEAST_VISIBLE <= thing.visible <= 1 + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_polygons_are_cut_at_the_border_like_their_masks(seed):
    rng = np.random.default_rng(seed)
    outline = blob(rng.uniform(40, 200, 2), rng.uniform(30, 90))
    thing = Thing(1, box_of(outline), [outline])
    part = (60, 50, 100, 120)
    found = moved(Labels([thing], SIZE), cropped(*part)).things
    mask = filled([outline + 200], (700, 700))
    inside = filled([outline])[60:160, 50:170]
    if inside.sum() < 0.15 * mask.sum():
        assert not found
    elif inside.sum() > 0.25 * mask.sum():
        assert found[0].area == pytest.approx(inside.sum(), rel=0.05)
        assert found[0].visible == pytest.approx(inside.sum() / mask.sum(), abs=0.02)


def test_a_perspective_picture_through_a_fisheye_lens_by_formula():
    """r = f tan θ becomes r = f θ, point by point."""
    own = Perspective.from_fov(math.radians(80), 120.0, image_size=SIZE).with_theta_max(1.0)
    new = Equidistant.from_fov(math.radians(120), 150.0, image_size=(300, 300))
    outline = blob((200, 100), 30)
    thing = Thing(1, box_of(outline), [outline])
    (found,) = moved(Labels([thing], SIZE), CameraView(new).at(own, SIZE)).things
    flat = (outline - [160, 120]) / own.focal.item()
    radius = np.linalg.norm(flat, axis=1, keepdims=True)
    want = flat / radius * np.arctan(radius) * new.focal.item() + 150
    corners = np.concatenate(found.polygons)
    gaps = np.linalg.norm(want[:, None] - corners[None], axis=-1).min(1)
    assert gaps.max() < 1e-3
