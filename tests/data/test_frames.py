import numpy as np
import pytest
import torch
from frames import WOODSCAPE

from darswin.data.warp import area_resized, at_size, lens_at_size
from darswin.lens import Equidistant, load

SIZE = (90, 120)


def blob(at, size):
    """A picture of a bright spot around (x, y)."""
    y, x = np.mgrid[: size[0], : size[1]]
    spot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 6.0**2))
    return (250 * spot).astype(np.uint8)[..., None]


def centroid(image):
    weight = image[..., 0].astype(float)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    return torch.tensor([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("fit", ["crop", "stretch", "whole"])
@pytest.mark.parametrize("size", [32, 64])
def test_a_ray_stays_on_the_same_content(fit, size):
    lens = load(WOODSCAPE).in_picture((242, 320))
    theta, azimuth = torch.tensor([0.3, 0.6, 0.5]), torch.tensor([0.4, 2.0, -2.5])
    for ray in zip(theta, azimuth, strict=True):
        before = lens.project_rays(*ray)[0]
        image, there = at_size(blob(before.tolist(), (242, 320)), lens, size, fit)
        assert tuple(there.image_size[0].tolist()) == image.shape[:2]
        torch.testing.assert_close(
            centroid(image).float(), there.project_rays(*ray)[0], atol=0.1, rtol=0
        )


@pytest.mark.parametrize(
    ("before", "after"), [((90, 640), (128, 128)), ((400, 100), (96, 120)), ((60, 250), (60, 31))]
)
def test_an_axis_that_becomes_shorter_while_the_other_becomes_longer_is_not_shifted(before, after):
    y, x = np.mgrid[: before[0], : before[1]].astype(np.float32)
    resized = area_resized(np.stack((y, x), -1), after)
    for axis in (0, 1):
        scale = before[axis] / after[axis]
        centres = (np.arange(after[axis]) + 0.5) * scale - 0.5
        off = (resized[..., axis].mean(1 - axis) - centres)[2:-2] / scale
        assert abs(off.mean()) < 1e-3 and np.abs(off).max() < 0.5 / min(scale, 1)


def test_shapes():
    image = np.zeros((*SIZE, 3), np.uint8)
    lens = Equidistant(30.0, 1.5, image_size=SIZE)
    shapes = {fit: at_size(image, lens, 32, fit)[0].shape for fit in ("crop", "stretch", "whole")}
    assert shapes == {"crop": (32, 32, 3), "stretch": (32, 32, 3), "whole": (32, 43, 3)}
    assert at_size(image[..., :1], lens, 32, "crop")[0].shape == (32, 32, 1)
    square = np.random.default_rng(0).integers(256, size=(32, 32, 1), dtype=np.uint8)
    same, _ = at_size(square, Equidistant(9.0, 1.5, image_size=(32, 32)), 32, "crop")
    assert (same == square).all()


def test_what_is_no_way():
    lens = Equidistant(30.0, 1.5, image_size=SIZE)
    with pytest.raises(ValueError, match="framing must be one of crop, stretch, whole, got 'pad'"):
        at_size(np.zeros((*SIZE, 1), np.uint8), lens, 32, "pad")
    with pytest.raises(ValueError, match="needs an image_size"):
        lens_at_size(Equidistant(30.0, 1.5), 32, "crop")
