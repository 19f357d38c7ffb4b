"""What holds for every view and every lens: a table of properties × views × lenses.

The oracle of points and pictures is a loop over the pixels of the view, by `to_rays` and the lens
alone; test_rays.py has the formulas of the rays.
"""

import math
from inspect import signature

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from frame_samples import bilinear
from helpers import in_turn, refused
from torch import nn
from torch.testing import assert_close
from torch.utils._pytree import tree_leaves

from darswin import boxes as of_boxes
from darswin import create_model
from darswin.lens import BrownConrady, Equidistant, KannalaBrandt, Perspective, Spherical
from darswin.models import LensAdapter, Swin
from darswin.views import (
    CameraView,
    CropView,
    PixelView,
    PolarView,
    RayView,
    TilesView,
    Turn,
    View,
    list_views,
    make_view,
    register_view,
)
from darswin.views.registry import _VIEWS, view_class

SIZE = (90, 120)
LENSES = {
    "circle": Equidistant(23.0, 1.9, center=[57.0, 46.0], image_size=SIZE),
    "cut": KannalaBrandt(60.0, [0.01, -0.004], 1.5, center=[61.0, 43.0], image_size=SIZE),
    "oblong": Spherical(0.7, 60.0, 1.4, [58.0, 45.0], affine=[[1, 0.04], [0, 0.85]],
                        image_size=SIZE),
    "general": BrownConrady(70.0, [0.02], 0.8, [60.0, 44.0], affine=[[1, 0.02], [0, 0.95]],
                            tangential=[0.01, -0.02], image_size=SIZE),
    "two": Spherical.from_fov([0.2, 0.9], 2.6, 43.0, image_size=SIZE),
}  # fmt: skip
# Views with options of their own, and those that need a lens or a part of the picture.
OPTIONS = {
    "square of g": dict(spacing="g"),
    "square of r": dict(spacing="radius"),
    "perspective up to an angle": dict(reach=0.7),
    "panorama of a ceiling": dict(up=(0, 0, -1)),
}
OTHER = Spherical.from_fov(0.5, 2.2, 30.0, center=[29.5, 31.0], image_size=(64, 60))
SHEARED = KannalaBrandt(25.0, [0.02], 1.1, affine=[[1, 0.1], [0, 0.9]], image_size=(50, 60))
FLAT = Perspective(25.0, image_size=(50, 60))
MADE = {
    "camera": lambda **options: CameraView(OTHER, turn=Turn(0.4, True), **options),
    "camera of another kind": lambda **options: CameraView(SHEARED, **options),
    "camera up to 90°": lambda **options: CameraView(FLAT, **options),
    "crop": lambda **_: CropView((10, 20, 71, 83), (34, 45)),
    "turned crop": lambda **_: CropView((10, 20, 71, 83), (34, 45), Turn(-0.6, True)),
}
NAMED = [*list_views(), *OPTIONS]
OF_PIXELS = [*(name for name in NAMED if name != "polar"), *MADE]
GRID = torch.stack(torch.meshgrid(torch.arange(120.0), torch.arange(90.0), indexing="xy"), -1)[None]
every_view = pytest.mark.parametrize("name", list_views())


def view_of(name, size=(40, 40), **options):
    if name in MADE:
        return MADE[name](**options)
    named = name.split()[0]
    return make_view(named, SIZE if name == "none" else size, **OPTIONS.get(name, {}), **options)


def at_single_points(name, size=(40, 40)):
    """The view, whose pixels are not the means of several points."""
    can_average = name in MADE or "up" in signature(view_class(name.split()[0])).parameters
    return view_of(name, size, **(dict(supersampling=1) if can_average else {}))


def smooth():
    x, y = GRID[0].unbind(-1)
    return torch.stack((torch.sin(x / 25), torch.cos(y / 25), torch.sin((x + y) / 30)))[None]


def by_loops(remap, supersampling=1):
    """The points of the picture that the pixels of a view show, (k·H', k·W', 2), from rays."""
    sides = (side * supersampling for side in remap.view_size)
    y, x = ((np.arange(side) + 0.5) / supersampling - 0.5 for side in sides)
    grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1))[None]
    if isinstance(remap.view, CropView) or not remap.view.uses_lens:
        return remap.view.to_image(grid, remap.lens, remap.size)[0].numpy()
    rays = remap.view.to_rays(grid, remap.lens, remap.size)
    return remap.lens.project_points(rays, remap.size)[0].numpy()


PROPERTIES = []


def property_of(names):
    """Adds a property of the views with these names to the table."""

    def add(holds):
        PROPERTIES.extend((holds, name) for name in names)
        return holds

    return add


@property_of(NAMED)
@torch.no_grad()
def what_is_seen_comes_back_also_from_coarser_maps(name, lens):
    view, images = view_of(name, (192, 192)), smooth().expand(len(lens), -1, -1, -1)
    prepared = view.prepare(lens, SIZE)
    seen = view.see(images, prepared)
    shape = (len(lens) * view.count, 3, 192, 192) if view.uses_lens else images.shape
    assert seen.shape == shape
    assert torch.equal(seen, view(images, lens))
    theta = lens.unproject_pixels(GRID, SIZE)[0]
    # A perspective view ends before 90°, and the picture cuts the views near its border.
    inner = (theta < lens.theta_max[:, None, None].clamp(max=1.4) * 0.9)[:, None]
    inner = inner.expand_as(images) & F.pad(torch.ones(82, 112), (4,) * 4).bool()
    if isinstance(view, RayView | TilesView):  # maps of the sphere end above and below
        height = 192 * view.count
        shown = (prepared.back > 3) & (prepared.back < torch.tensor([188.0, height - 4.0]))
        inner &= shown.all(-1)[:, None]
    assert inner.float().mean() > (0.05 if name.startswith("persp") else 0.2)
    back = view.back(seen, prepared)
    assert back.shape == images.shape and (back - images).abs()[inner].max() < 0.1
    coarse = view.back(F.avg_pool2d(seen, 2), prepared)
    assert coarse.shape == images.shape and (coarse - images).abs()[inner].mean() < 0.05
    beyond = ~lens.sees(theta)[:, None].expand_as(images)
    if view.uses_lens and beyond.any():
        assert not back[beyond].any() and not coarse[beyond].any()
    # Each lens of a batch is that lens alone.
    alone = view.prepare(lens[-1], SIZE)
    assert_close(view.see(images[-1:], alone), seen[-view.count :], atol=2e-4, rtol=1e-4)
    assert_close(view.back(seen[-view.count :], alone), back[-1:], atol=2e-4, rtol=1e-4)


@property_of([name for name in NAMED if name != "none"])
@torch.no_grad()
def a_constant_comes_back_whole_and_ids_stay_ids(name, lens):
    view, lens = view_of(name, (24, 24)), lens[-1]
    prepared = view.prepare(lens, SIZE)
    shown = prepared.shown[0]
    assert shown.float().mean() > 0.05
    for side in (24, 12, 8, 48):
        shape = (view.count, 1, side, side)
        back = view.back(torch.full(shape, 10.0), prepared)[0, 0]
        assert (back[shown] - 10).abs().max() < 1e-4 and not back[~shown].any()
        ids = torch.randint(0, 3, shape) * 2**40 + 7
        back = view.back(ids, prepared)[0, 0]
        assert back.dtype == torch.int64 and set(back[shown].tolist()) == set(ids.unique().tolist())
        assert not back[~shown].any()


@property_of([*NAMED, *MADE])
@torch.no_grad()
def the_rays_of_the_pixels_land_where_the_view_reads(name, lens):
    view = at_single_points(name, (24, 24))
    lens = lens[-1] if name == "turned crop" else lens  # whose camera is that of one lens
    prepared = view.prepare(lens, SIZE)
    rays = view.ray_channels(lens, SIZE).movedim(1, -1)
    landed = rays.norm(dim=-1) > 0.5
    assert_close(rays[landed].norm(dim=-1), torch.ones(int(landed.sum())))
    points = lens.project_points(rays.expand(len(lens), -1, -1, -1), SIZE)
    # Each pixel is marked with its own x and y, so that a view of it shows where it was read.
    marked = GRID.movedim(-1, 1).expand(len(lens), -1, -1, -1)
    seen = view.see(marked, prepared).movedim(1, -1)
    seen = seen.unflatten(0, (-1, view.count)).flatten(1, 2)  # tiles are below each other
    inside = landed & (points > 2).all(-1) & (points < points.new_tensor([117.0, 87.0])).all(-1)
    assert inside.float().mean() > 0.03
    # The ray of a token is that of the radial curve; other distortions of the lens are ignored.
    if not isinstance(view, PolarView) or (lens.is_radial and lens.affine is None):
        assert_close(seen[inside], points[inside], rtol=0, atol=4e-3)


@property_of(list_views())
@torch.no_grad()
def autocast_moves_no_point(name, lens):
    view = view_of(name)

    def points():
        others = view.ray_channels(lens, SIZE), view.token_positions(lens, (4, 8))
        return [x for x in tree_leaves((view.prepare(lens, SIZE), others)) if torch.is_tensor(x)]

    exact = points()
    with torch.autocast("cpu", torch.bfloat16):
        pairs = zip(points(), exact, strict=True)
    for rounded, expected in pairs:
        assert_close(rounded, expected, rtol=0, atol=0, equal_nan=True)


@property_of(OF_PIXELS)
def points_go_to_the_picture_and_back(name, lens):
    for remap in view_of(name).at(lens[-1], SIZE).tiles:
        points, sides = by_loops(remap), np.array(SIZE[::-1])
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
            np.testing.assert_allclose(move(pixels[20, 15]), move(pixels)[20, 15], atol=1e-9)
            if name == "square of g":
                continue  # whose gradients are NaN beyond its edge
            ends = torch.tensor([[12.0, 11], [500, 500]], requires_grad=True)
            moved = move(ends)
            torch.nan_to_num(moved).sum().backward()
            assert ends.grad.isfinite().all()
            assert (ends.grad.any(-1) != moved.isnan().any(-1)).all()


@property_of(OF_PIXELS)
def pictures_are_those_of_loops_the_sampler_and_torch(name, lens):
    view = view_of(name)
    remap = view.at(lens[-1], SIZE)
    picture = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), np.uint8)
    reads = remap.points.shape[1] // remap.view_size[1]
    points = np.stack([by_loops(tile, reads) for tile in remap.tiles])
    expected = bilinear(picture, *np.moveaxis(np.nan_to_num(points, nan=-9), -1, 0))
    height, width = remap.view_size
    expected = expected.reshape(-1, height, reads, width, reads, 3).mean((2, 4))
    sampled = remap.sampler()(picture).reshape(expected.shape)
    assert sampled.dtype == np.uint8
    rim = 1.5 if "camera" not in name else 60  # tables of the radius end at the rim
    error = np.abs(sampled - expected)
    assert error.max() <= rim and np.quantile(error, 0.99) <= 1.5
    found = remap.sampled(picture)
    assert found.shape == ((view.count,) if view.count > 1 else ()) + (height, width, 3)
    assert np.abs(found.reshape(expected.shape).astype(int) - sampled).max() <= 1
    planes = torch.from_numpy(picture).permute(2, 0, 1)[None].double().requires_grad_()
    seen = remap(planes)
    assert seen.shape == (view.count, 3, height, width)
    error = np.abs(seen.detach().permute(0, 2, 3, 1).numpy() - expected)
    assert error.max() <= rim and np.quantile(error, 0.99) < 0.5
    seen.sum().backward()
    assert planes.grad.abs().sum() > 0
    np.testing.assert_array_equal(remap(picture[..., 0]), remap(picture[..., :1])[..., 0])
    exact = remap(picture[..., :2].astype(np.float32))
    assert exact.dtype == np.float32 and np.abs(exact - remap(picture)[..., :2]).max() <= 1.01


@property_of(OF_PIXELS)
def targets_take_the_nearest_value(name, lens):
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    any_inside = False
    for tile in view_of(name).at(lens[-1], SIZE).tiles:
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
        any_inside |= inside.any()
    assert any_inside


@property_of(OF_PIXELS)
def a_box_has_one_answer(name, lens):
    """By `boxes_to_image`, a `LensAdapter`, and 20,000 points of its ellipse; and back into the
    view, as `darswin warp` moves it."""
    view, lens = view_of(name), lens[-1]
    remap = view.at(lens, SIZE)
    table = np.array([[6.0, 8, 22, 19], [-4, 5, 12, 30], [25, 20, 60, 60], [9, 9, 9, 12]])
    angle = np.linspace(0, 2 * math.pi, 20_000, endpoint=False)
    circle = np.stack((np.cos(angle), np.sin(angle)), -1)
    for tile in remap.tiles:
        boxes, visible, rays = tile.boxes_to_image(table)
        again, *_ = tile.boxes_to_image(torch.from_numpy(table).float())
        np.testing.assert_allclose(again, boxes, rtol=0, atol=1e-4)
        assert visible[3] == 0 and np.isnan(boxes[3]).all()
        clipped = of_boxes.clip(table, tile.view_size)
        for box, there, share in zip(clipped, boxes, visible, strict=True):
            middle, half = (box[:2] + box[2:]) / 2, (box[2:] - box[:2]) / 2
            points = tile.to_image(middle + half * circle - 0.5) + 0.5
            if np.isfinite(points).all() and share == 1:
                exact = np.concatenate((points.min(0), points.max(0)))
                np.testing.assert_allclose(there, exact, atol=0.02)
    if view.count > 1:
        return
    found = dict(boxes=torch.from_numpy(table).float(), scores=torch.ones(4), labels=torch.ones(4))
    adapter = LensAdapter(nn.Identity(), view=view, boxes=lambda _: found)
    (by_adapter,) = adapter(torch.zeros(1, 3, *SIZE), lens)
    np.testing.assert_allclose(by_adapter["boxes"], boxes[visible > 0], atol=0.02)
    np.testing.assert_allclose(by_adapter["visible"], visible[visible > 0], atol=1e-3)
    if view.uses_lens:
        expected = remap.rays((table[:3, :2] + table[:3, 2:] - 1) / 2)
        np.testing.assert_allclose(rays[0], np.nan_to_num(expected[0]), atol=1e-6)
    inner = np.array([[50.0, 40, 66, 52]])
    there, visible, _ = remap.boxes_to_view(inner)
    points = remap.to_view((inner[:, :2] + inner[:, 2:]) / 2 + [8, 6] * circle - 0.5) + 0.5
    if visible == 1 and np.ptp(points[:, 0]) < remap.view_size[1] / 2:  # not at a seam, nor NaN
        np.testing.assert_allclose(there[0], [*points.min(0), *points.max(0)], atol=0.02)


@pytest.mark.parametrize(("holds", "name", "kind"), in_turn(PROPERTIES, LENSES))
def test_of_every_view(holds, name, kind):
    holds(name, LENSES[kind])


@pytest.mark.parametrize("name", NAMED)
@pytest.mark.parametrize("tangential", [None, [[0.02, 0.01]]])
def test_gradients_reach_images_and_lens(name, tangential):
    focal = torch.tensor([14.0], requires_grad=True)
    center = torch.tensor([[22.0, 27.0]], requires_grad=True)
    images = torch.randn(2, 3, *SIZE, requires_grad=True)
    lens = KannalaBrandt(focal, [[0.01]], 1.5, center=center, tangential=tangential)
    view = view_of(name, (16, 16))
    prepared = view.prepare(lens, SIZE)
    view.back(view.see(images, prepared), prepared).square().sum().backward()
    for tensor in (images, focal, center) if view.uses_lens else (images,):
        assert tensor.grad.isfinite().all() and tensor.grad.any()


@torch.no_grad()
@every_view
def test_frames_of_uint8_are_normalized(name):
    view = view_of(name, mean=(0.4, 0.5, 0.6), std=0.25)
    frames = torch.randint(256, (2, *SIZE, 3), dtype=torch.uint8)
    mean = torch.tensor([0.4, 0.5, 0.6])[:, None, None]
    planes = (frames.permute(0, 3, 1, 2) / 255 - mean) / 0.25
    lens = LENSES["two"]
    assert_close(view(frames, lens), view(planes, lens), rtol=1e-4, atol=1e-4)
    exact = view.see(frames.permute(0, 3, 1, 2), view.prepare(lens, SIZE), torch.float64)
    assert exact.dtype == torch.float64
    assert_close(exact.float(), view(planes, lens), rtol=1e-4, atol=1e-4)
    refuses = make_view(name, (16, 16), mean=None, std=None)
    refused("mean", refuses, frames, lens, error=(TypeError, ValueError))
    for mean, std, message in (
        (0.5, 0.0, r"std must be positive, got 0\.0"),
        ((0.1, 0.2), (0.1, 0.2, 0.3), r"mean must be one number or one per channel \(3\)"),
        (None, 0.5, "mean and std must be given together, got None and 0.5"),
    ):
        refused(message, make_view, name, (16, 16), mean=mean, std=std)


def convolution():
    return nn.Conv2d(3, 5, 3, padding=1)


UNET = dict(image_size=32, patch_size=2, window=(2, 2), task="distance", rays=True)
CONV = dict(widths=(4, 6), size=32, task="distance")
SWIN = dict(depths=(1, 1), num_heads=(1, 2), embed_dim=8, image_size=32)
# Networks on a view of 32 × 32 px, by its name.
NETWORKS = {
    "adapter": lambda view: LensAdapter(convolution(), 32, view=view, mean=0.4, std=0.2),
    "adapter of a view": lambda view: LensAdapter(convolution(), view=make_view(view, 32)),
    "Swin": lambda view: Swin(4, view=view, **SWIN),
    "Unet": lambda view: create_model("swin_unet_nano", view=view, **UNET),
    "Unet of tokens": lambda view: create_model("swin_unet_nano", view=view, skip_width=0, **UNET),
    "Unet of convolutions": lambda view: create_model("conv_unet_nano", view=view, **CONV),
}
DTYPES = (torch.float32, torch.bfloat16, torch.float64)


@torch.no_grad()
@pytest.mark.parametrize(
    ("kind", "name", "dtype"),
    in_turn([(kind, name) for name in list_views() for kind in NETWORKS], DTYPES),
)
def test_networks_get_what_the_view_sees_in_their_dtype(kind, name, dtype):
    make = NETWORKS[kind]
    if name == "tiles" and "adapter" not in kind:
        refused("one picture of each image, but the view shows 5", make, name)
        return
    model, frames = make(name).to(dtype).eval(), torch.randint(256, (2, 32, 32, 3)).byte()
    lens = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
    assert model.uses_lens == (name != "none") or "Unet" in kind
    prepared = model.prepare(lens, (32, 32))
    sampled, result = model.sample(frames, prepared), model(frames, lens)
    least = torch.float32 if "Unet" in kind else dtype  # of distances
    assert sampled.dtype == dtype and result.dtype == torch.promote_types(dtype, least)
    shape = (2, 4) if kind == "Swin" else (2, 5 if "adapter" in kind else 1, 32, 32)
    assert result.shape == shape and result.isfinite().all()
    assert_close(sampled, model.view(frames, lens).to(dtype), rtol=0.01, atol=0.01)
    assert torch.equal(model.run_sampled(sampled, prepared), result)


class AnyRatio(PixelView):
    """The picture of an equidistant lens, on an image of any size."""

    def of(self, lens):
        return Equidistant(min(self.size) / 2 / lens.theta_max, lens.theta_max)

    def to_rays(self, points, lens, size):
        return self.of(lens).unproject_points(points, self.size)

    def to_points(self, rays, lens, size):
        return self.of(lens).project_points(rays, self.size)


def test_a_view_of_ones_own_needs_two_methods_and_has_a_name(monkeypatch):
    monkeypatch.setitem(_VIEWS, "tall polar", None)  # and is removed again
    register_view("tall polar")(lambda size, **_: PolarView(*size, samples=(2, 1), layout="image"))
    assert make_view("tall polar", (16, 8)).map_size == (32, 8)
    monkeypatch.setitem(_VIEWS, "own", AnyRatio)
    test_gradients_reach_images_and_lens("own", None)
    what_is_seen_comes_back_also_from_coarser_maps("own", LENSES["general"])
    the_rays_of_the_pixels_land_where_the_view_reads("own", LENSES["two"])
    test_frames_of_uint8_are_normalized("own")
    for kind in NETWORKS:
        test_networks_get_what_the_view_sees_in_their_dtype(kind, "own", torch.bfloat16)
    assert repr(make_view("own", (24, 32))) == "AnyRatio(size=(24, 32))"
    monkeypatch.setitem(_VIEWS, "own", lambda _size: View())
    refused("'own' has no option 'mean'; it has none", make_view, "own", (24, 32), error=TypeError)


@every_view
def test_sizes_images_lenses_and_pixels_that_do_not_fit_are_refused(name):
    for size in ([16, 16], (np.int64(16), 16), 16):
        view = make_view(name, size)
        assert (view.map_size if name == "polar" else view.size) == (16, 16)
    for wrong in (16.5, (16.0, 16.0), (16,), "16"):
        refused("size must be a pair of ints, got", make_view, name, wrong, error=TypeError)
    for wrong in ((0, 0), (-4, -4)):
        refused(r"must be (an int of )?at least 1", make_view, name, wrong)
    integers = torch.zeros(1, 3, *SIZE, dtype=torch.int32)
    refused(r"images? must be ", view, integers, LENSES["cut"], error=TypeError)
    if name != "polar":
        remap = view_of(name).at(LENSES["cut"], SIZE)
        for move in (remap.to_image, remap.to_view):
            refused(r"points must have shape \(..., 2\), got \(3,\)", move, [1.0, 2.0, 3.0])
    if name == "none":
        return
    lens, images = LENSES["two"], torch.rand(3, 3, *SIZE)
    refused("each of the 3 images, got 2", view, images, lens)
    refused(r"lens must be a darswin\.lens\.Lens, got NoneType", view, images, error=TypeError)
    said = r"images of \(H, W\) = \(90, 120\), got images of \(9"
    refused(said, view, torch.rand(1, 3, 9, 9), lens)
    prepared, seen = view.prepare(lens, SIZE), torch.rand(3 * view.count, 3, 16, 16)
    refused("each of the 3 images, got 2", view.check_seen, seen, prepared, 3)
    seen = torch.rand(2, 3, 16, 17)
    refused(r"\(H, W\) = \(16, 16\), got \(16, 17\)", view.check_seen, seen, prepared, 3)
