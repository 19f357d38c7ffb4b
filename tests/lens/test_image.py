"""The image that lenses belong to."""

import math

import numpy as np
import pytest
import torch
from helpers import refused

from darswin.lens import Equidistant, Perspective, Spherical


def test_principal_point():
    lens = Spherical(0.1, 10.0, 1.0)
    assert lens.center_in((5, 8)).tolist() == [[3.5, 2.0]]  # (H, W) in, (x, y) out
    assert Spherical(0.1, 10.0, 1.0, center=[3.0, 4.0]).center_in((5, 8)).tolist() == [[3.0, 4.0]]
    refused("needs the image_size", lens.cropped, 0, 0, 10, 10)
    refused("needs a lens that has an image_size", lens.resized, (3, 4))


def test_resized_and_cropped_take_any_number_and_nothing_that_is_no_image():
    lens = Perspective(100.0, 1.0, (319.5, 241.5), image_size=(483, 640))
    whole = lens.resized(0.5)
    for half in (np.float32(0.5), np.float64(0.5), torch.tensor(0.5), np.array(0.5)):
        resized = lens.resized(half)
        assert resized.focal.item() == 50 and resized.affine is None
        assert resized.image_size.tolist() == whole.image_size.tolist() == [[242, 320]]
    assert lens.resized(torch.tensor([240, 320])).image_size.tolist() == [[240, 320]]
    assert lens.resized((240.0, np.int64(320))).image_size.tolist() == [[240, 320]]
    assert lens.resized(1e-6).image_size.tolist() == [[1, 1]]
    for scale in (0, -1, math.nan, math.inf, np.float32(-2), torch.tensor(0.0)):
        refused("resized must be given a finite scale above 0, got", lens.resized, scale)
    for size in ((0, 5), (-5, 5), torch.tensor([3, 0])):
        refused(r"image's \(H, W\) must be at least \(1, 1\), got", lens.resized, size)
    for size in ((483,), (1, 2, 3), "12", None, (2.5, 3), (math.nan, 3), (None, 3)):
        refused(r"size must be \(H, W\)|whole pixels", lens.resized, size, error=TypeError)
    padded = lens.cropped(-8, -4, 499, 648)
    assert padded.center.tolist() == [[323.5, 249.5]]
    assert padded.image_size.tolist() == [[499, 648]]
    for part in ((0, 0, -5, 10), (0, 0, 5, 0)):
        refused(r"must be at least \(1, 1\)", lens.cropped, *part)
    for part in ((0.5, 0, 5, 10), (0, 0, math.nan, 10), (None, 0, 5, 5)):
        refused("an image has whole pixels, got", lens.cropped, *part, error=TypeError)


def test_in_a_picture_of_the_same_view():
    lens = Equidistant(300.0, 1.5, image_size=(966, 1280))
    for size in [(966, 1280), (483, 640), (75, 100), (1, 1), (1932, 2561)]:
        found = lens.in_picture(size)
        assert found.image_size.tolist() == [list(size)]
        assert found.focal.item() == pytest.approx(300 * size[1] / 1280)
        assert (found is lens) == (size == (966, 1280))
    for size in [(966, 1278), (480, 643), (1280, 966)]:
        refused("calibration is for 1280×966", lens.in_picture, size)
    unknown = Equidistant(300.0, 1.5)
    assert unknown.in_picture((4, 9)) is unknown
