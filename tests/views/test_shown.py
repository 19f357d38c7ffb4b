"""Pixels that a view does not show: maps on their way back, and what dense models say there."""

import itertools
import math
from inspect import signature

import numpy as np
import pytest
import torch
from torch import nn

from darswin import create_model, frames, optimize
from darswin.deploy import camera
from darswin.deploy.export import export_program
from darswin.lens import Equidistant
from darswin.models import LensAdapter
from darswin.views import list_views, make_view
from darswin.views.registry import view_class

FOCAL, CENTER, SIZE = 18.0, (31.3, 23.6), (48, 64)
LENS = Equidistant(FOCAL, theta_max=1.45, center=[list(CENTER)], image_size=SIZE)
DOWN = dict(up=(0.0, 0.0, -1.0))  # a camera that looks straight down
# Each view, its size, what it is told, and whether its columns go all around.
VIEWS = {
    "mercator": ((24, 40), dict(fov=1.6), False),
    "cylindrical": ((24, 40), dict(fov=1.2), False),
    "equirectangular": ((16, 40), dict(fov=2.0), False),
    "panorama": ((20, 60), DOWN, True),
    "mercator around": ((20, 60), dict(fov=math.tau, **DOWN), True),
    "cylindrical around": ((20, 60), DOWN, True),
    "equirectangular around": ((20, 60), dict(fov=math.tau, **DOWN), True),
    "not quite around": ((20, 60), dict(fov=math.tau - 0.4, **DOWN), False),
    "stereographic": ((24, 24), dict(fov=1.5), False),
    "perspective": ((24, 32), dict(fov=1.0), False),
    "as far as the lens": ((24, 32), dict(reach=0.75, theta_max=0.75), False),
    "square": ((24, 24), {}, False),
}
NAMES = {"not quite around": "mercator", "as far as the lens": "perspective"}
SCALES = (1.0, 0.5, 0.25, 2.0)


def view_of(key):
    size, options, _ = VIEWS[key]
    return make_view(NAMES.get(key, key.removesuffix(" around")), size, **options)


def place_in(key, x, y):
    """The point of a view that a pixel of the image shows, or None: formulas alone, in float64."""
    (height, width), options, _ = VIEWS[key]
    across, down = (x - CENTER[0]) / FOCAL, (y - CENTER[1]) / FOCAL
    theta, azimuth = math.hypot(across, down), math.atan2(down, across)
    if theta > 1.45:
        return None
    ray = [math.sin(theta) * math.cos(azimuth), math.sin(theta) * math.sin(azimuth),
           math.cos(theta)]  # fmt: skip
    if key == "square":
        share, c, s = theta / 1.45, math.cos(azimuth), math.sin(azimuth)
        long, short = (c, s) if abs(c) >= abs(s) else (s, c)
        edge = math.copysign(share, long)
        other = edge * math.atan(short / long) * 4 / math.pi
        a, b = (edge, other) if abs(c) >= abs(s) else (other, edge)
        return (a + 1) * width / 2 - 0.5, (b + 1) * height / 2 - 0.5
    name = NAMES.get(key, key.removesuffix(" around"))
    if "up" in options:  # its picture's top is forward on the horizon
        ray = [ray[0], ray[2], -ray[1]]
    fov = options.get("fov", math.tau)
    if theta > options.get("theta_max", math.pi):
        return None
    if "reach" in options:
        step = math.tan(options["reach"]) / (min(height, width) / 2)
    elif name == "perspective":
        step = math.tan(fov / 2) / (width / 2)
    elif name == "stereographic":
        step = 2 * math.tan(fov / 4) / (width / 2)
    else:
        step = fov / width
    if name == "perspective":
        if ray[2] <= 0:
            return None
        u, v = ray[0] / ray[2], ray[1] / ray[2]
    elif name == "stereographic":
        u, v = 2 * ray[0] / (1 + ray[2]), 2 * ray[1] / (1 + ray[2])
    else:
        u, slope = math.atan2(ray[0], ray[2]), ray[1] / math.hypot(ray[0], ray[2])
        v = {"cylindrical": slope, "equirectangular": math.atan(slope)}.get(name, math.asinh(slope))
    return u / step + (width - 1) / 2, v / step + (height - 1) / 2


def expected(key, maps, shift):
    """A map (K, h, w) at the pixels of the image, by loops: 0 beyond the view's edges, its border
    up to them, and the first column after the last if it goes around. NaN near the edges."""
    (height, width), _, around = VIEWS[key]
    rows, columns = maps.shape[1:]
    found = np.zeros((len(maps), *SIZE))
    for y, x in itertools.product(range(SIZE[0]), range(SIZE[1])):
        place = place_in(key, x, y)
        if place is None:
            continue
        px, py = place[0], place[1] + shift
        beyond = [-0.5 - py, py - height + 0.5] + [-0.5 - px, px - width + 0.5] * (not around)
        if max(beyond) > 1e-2:
            continue
        if max(beyond) > -1e-2:
            found[:, y, x] = np.nan
            continue
        px, py = (px + 0.5) * columns / width - 0.5, (py + 0.5) * rows / height - 0.5
        px = px % columns if around else min(max(px, 0), columns - 1)
        py = min(max(py, 0), rows - 1)
        i, j = math.floor(py), math.floor(px)
        for a, b in itertools.product((0, 1), (0, 1)):
            weight = (a * (py - i) + (1 - a) * (i + 1 - py)) * (
                b * (px - j) + (1 - b) * (j + 1 - px)
            )
            found[:, y, x] += weight * maps[:, min(i + a, rows - 1), (j + b) % columns]
    return found


def shift_of(key, view, prepared):
    """The rows by which a view that shows what the lens sees lies higher than the horizon."""
    if not VIEWS[key][2] and key != "not quite around":
        return 0.0
    y, x = 14, 40
    middle = place_in(key, x, y)
    assert middle is not None
    there = view.at(LENS, SIZE).to_view(np.array([[float(x), float(y)]]))[0]
    assert there[0] == pytest.approx(middle[0], abs=1e-3)
    return float(there[1] - middle[1])


@torch.no_grad()
@pytest.mark.parametrize("key", VIEWS)
def test_a_map_comes_back_as_loops_compute_it(key):
    view = view_of(key)
    prepared = view.prepare(LENS, SIZE)
    shift = shift_of(key, view, prepared)
    for scale in SCALES:
        sides = [round(scale * side) for side in view.size]
        maps = torch.rand(1, 2, *sides) + 1
        wanted = expected(key, maps[0].numpy().astype(float), shift)
        sure = ~np.isnan(wanted[0])
        found = view.back(maps, prepared)[0].numpy()
        np.testing.assert_allclose(found[:, sure], wanted[:, sure], atol=2e-3)
        assert ((wanted[0] > 0) == prepared.shown[0].numpy())[sure].all()
    share = (wanted[0, sure] > 0).mean()
    assert 0.01 < share < 0.95 and sure.mean() > 0.95


@torch.no_grad()
@pytest.mark.parametrize("name", [name for name in list_views() if name != "none"])
@pytest.mark.parametrize("options", [{}, DOWN], ids=["ahead", "down"])
def test_a_constant_comes_back_whole_and_ids_stay_ids(name, options):
    if "up" not in signature(view_class(name)).parameters:
        options = {}
    view = make_view(name, (24, 24), **options)
    prepared = view.prepare(LENS, SIZE)
    shown = prepared.shown[0]
    assert 0.1 < shown.float().mean() < 0.9
    for side in (24, 12, 8, 48):
        shape = (view.count, 1, side, side)
        back = view.back(torch.full(shape, 10.0), prepared)[0, 0]
        assert (back[shown] - 10).abs().max() < 1e-4 and not back[~shown].any()
        ids = torch.randint(0, 3, shape) * 2**40 + 7
        back = view.back(ids, prepared)[0, 0]
        assert back.dtype == torch.int64 and set(back[shown].tolist()) == set(ids.unique().tolist())
        assert not back[~shown].any()


# -- dense models -----------------------------------------------------------------------------

MODELS = ("conv_unet_nano", "swin_unet_nano", "darswin_unet_a_nano", "adapter")
OF_MODELS = [
    (model, view, task, path)
    for model, view, task, path in itertools.product(
        MODELS, list_views(), ("segmentation", "distance"),
        ("eager", "optimized", "frames", "export"),
    )
    if view not in ("none", "tiles" if model != "adapter" else "")
    and (view == "polar" or model != "darswin_unet_a_nano")
    and (path != "frames" or model in ("swin_unet_nano", "darswin_unet_a_nano"))
    and (model != "adapter" or (path == "eager" and task == "segmentation"))
    and (view != "polar" or path != "frames" or model == "darswin_unet_a_nano")
]  # fmt: skip


def each_once(cases):
    """Cases that have each value of each column once; the others are slow."""
    seen = set()
    for case in cases:
        new = set(enumerate(case)) | {(case[0], case[3]), (case[2], case[3])}
        is_new = not new <= seen
        seen |= new if is_new else set()
        marks = () if is_new and case[3] != "export" else pytest.mark.slow
        yield pytest.param(*case, marks=marks, id="-".join(case))


def model_of(name, view, task):
    torch.manual_seed(0)
    if name == "adapter":
        return LensAdapter(nn.Conv2d(3, 4, 4, stride=4), 32, view=view, mean=0.0, std=1.0).eval()
    options = dict(task=task, num_classes=4, mean=0.0, std=1.0)
    if name != "darswin_unet_a_nano":
        options |= dict(view=dict(name=view, size=32))
    else:
        options |= dict(theta_max=1.1)
    if name == "swin_unet_nano":
        options |= dict(image_size=SIZE)
    return create_model(name, **options).eval()


def result_of(model, path, images, folder):
    if path == "eager":
        return model(images, LENS)
    if path == "optimized":
        return optimize(model)(images, LENS)
    if path == "export":
        return export_program(model, images, LENS, fixed_lens=True).module()(images)
    camera.export_network(model, LENS, SIZE, folder / "n.safetensors")
    frame = images[0].permute(1, 2, 0).contiguous().numpy()
    return torch.from_numpy(frames.Network(folder / "n.safetensors")(frame))[None]


@torch.no_grad()
@pytest.mark.parametrize(("name", "view", "task", "path"), list(each_once(OF_MODELS)))
def test_a_dense_model_has_no_answer_where_its_view_shows_nothing(name, view, task, path, tmp_path):
    model = model_of(name, view, task)
    images = torch.randint(256, (1, 3, *SIZE), dtype=torch.uint8)
    shown = model.prepare(LENS, SIZE).view.shown[0]
    result = result_of(model, path, images, tmp_path)
    torch.testing.assert_close(result, model(images, LENS), rtol=1e-3, atol=1e-3)
    assert 0.1 < shown.float().mean() < 0.95 and result[0, :, shown].std() > 0
    if task == "distance":
        assert (result[0, :, shown] > 0).all() and not result[0, :, ~shown].any()
    elif name == "adapter":
        assert not result[0, :, ~shown].any()
