"""Views of frames by darswin.frames: exact bilinear samples, and OpenCV as an oracle."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from frame_samples import MEAN, ROUND, STD, bilinear, random_frame
from lens_examples import FRONT

from darswin import frames
from darswin.deploy import camera
from darswin.lens import Equidistant
from darswin.views import SquareView, make_view, turned

VIEWS = {
    "all inside": make_view("perspective", (40, 50), fov=1.4),
    "beyond": make_view("equirectangular", (30, 60), fov=2 * math.pi, supersampling=1),
    "turned": make_view("cylindrical", (30, 60), fov=2.0, **turned(0.7, -0.4)),
    "shrunk": make_view("mercator", (12, 20), fov=3.0, up=(0.3, -1, 0.2), supersampling=3),
    "square": SquareView((30, 30), fov=2.6),
}


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("name", VIEWS)
def test_plans_of_views_are_exact_pictures(name, channels):
    view, lens, frame = VIEWS[name], ROUND.with_theta_max(1.5), random_frame(64, 70, *channels)
    found = frames.Sampler(camera.plan(view, lens, (64, 70), output="uint8"))(frame)
    assert found.dtype == np.uint8 and found.shape == (*view.size, *channels)
    reads, exact = view.supersampling_of(lens, (64, 70)), lens.to(torch.float64)
    assert reads == (3 if name == "shrunk" else 1)
    rows, columns = (np.arange(side * reads) + 0.5 for side in view.size)
    pixels = np.stack(np.meshgrid(columns, rows), -1) / reads - 0.5
    rays = view.to_rays(torch.from_numpy(pixels)[None], exact, (64, 70))
    x, y = exact.project_points(rays, (64, 70))[0].numpy().transpose(2, 0, 1)
    x, y = np.where(np.isnan(x), -9, x), np.where(np.isnan(y), -9, y)
    expected = bilinear(frame.reshape(64, 70, -1), x, y)
    height, width = view.size
    expected = expected.reshape(height, reads, width, reads, -1).mean((1, 3)).reshape(found.shape)
    assert np.abs(found - expected).max() <= 0.5 + 1 / 512
    assert (found == 0).mean() > 0.1 or name != "beyond"  # the lens sees only a part


def cv2_view(image, points, size):
    x, y = np.moveaxis(points.astype(np.float32), -1, 0)
    read = cv2.remap(image, x.copy(), y.copy(), cv2.INTER_LINEAR)
    return cv2.resize(read, size[::-1], interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    "view",
    [
        make_view("perspective", (60, 80), fov=1.5, **turned(0.2)),
        make_view("stereographic", (20, 30), fov=2.5, supersampling=3),
        make_view("mercator", (17, 25), supersampling=2),
    ],
)
def test_views_agree_with_opencv(view):
    smooth = cv2.GaussianBlur(random_frame(90, 120, 3), (0, 0), 3)
    lens = Equidistant.from_fov(2.6, 44.0)
    found = frames.Sampler(camera.plan(view, lens, (90, 120), output="uint8"))(smooth)
    expected = cv2_view(smooth, view.at(lens, (90, 120)).points, view.size)
    assert found.shape == expected.shape == (*view.size, 3)
    assert np.abs(found.astype(int) - expected).max() <= 2  # OpenCV's weights have 5 bits


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS)
def test_places_are_exact_for_lenses_in_single_precision_too(view):
    size = (966, 1280)
    exact = camera.plan(view, FRONT.to(torch.float64), size)
    assert camera.plan(view, FRONT, size) == exact


def test_views_can_become_normalized_images_for_any_network():
    frame, view = random_frame(64, 64, 3), make_view("perspective", (20, 30), fov=1.0)
    plan = camera.plan(view, ROUND, (64, 64), mean=MEAN, std=STD)
    picture = frames.Sampler(replace(plan, output="uint8"))(frame)
    found = frames.Sampler(plan)(frame)
    expected = (picture / 255 - MEAN) / STD
    assert found.dtype == np.float32 and found.shape == (3, 20, 30)
    assert np.abs(found - expected.transpose(2, 0, 1)).max() <= 0.51 / 255 / min(STD)
