import pytest
import torch
import torch.nn.functional as F

from darswin import PolarSample, polar_grid
from darswin.lens import Perspective, Spherical
from darswin.ops import polar_sample

LENS = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def test_polar_sample_replaces_grid_sample_on_a_polar_grid():
    images = torch.randn(2, 3, 32, 33)
    sample = PolarSample(4, 8, (3, 2), spacing="tan", layout="image")
    grid = polar_grid(LENS, (32, 33), rings=4, sectors=8, samples=(3, 2), spacing="tan")
    x = grid.center[:, 0, None, None] + grid.radii[:, :, None] * torch.cos(grid.azimuths)
    y = grid.center[:, 1, None, None] + grid.radii[:, :, None] * torch.sin(grid.azimuths)
    mesh = torch.stack((2 * x / 32 - 1, 2 * y / 31 - 1), -1)
    expected = F.grid_sample(images, mesh, align_corners=True)
    torch.testing.assert_close(sample(images, LENS), expected, rtol=1e-4, atol=1e-4)
    assert sample.train()(images, LENS).shape == (2, 3, 12, 16)


def test_the_layouts_are_those_of_the_operator():
    # One default in both: tokens.
    images = torch.randn(2, 3, 32, 33)
    for layout in ({}, dict(layout="tokens"), dict(layout="image")):
        sample = PolarSample(4, 8, (3, 2), **layout)
        arguments = sample.arguments(images, sample.grid(LENS, (32, 33)))
        assert torch.equal(sample(images, LENS), polar_sample(**arguments, **layout))


def test_general_lenses():
    images = torch.randn(2, 3, 32, 33, dtype=torch.float64)
    affine, offsets = torch.eye(2) + 0.3 * torch.randn(2, 2, 2), torch.randn(1, 2, 12, 16)

    grid = polar_grid(LENS, (32, 33), rings=4, sectors=8, samples=(3, 2))
    radii, azimuths, center = (t.double() for t in grid[:3])
    expected = polar_sample(
        images, radii, azimuths, center, affine=affine.double(), offsets=offsets.double(),
        samples=(3, 2), layout="image",
    )  # fmt: skip
    sample = PolarSample(4, 8, (3, 2), layout="image")
    sample.grid = lambda lens, size: grid._replace(affine=affine, offsets=offsets)
    assert torch.equal(sample(images, LENS), expected)


def test_polar_sample_jitters_only_in_training_and_by_torchs_generator():
    images = torch.randn(2, 3, 32, 32)
    sample = PolarSample(4, 8, (3, 2), jitter=1.0).eval()
    assert torch.equal(sample(images, LENS), sample(images, LENS))
    sample.train()
    torch.manual_seed(3)
    first, second = sample(images, LENS), sample(images, LENS)
    torch.manual_seed(3)
    assert torch.equal(sample(images, LENS), first) and not torch.equal(first, second)


@pytest.mark.parametrize(
    ("shape", "given", "last"),
    [
        ((2, 32, 33, 1), None, True),
        ((2, 32, 33, 4), None, True),
        ((2, 1, 32, 33), None, False),
        ((2, 1, 32, 3), False, False),
        ((2, 32, 3, 1), True, True),
        ((2, 12, 32, 33), False, False),
    ],
)
def test_uint8_images(shape, given, last):
    images = torch.randint(256, shape, dtype=torch.uint8)
    planes = images.permute(0, 3, 1, 2) if last else images
    sample = PolarSample(4, 8, (3, 2), mean=0.4, std=0.2)
    expected = sample((planes / 255 - 0.4) / 0.2, LENS)
    torch.testing.assert_close(sample(images, LENS, given), expected, rtol=1e-4, atol=1e-4)


def test_one_lens_serves_all_images():
    images = torch.randn(3, 1, 20, 24)
    one = Perspective.from_fov(2.0, 10.0)
    sample = PolarSample(4, 8, (2, 2))
    assert torch.equal(sample(images, one), sample(images, one.expand(3)))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda s: s(torch.zeros(3, 32, 32), LENS), ValueError, r"\(B, C, H, W\), got \(3, 32"),
        (lambda s: s(torch.zeros(3, 1, 32, 32), LENS), ValueError, "one an image, 3, got 2"),
        (lambda s: s(torch.zeros(2, 1, 32, 32), None), TypeError, "lens must be a darswin.lens"),
        (lambda s: s([1], LENS), TypeError, "images must be a tensor, got list"),
        (lambda s: s(torch.zeros(2, 1, 32, 3).byte(), LENS), ValueError, "both .* pass channels_"),
        (
            lambda s: s(torch.zeros(2, 9, 32, 9).byte(), LENS),
            ValueError,
            "neither .* pass channels",
        ),
        (
            lambda s: s(torch.zeros(2, 1, 9, 9), LENS, "yes"),
            TypeError,
            "channels_last must be True",
        ),
        (lambda s: PolarSample(0, 8, (2, 2)), ValueError, "rings"),
        (lambda s: PolarSample(4, 8, (2, 2), jitter=2.0), ValueError, "jitter"),
        (lambda s: PolarSample(4, 8, (2, 2), layout="rows"), ValueError, "layout"),
        (lambda s: PolarSample(4, 8, (1, 2), placement="edges"), ValueError, "edges"),
    ],
)
def test_polar_sample_errors(call, error, message):
    with pytest.raises(error, match=message):
        call(PolarSample(4, 8, (2, 2)))
