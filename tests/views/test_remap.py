"""Arrays of any kind and size through the map between a view and pictures, and its errors."""

import numpy as np
import pytest
import torch
from helpers import refused
from hypothesis import given
from hypothesis import strategies as st

from darswin.lens import Equidistant, KannalaBrandt, Spherical
from darswin.views import CameraView, CropView, Turn, list_views, make_view

SIZE = (90, 120)
CUT = KannalaBrandt(60.0, [0.01, -0.004], 1.5, center=[61.0, 43.0], image_size=SIZE)
OTHER = Spherical.from_fov(0.5, 2.2, 30.0, center=[29.5, 31.0], image_size=(64, 60))
OF_PIXELS = sorted(set(list_views()) - {"polar"})
VIEWS = {
    "camera": CameraView(OTHER, turn=Turn(0.4, True)),
    "crop": CropView((10, 20, 71, 83), (34, 45)),
    "crop at its size": CropView((10, 20, 34, 45), (34, 45), Turn(mirrored=True)),
    "turned crop": CropView((10, 20, 71, 83), (34, 45), Turn(-0.6, True)),
} | {name: make_view(name, SIZE if name == "none" else (40, 40)) for name in OF_PIXELS}


@pytest.mark.parametrize("name", VIEWS)
def test_arrays_of_any_type_order_and_number_of_channels(name):
    remap = VIEWS[name].at(CUT, SIZE)
    count = (remap.view.count,) if remap.view.count > 1 else ()
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 200, (*SIZE, 9)).astype(np.float64)
    expected = remap(picture[..., :1])[..., 0]
    for dtype in ("u1", "u2", "f2", "f4", "f8", ">u2", ">f4", ">f8"):
        for channels in (0, 1, 2, 5, 9):
            given = picture[..., :channels].astype(dtype)[::-1, ::-1].copy()[::-1, ::-1]
            seen = remap(given)
            assert seen.dtype == given.dtype.newbyteorder("=")
            assert seen.shape == (*count, *remap.view_size, channels)
            if channels:
                atol = 0.02 if dtype[-1] in "48" else 1.01
                np.testing.assert_allclose(seen[..., 0], expected, rtol=0, atol=atol)
    maps = rng.integers(0, 9, (*count, 3, *remap.view_size))
    for dtype in ("u1", "i8", "f2", "f4", ">u2", ">f4", "?"):
        given = maps.astype(dtype)
        back = remap.back(given[..., ::-1].copy()[..., ::-1])
        assert back.dtype == given.dtype.newbyteorder("=") and back.shape == (3, *SIZE)
        tensors = torch.from_numpy(given.astype(back.dtype).reshape(-1, 3, *remap.view_size))
        np.testing.assert_array_equal(back, remap.back(tensors)[0])
        assert remap.back(given[..., :0, :, :]).shape == (0, *SIZE)
        labels = picture[..., 0].astype(dtype)
        target = remap.target(labels)
        assert target.dtype == labels.dtype.newbyteorder("=")
        tiles = [tile.target(labels.astype(target.dtype)) for tile in remap.tiles]
        np.testing.assert_array_equal(target, np.reshape(tiles, target.shape))
        assert target.shape == (*count, *remap.view_size)
    for lenses in (CUT, CUT[:0]):  # no pictures, of one lens and of none
        assert remap.view(torch.zeros(0, 3, *SIZE), lenses).shape == (0, 3, *remap.view_size)


@pytest.mark.parametrize("name", sorted(set(OF_PIXELS) - {"none"}))
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
        seen = remap(picture)
    except ValueError as error:  # one pixel may show none of those of the picture
        assert "sees nothing of the lens" in str(error)
        return
    assert seen.shape[-3:] == (*shape, channels) and seen.max() <= 9
    for tile in remap.tiles:
        assert tile.target(picture[..., 0]).shape == shape
        assert tile.boxes_to_image(np.zeros((0, 4)))[0].shape == (0, 4)
        assert tile.to_view(np.zeros((0, 2))).shape == (0, 2)
    assert remap.shown.shape == size
    assert remap.back(np.ones((len(remap.tiles), 2, *shape), np.float32)).shape == (2, *size)


def test_pictures_and_maps_that_do_not_fit_are_refused():
    view = make_view("mercator", (8, 8))
    remap, tiles = view.at(CUT, SIZE), make_view("tiles", (8, 8)).at(CUT, SIZE)
    plain, raw = make_view("none", None), make_view("mercator", (8, 8), mean=None, std=None)
    for call, kind, message in (
        (lambda: view.at(CUT[[0, 0]], SIZE), ValueError, "one lens, got 2"),
        (lambda: view.at(None, SIZE), TypeError, r"lens must be a .*Lens, got NoneType"),
        (lambda: view.at(CUT, (240, 320)), ValueError, r"images of \(H, W\) = \(90, 120\)"),
        (lambda: remap(np.zeros((9, 9), np.uint8)), ValueError, r"picture must be .* = \(90, 120"),
        (lambda: remap(torch.zeros(1, 3, 9, 9)), ValueError, r"picture must be .*, got \(9, 9\)"),
        (lambda: remap(torch.zeros(3, *SIZE)), ValueError, r"\(B, C, H, W\), .* pass images\[N"),
        (lambda: remap([[1, 2]]), TypeError, "the picture must be an array or a tensor, got list"),
        (lambda: remap(np.zeros(SIZE, "i4")), TypeError, "int32 would be mixed: remap.target"),
        (lambda: remap(np.zeros(SIZE, ">u8")), TypeError, "of >u8 would be mixed"),
        (lambda: remap.target(np.zeros((*SIZE, 3))), ValueError, r"target must be .*, got \(90"),
        (lambda: remap.back(np.zeros((8, 8))), ValueError, r"have shape \(K, h, w\), got"),
        (lambda: remap.back(torch.zeros(1, 8, 8)), ValueError, r"have shape \(B, K, h, w\), got"),
        (lambda: tiles.boxes_to_view(np.ones((1, 4))), ValueError, "belong to one tile"),
        (lambda: plain.at(None, SIZE).rays(np.zeros((1, 2))), TypeError, "rays need the lens"),
        (lambda: raw.at(CUT, SIZE).plan("image"), ValueError, "mean and the std"),
        (lambda: CropView((0, 0, 9), (5, 5)), TypeError, r"four ints, .*, got \(0, 0, 9\)"),
        (lambda: CropView((0.5, 0, 9, 9), (5, 5)), TypeError, "four ints"),
        (lambda: CropView((0, 0, -9, 9), (5, 5)), ValueError, "height and width of the part"),
        (lambda: CropView((0, 0, 9, 9), (5, 5), 0.3), TypeError, "turn must be .*Turn, got 0.3"),
        (lambda: CameraView(OTHER, turn=0.3), TypeError, "turn must be .*Turn, got 0.3"),
        (lambda: CameraView("front.json"), TypeError, "lens must be a .*Lens, got str"),
    ):
        refused(message, call, error=kind)


@pytest.mark.parametrize("name", ["mercator", "crop", "camera"])
def test_what_is_kept_in_inference_mode_carries_gradients(name):
    points, grads = torch.tensor([[50.0, 41.0]], requires_grad=True), []
    for mode in (False, True):
        with torch.inference_mode(mode):
            remap = VIEWS[name].at(CUT[:1] if mode else CUT, SIZE)
            remap.to_view(points.detach())
        grads += torch.autograd.grad(remap.to_view(points).sum(), points)
    assert torch.equal(*grads) and grads[0].isfinite().all()


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_crop_beyond_the_picture_is_padded(mirrored):
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    turned = picture[:, ::-1] if mirrored else picture
    padded = np.pad(turned, ((50, 50), (50, 50), (0, 0)))
    for part in ((-7, 20, 60, 50), (50, -11, 40, 140), (60, 100, 50, 50)):
        crop = CropView(part, part[2:], Turn(mirrored=mirrored))
        top, left, height, width = part[0] + 50, part[1] + 50, *part[2:]
        wanted = padded[top : top + height, left : left + width]
        np.testing.assert_array_equal(crop.at(CUT, SIZE)(picture), wanted)
