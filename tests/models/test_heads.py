import math

import pytest
import torch

from darswin.models.unet import DistanceHead, PixelHead


def test_the_skip_adds_what_the_image_shows():
    head = PixelHead(6, 4, in_chans=3, skip_width=8)
    coarse, images = torch.randn(2, 4, 9, 7), torch.randn(2, 3, 9, 7)
    out = head.refine(coarse, images)
    assert out.shape == coarse.shape and not torch.equal(out, coarse)
    changed = images.clone()
    changed[0, :, 4, 3] += 1  # two convolutions of 3×3: it reaches two pixels far
    differs = (head.refine(coarse, changed) != out).any(1)
    assert differs[0, 2:7, 1:6].sum() == differs.sum() > 9
    torch.nn.init.zeros_(head.out.weight)
    assert torch.equal(head.refine(coarse, images), coarse)
    without = PixelHead(6, 4, in_chans=3, skip_width=0)
    assert torch.equal(without.refine(coarse, images), coarse)
    assert [name for name, _ in without.named_parameters()] == ["proj.weight", "proj.bias"]


def test_distances_are_positive_and_finite():
    head = DistanceHead(6, in_chans=3, skip_width=0, typical_distance=4.0)
    x = torch.tensor([-1e30, -math.inf, -3.0, 0.0, 1e-3, 3.0, 1e30, math.inf])
    meters = head.finish(x)
    assert meters.isfinite().all() and (meters > 0).all()
    torch.testing.assert_close(meters[3:5], 4 * torch.exp(x[3:5]))  # near 0 it is e^x itself
    assert meters[0] == meters[1] < 2e-3 and meters[-1] > 10_000
    assert (meters.diff()[1:6] > 0).all()
    assert head.finish(x.bfloat16()).dtype == torch.float32
    assert head.finish(x.double()).dtype == torch.float64


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.inf, math.nan])
def test_wrong_typical_distances(wrong):
    with pytest.raises(ValueError, match="typical_distance must be above 0 m, got"):
        DistanceHead(6, 3, 0, wrong)
