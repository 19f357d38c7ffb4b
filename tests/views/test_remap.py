"""Every view of every kind of lens is one map: its points, boxes, labels and pictures agree.

The oracle is a loop over the pixels of the view, by `to_rays` and the lens alone.
"""

import math

import numpy as np
import pytest
import torch
from helpers import product
from hypothesis import given
from hypothesis import strategies as st

from darswin import boxes as of_boxes
from darswin.data.labels.labels import Thing, move_things
from darswin.frames import Sampler
from darswin.lens import BrownConrady, Equidistant, KannalaBrandt, Perspective, Spherical
from darswin.models import LensAdapter
from darswin.views import CameraView, CropView, Turn, list_views, make_view

SIZE = (90, 120)
LENSES = {
    "circle": Equidistant(23.0, 1.9, center=[57.0, 46.0], image_size=SIZE),
    "cut": KannalaBrandt(60.0, [0.01, -0.004], 1.5, center=[61.0, 43.0], image_size=SIZE),
    "oblong": Spherical(0.7, 60.0, 1.4, [58.0, 45.0], affine=[[1, 0.04], [0, 0.85]],
                        image_size=SIZE),
    "tangential": BrownConrady(70.0, [0.02], 0.8, [60.0, 44.0], tangential=[0.01, -0.02],
                               image_size=SIZE),
}  # fmt: skip
OTHER = Spherical.from_fov(0.5, 2.2, 30.0, center=[29.5, 31.0], image_size=(64, 60))
SHEARED = KannalaBrandt(25.0, [0.02], 1.1, affine=[[1, 0.1], [0, 0.9]], image_size=(50, 60))


def view_of(name, size=(40, 40), **options):
    own = {
        "camera": lambda: CameraView(OTHER, turn=Turn(0.4, True), **options),
        "camera of another kind": lambda: CameraView(SHEARED, **options),
        "camera up to 90°": lambda: CameraView(Perspective(25.0, image_size=(50, 60)), **options),
        "crop": lambda: CropView((10, 20, 71, 83), (34, 45)),
        "turned crop": lambda: CropView((10, 20, 71, 83), (34, 45), Turn(-0.6, True)),
        "none": lambda: make_view("none", SIZE),
    }
    if name in own:
        return own[name]()
    return make_view(name, size, **options)


VIEWS = [*sorted(set(list_views()) - {"polar"}), "camera", "camera of another kind", "crop",
         "camera up to 90°", "turned crop"]  # fmt: skip
pairs = pytest.mark.parametrize(("name", "kind"), product(VIEWS, LENSES))


def by_loops(remap, supersampling=1):
    """The points of the picture that the pixels of a view show, (k·H', k·W', 2), from rays."""
    height, width = remap.view_size
    y, x = (
        (np.arange(side * supersampling) + 0.5) / supersampling - 0.5 for side in (height, width)
    )
    grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))[None]
    if isinstance(remap.view, CropView) or not remap.view.uses_lens:
        return remap.view.to_image(grid, remap.lens, remap.size)[0].numpy()
    rays = remap.view.to_rays(grid, remap.lens, remap.size)
    return remap.lens.project_points(rays, remap.size)[0].numpy()


def read(picture, points):
    """Bilinear, with 0 outside."""
    height, width = picture.shape[:2]
    padded = np.zeros((height + 2, width + 2, picture.shape[2]))
    padded[1:-1, 1:-1] = picture
    x, y = np.moveaxis(points, -1, 0) + 1
    inside = (x > 0) & (x < width + 1) & (y > 0) & (y < height + 1)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    i, j = np.floor(y).astype(int).clip(0, height), np.floor(x).astype(int).clip(0, width)
    a, b = (y - i)[..., None], (x - j)[..., None]
    found = (1 - a) * ((1 - b) * padded[i, j] + b * padded[i, j + 1])
    found += a * ((1 - b) * padded[i + 1, j] + b * padded[i + 1, j + 1])
    return np.where(inside[..., None], found, 0)


@pairs
def test_points_and_their_inverse(name, kind):
    lens = LENSES[kind]
    for remap in view_of(name).at(lens, SIZE).tiles:
        points = by_loops(remap)
        sides = np.array(SIZE[::-1])
        inside = ((points >= -0.499) & (points <= sides - 0.501)).all(-1)
        y, x = np.mgrid[: remap.view_size[0], : remap.view_size[1]]
        pixels = np.stack((x, y), -1).astype(float)
        found = remap.to_image(pixels)
        np.testing.assert_allclose(found[inside], points[inside], atol=1e-4)
        outside = ~((points >= -0.502) & (points <= sides - 0.498)).all(-1)
        assert np.isnan(found[outside]).all()
        back = remap.to_view(found[inside])
        known = ~np.isnan(back).any(-1)  # all but the rim
        np.testing.assert_allclose(back[known], pixels[inside][known], atol=2e-3)
        assert known.mean() > 0.98 or not inside.any()
        as_tensors = remap.to_image(torch.from_numpy(pixels))
        np.testing.assert_array_equal(as_tensors.numpy(), found)
        for move in (remap.to_image, remap.to_view, remap.rays):
            one, all_of_them = move(pixels[20, 15]), move(pixels)
            np.testing.assert_allclose(one, all_of_them[20, 15], rtol=0, atol=1e-9)
            ends = torch.tensor([[12.0, 11], [500, 500]], requires_grad=True)
            moved = move(ends)
            torch.nan_to_num(moved).sum().backward()
            assert ends.grad.isfinite().all()
            assert (ends.grad.any(-1) != moved.isnan().any(-1)).all()


@pairs
def test_pictures_are_those_of_loops_the_sampler_and_torch(name, kind):
    lens, view = LENSES[kind], view_of(name)
    remap = view.at(lens, SIZE)
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    reads = remap.points.shape[1] // remap.view_size[1]
    expected = np.stack([
        read(picture, by_loops(tile, reads))
        .reshape(tile.view_size[0], reads, tile.view_size[1], reads, 3).mean((1, 3))
        for tile in remap.tiles
    ])  # fmt: skip
    sampled = remap.sampler()(picture).reshape(expected.shape)
    assert sampled.dtype == np.uint8
    rim = 1.5 if "camera" not in name else 60  # tables of the radius end at the rim
    error = np.abs(sampled - expected)
    assert error.max() <= rim and np.quantile(error, 0.99) <= 1.5
    found = remap.sampled(picture)
    assert found.shape == ((view.count,) if view.count > 1 else ()) + (*remap.view_size, 3)
    assert np.abs(found.reshape(expected.shape).astype(int) - sampled).max() <= 1
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None].double().requires_grad_()
    seen = remap(planes)
    assert seen.shape == (view.count, 3, *remap.view_size)
    error = np.abs(seen.detach().permute(0, 2, 3, 1).numpy() - expected)
    assert error.max() <= rim and np.quantile(error, 0.99) < 0.5
    seen.sum().backward()
    assert planes.grad.abs().sum() > 0
    grey = remap(picture[..., 0])
    np.testing.assert_array_equal(grey, remap(picture[..., :1])[..., 0])
    exact = remap(picture[..., :2].astype(np.float32))
    assert exact.dtype == np.float32 and np.abs(exact - remap(picture)[..., :2]).max() <= 1.01


@pairs
def test_a_uniform_picture_stays_uniform_inside_and_is_black_outside(name, kind):
    remap = view_of(name).at(LENSES[kind], SIZE)
    found = remap(np.full((*SIZE, 1), 200, np.uint8)).reshape(-1, *remap.view_size)
    for picture, tile in zip(found, remap.tiles, strict=True):
        points = by_loops(tile)
        known = ~np.isnan(points).any(-1)
        inner = known & ((points >= 4) & (points <= np.array(SIZE[::-1]) - 5)).all(-1)
        # Not beside what the lens does not show.
        inner[1:-1, 1:-1] &= known[:-2, 1:-1] & known[2:, 1:-1] & known[1:-1, :-2] & known[1:-1, 2:]
        inner[[0, -1]] = inner[:, [0, -1]] = False
        assert (picture[inner] == 200).all()
        far = known & ((points < -15) | (points > np.array(SIZE[::-1]) + 14)).any(-1)
        assert not picture[far].any()


@pairs
def test_targets_take_the_nearest_value(name, kind):
    remap = view_of(name).at(LENSES[kind], SIZE)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    for tile in remap.tiles:
        points = by_loops(tile)
        column, row = (np.asarray(tile.target(values)) for values in
                       (x.astype(np.uint8), y.astype(np.float32) + 1))  # fmt: skip
        assert column.dtype == np.uint8 and row.dtype == np.float32
        near = np.abs(points - np.floor(points) - 0.5) > 0.02  # not halfway between two pixels
        inside = ((points > -0.48) & (points < np.array(SIZE[::-1]) - 0.52)).all(-1)
        inside &= near.all(-1) & (row > 0)
        np.testing.assert_array_equal(column[inside], np.rint(points[inside, 0]))
        np.testing.assert_array_equal(row[inside], np.rint(points[inside, 1]) + 1)
        outside = ~((points > -0.52) & (points < np.array(SIZE[::-1]) - 0.48)).all(-1)
        assert (column[outside] == 255).all() and not row[outside].any()
        assert inside.any() or name == "tiles"


@pairs
def test_one_box_has_one_answer(name, kind):
    """The box of a thing, by `boxes_to_image`, a `LensAdapter`, and 100,000 points of its ellipse;
    and back into the view, as `darswin warp` moves it."""
    lens, view = LENSES[kind], view_of(name)
    remap = view.at(lens, SIZE)
    table = np.array([[6.0, 8, 22, 19], [-4, 5, 12, 30], [25, 20, 60, 60], [9, 9, 9, 12]])
    angle = np.linspace(0, 2 * math.pi, 100_000, endpoint=False)
    circle = np.stack((np.cos(angle), np.sin(angle)), -1)
    for tile in remap.tiles:
        found = tile.boxes_to_image(table)
        again = tile.boxes_to_image(torch.from_numpy(table).float())
        np.testing.assert_allclose(again.boxes, found.boxes, rtol=0, atol=1e-4)
        assert found.visible[3] == 0 and np.isnan(found.boxes[3]).all()
        for box, moved, share in zip(of_boxes.clip(table, tile.view_size), *found[:2], strict=True):
            middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2
            points = tile.to_image(middle + half * circle - 0.5) + 0.5
            if np.isfinite(points).all() and share == 1:
                exact = np.concatenate((points.min(0), points.max(0)))
                np.testing.assert_allclose(moved, exact, atol=0.02)
    if view.count > 1:
        return

    class Finds(torch.nn.Module):
        def forward(self, x):
            boxes = torch.from_numpy(table).float()
            return dict(boxes=boxes, scores=torch.ones(4), labels=torch.zeros(4).long())

    (by_adapter,) = LensAdapter(Finds(), view=view)(torch.zeros(1, 3, *SIZE), lens)
    seen = found.visible > 0
    np.testing.assert_allclose(by_adapter["boxes"], found.boxes[seen], atol=0.02)
    np.testing.assert_allclose(by_adapter["visible"], found.visible[seen], atol=1e-3)
    if view.uses_lens:
        rays = remap.rays((table[:3, :2] + table[:3, 2:] - 1) / 2)
        np.testing.assert_allclose(found.rays[0], np.nan_to_num(rays[0]), atol=1e-6)
    inner = np.array([[50.0, 40, 66, 52]])
    there, visible, _ = remap.boxes_to_view(inner)
    (thing,) = move_things([Thing(1, inner[0])], remap)
    np.testing.assert_allclose(thing.box, there[0], atol=0.02)
    assert thing.visible == pytest.approx(visible[0], abs=1e-3)


@pytest.mark.parametrize("name", [*VIEWS, "none"])
def test_arrays_of_any_type_order_and_number_of_channels(name):
    remap = view_of(name).at(LENSES["oblong"], SIZE)
    count = (remap.view.count,) if remap.view.count > 1 else ()
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 200, (*SIZE, 9)).astype(np.float64)
    expected = remap(picture[..., :1])[..., 0]
    for dtype in ("u1", "u2", "f2", "f4", "f8", ">u2", ">f4", ">f8"):
        for channels in (0, 1, 2, 5, 9):
            given = picture[..., :channels].astype(dtype)[::-1, ::-1].copy()[::-1, ::-1]
            found = remap(given)
            assert found.dtype == given.dtype.newbyteorder("=")
            assert found.shape == (*count, *remap.view_size, channels)
            if channels:
                atol = 0.02 if dtype[-1] in "48" else 1.01
                np.testing.assert_allclose(found[..., 0], expected, rtol=0, atol=atol)
    maps = rng.integers(0, 9, (*count, 3, *remap.view_size))
    for dtype in ("u1", "i8", "f2", "f4", ">u2", ">f4", "?"):
        given = maps.astype(dtype)
        back = remap.back(given[..., ::-1].copy()[..., ::-1])
        assert back.dtype == given.dtype.newbyteorder("=") and back.shape == (3, *SIZE)
        tensors = torch.from_numpy(given.astype(back.dtype).reshape(-1, 3, *remap.view_size))
        np.testing.assert_array_equal(back, remap.back(tensors)[0])
        assert remap.back(given[..., :0, :, :]).shape == (0, *SIZE)
        labels = picture[..., 0].astype(dtype)
        found = remap.target(labels)
        assert found.dtype == labels.dtype.newbyteorder("=")
        tiles = [tile.target(labels.astype(found.dtype)) for tile in remap.tiles]
        np.testing.assert_array_equal(found, np.reshape(tiles, found.shape))
        assert found.shape == (*count, *remap.view_size)


@pytest.mark.parametrize("name", sorted(set(list_views()) - {"polar", "none"}))
@given(st.data())
def test_any_sizes_from_one_pixel_up(name, data):
    side = st.integers(1, 9)
    size = data.draw(st.tuples(side, side))
    shape = data.draw(side.map(lambda s: (s, s)) if name == "square" else st.tuples(side, side))
    lens = Equidistant(max(size) / 2.0, 1.2, image_size=size)
    remap = make_view(name, shape).at(lens, size)
    channels = data.draw(st.integers(1, 4))
    picture = np.full((*size, channels), 9, np.uint8)
    try:
        found = remap(picture)
    except ValueError as error:  # one pixel may show none of those of the picture
        assert "sees nothing of the lens" in str(error)
        return
    assert found.shape[-3:] == (*shape, channels) and found.max() <= 9
    for tile in remap.tiles:
        assert tile.target(picture[..., 0]).shape == shape
        assert tile.boxes_to_image(np.zeros((0, 4))).boxes.shape == (0, 4)
        assert tile.to_view(np.zeros((0, 2))).shape == (0, 2)
    assert remap.shown.shape == size
    assert remap.back(np.ones((view_count(remap), 2, *shape), np.float32)).shape == (2, *size)


@pytest.mark.parametrize("name", VIEWS)
def test_no_pictures_of_no_lenses(name):
    view, lens = view_of(name), LENSES["oblong"]
    for lenses in (lens, lens[:0]):
        assert view(torch.zeros(0, 3, *SIZE), lenses).shape == (
            0,
            3,
            *view.at(lens, SIZE).view_size,
        )


def view_count(remap):
    return len(remap.tiles)


def test_a_remap_is_of_one_lens_and_one_size():
    view = make_view("mercator", (8, 8))
    with pytest.raises(ValueError, match="one lens, got 2"):
        view.at(Equidistant([9.0, 9.0], 1.2), SIZE)
    with pytest.raises(TypeError, match=r"lens must be a darswin.lens.Lens, got NoneType"):
        view.at(None, SIZE)
    remap = view.at(LENSES["cut"], SIZE)
    for picture, kind, message in (
        (np.zeros((9, 9), np.uint8), ValueError, r"the picture must be \(H, W\) = \(90, 120\)"),
        (torch.zeros(1, 3, 9, 9), ValueError, r"picture must be .*, got \(9, 9\)"),
        (torch.zeros(3, *SIZE), ValueError, r"shape \(B, C, H, W\), .* pass images\[None\]"),
        ([[1, 2]], TypeError, "the picture must be an array or a tensor, got list"),
    ):
        with pytest.raises(kind, match=message):
            remap(picture)
    with pytest.raises(ValueError, match=r"target must be .*, got \(90, 120, 3\)"):
        remap.target(np.zeros((*SIZE, 3), np.uint8))
    for maps, form in (
        (np.zeros((8, 8)), r"\(K, h, w\)"),
        (torch.zeros(1, 8, 8), r"\(B, K, h, w\)"),
    ):
        with pytest.raises(ValueError, match=f"maps must have shape {form}, got"):
            remap.back(maps)
    with pytest.raises(ValueError, match="belong to one tile"):
        make_view("tiles", (8, 8)).at(LENSES["cut"], SIZE).boxes_to_view(np.ones((1, 4)))
    with pytest.raises(TypeError, match="rays need the lens"):
        make_view("none", None).at(None, SIZE).rays(np.zeros((1, 2)))
    with pytest.raises(ValueError, match="mean and the std"):
        make_view("mercator", (8, 8), mean=None, std=None).at(LENSES["cut"], SIZE).plan("image")


def test_frames_with_the_channels_last_are_seen_as_those_with_the_channels_first():
    remap = make_view("mercator", (8, 8)).at(LENSES["cut"], SIZE)
    frames = torch.randint(256, (2, *SIZE, 3), dtype=torch.uint8)
    torch.testing.assert_close(remap(frames), remap(frames.permute(0, 3, 1, 2)))


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_crop_beyond_the_picture_is_padded(mirrored):
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    for part in ((-7, 20, 60, 50), (50, -11, 40, 140), (60, 100, 50, 50)):
        crop = CropView(part, part[2:], Turn(mirrored=mirrored))
        turned = picture[:, ::-1] if mirrored else picture
        padded = np.pad(turned, ((50, 50), (50, 50), (0, 0)))
        top, left, height, width = part[0] + 50, part[1] + 50, *part[2:]
        wanted = padded[top : top + height, left : left + width]
        np.testing.assert_array_equal(crop.at(LENSES["cut"], SIZE)(picture), wanted)


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: CropView((0, 0, 9), (5, 5)), TypeError, r"four ints, .*, got \(0, 0, 9\)"),
        (lambda: CropView((0.5, 0, 9, 9), (5, 5)), TypeError, "four ints"),
        (lambda: CropView((0, 0, -9, 9), (5, 5)), ValueError, "height and width of the part"),
        (lambda: CropView((0, 0, 9, 9), (5, 5), 0.3), TypeError, "turn must be .*Turn, got 0.3"),
        (lambda: CameraView(OTHER, turn=0.3), TypeError, "turn must be .*Turn, got 0.3"),
        (lambda: CameraView("front.json"), TypeError, "lens must be a .*Lens, got str"),
    ],
)
def test_wrong_parts_turns_and_lenses_are_refused(make, kind, message):
    with pytest.raises(kind, match=message):
        make()


def test_a_plan_normalizes_as_the_view_says():
    view = make_view("mercator", (16, 20), mean=[0.5, 0.4, 0.3], std=[0.2, 0.3, 0.4])
    remap = view.at(LENSES["cut"], SIZE)
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    found = Sampler(remap.plan("image"))(picture)
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None]
    np.testing.assert_allclose(found, remap(planes)[0], atol=2e-5)
