"""Large images are read with gathers or without, as is faster here: the bits are the same."""

import math

import pytest
import strategies
import torch
from cases import Case, f32
from hypothesis import given

from darswin import polar_grid
from darswin.lens import Spherical
from darswin.ops import _module, cpu_capability, polar_embed, polar_sample, use_reference

pytestmark = pytest.mark.skipif(
    "avx512" not in _module.tiers(), reason="only the AVX-512 tier has gathers"
)


@pytest.fixture(autouse=True)
def avx512():
    before = cpu_capability()
    _module.set_tier("avx512")
    yield
    _module.set_tier(before)
    _module.set_gathers(None)


def assert_same_bits(run) -> None:
    """Without gathers, with them, and as is measured."""
    results = []
    for way in (False, True, None):
        _module.set_gathers(way)
        results.append(run().view(torch.int32))
    assert all(torch.equal(results[0], other) for other in results[1:])


@pytest.mark.parametrize("embed", [False, True], ids=["sample", "embed"])
def test_arguments_that_hypothesis_draws(embed):
    @given(strategies.sampling(dtypes=(f32,), embed=embed))
    def check(case: Case):
        assert_same_bits(lambda: case.run(**case.inputs))

    check()


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("samples", [(10, 10), (4, 7), (1, 1), (40, 128), (2, 2000)], ids=str)
@pytest.mark.parametrize("layout", ["tokens", "image"])
def test_large_images(channels, samples, layout):
    image = torch.randn(2, channels, 300, 523)
    image[0, :, 5, 7], image[1, :, 150, 260] = math.nan, math.inf
    # Some points lie on the border of the image, and some outside.
    lens = Spherical.from_fov(torch.tensor([0.1, 0.9]), math.radians(170), 155)
    rings, sectors = max(40 // samples[0], 1), max(130 // samples[1], 1)
    grid = polar_grid(lens, (300, 523), rings=rings, sectors=sectors, samples=samples)
    arguments = (image, grid.radii, grid.azimuths, grid.center)

    def run():
        return polar_sample(*arguments, samples=samples, layout=layout)

    assert_same_bits(run)
    image.nan_to_num_(0, 0, 0)
    with use_reference():
        want = run()
    torch.testing.assert_close(run(), want, rtol=1e-3, atol=1e-3)


def test_nothing_beyond_the_image_is_read_at_its_end():
    """The last pixels of an image lie at the end of its memory: the sanitizers watch."""
    side = 200
    image = torch.randn(1, 1, side, side)
    radii = torch.tensor([[0.0, (side - 1) / 2, (side - 1) / math.sqrt(2)]])
    azimuths = torch.arange(64) * (2 * math.pi / 64)  # corners are at odd multiples of 45°
    center = torch.full((1, 2), (side - 1) / 2)
    weight = torch.randn(5, 64)
    for run in (
        lambda: polar_sample(image, radii, azimuths, center, samples=(1, 64)),
        lambda: polar_embed(image, radii, azimuths, center, weight, samples=(1, 64)),
    ):
        assert_same_bits(run)


def test_calls_that_try_both_ways_give_the_same(threads):
    threads(1)
    image, azimuths = torch.randn(1, 1, 300, 300), torch.linspace(0, 6, 1024)
    radii, center = torch.linspace(1, 140, 128)[None], torch.full((1, 2), 150.0)
    _module.set_gathers(None)
    first = polar_sample(image, radii, azimuths, center, samples=(8, 16))
    for _ in range(5):  # three calls try both ways
        assert torch.equal(polar_sample(image, radii, azimuths, center, samples=(8, 16)), first)
