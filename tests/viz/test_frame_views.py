"""Views of frames by darswin.frames: exact bilinear samples, and OpenCV as an oracle."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from frame_samples import MEAN, ROUND, STD, bilinear, random_frame

from darswin import frames
from darswin.lens import Equidistant
from darswin.viz.views import equirectangular, perspective, undistort


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("view", [perspective((40, 50), 1.4), equirectangular((30, 60))])
def test_views_of_rays_are_exact_pictures(view, channels):
    lens, frame = ROUND.with_theta_max(1.5), random_frame(64, 70, *channels)
    found = frames.Sampler(frames.plan(view, lens, (64, 70)))(frame)
    assert found.dtype == np.uint8 and found.shape == (*view.shape[:2], *channels)
    x, y = lens.to(torch.float64).project_points(view[None], (64, 70))[0].numpy().transpose(2, 0, 1)
    x, y = np.where(np.isnan(x), -9, x), np.where(np.isnan(y), -9, y)
    expected = bilinear(frame.reshape(64, 70, -1), x, y).reshape(found.shape)
    assert np.abs(found - expected).max() <= 0.5 + 1 / 512
    assert (found == 0).mean() > 0.1 or view.shape[0] == 40  # the lens sees only a part


def test_views_agree_with_opencv():
    smooth = cv2.GaussianBlur(random_frame(90, 120, 3), (0, 0), 3)
    lens, view = Equidistant.from_fov(2.6, 44.0), perspective((60, 80), 1.5, yaw=0.2)
    found = frames.Sampler(frames.plan(view, lens, (90, 120)))(smooth)
    expected = undistort(smooth, lens, view)
    assert np.abs(found.astype(int) - expected).max() <= 2  # OpenCV's weights have 5 bits


def test_rays_can_become_normalized_images_for_any_network():
    frame, view = random_frame(64, 64, 3), perspective((20, 30), 1.0)
    plan = frames.plan(view, ROUND, (64, 64), output="image", mean=MEAN, std=STD)
    picture = frames.Sampler(replace(plan, output="uint8"))(frame)
    found = frames.Sampler(plan)(frame)
    expected = (picture / 255 - MEAN) / STD
    assert found.dtype == np.float32 and found.shape == (3, 20, 30)
    assert np.abs(found - expected.transpose(2, 0, 1)).max() <= 0.51 / 255 / min(STD)
