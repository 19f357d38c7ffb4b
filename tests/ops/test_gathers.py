"""Reading large images with gather instructions, where this CPU uses them, gives the same bits."""

import math

import pytest
import strategies
import torch
from cases import Case, f32, results, sampling
from hypothesis import given

from darswin.ops import _module, cpu_capability

pytestmark = pytest.mark.skipif(
    "avx512" not in _module.tiers(), reason="only the AVX-512 tier has gathers"
)


@pytest.fixture(autouse=True)
def avx512():
    before = cpu_capability()
    _module.set_tier("avx512")
    yield
    _module.set_tier(before)


def assert_same_bits(case: Case) -> None:
    """Compares with a run on pixels that are not neighbours in memory, which no gather reads."""
    image = case.inputs["image"]
    wide = case.inputs | dict(image=torch.stack((image, image), -1)[..., 0])
    found, other = (case.run(**inputs).view(torch.int32) for inputs in (case.inputs, wide))
    assert torch.equal(found, other)


@given(strategies.sampling(dtypes=(f32,)))
def test_random_arguments(case):
    assert_same_bits(case)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("samples", [(10, 10), (4, 7), (1, 1), (40, 128), (2, 2000)], ids=str)
@pytest.mark.parametrize("layout", ["tokens", "image"])
def test_large_images(channels, samples, layout):
    # Some points lie on the border of the image, and some lie outside.
    rows, columns = max(40 // samples[0], 1) * samples[0], max(130 // samples[1], 1) * samples[1]
    case = sampling(2, channels, (300, 523), rows, columns, samples, layout=layout)
    want = results(case, is_reference=True)["out"]
    torch.testing.assert_close(case.run(**case.inputs), want, rtol=1e-3, atol=1e-3)
    case.inputs["image"][0, :, 5, 7], case.inputs["image"][1, :, 150, 260] = math.nan, math.inf
    assert_same_bits(case)


def test_nothing_beyond_the_image_is_read_at_its_end():
    """The sanitizers detect reads after the last pixels, which lie at the end of the memory."""
    side = 200
    case = sampling(1, 1, (side, side), 3, 64, (1, 64))
    radii = torch.tensor([[0.0, (side - 1) / 2, (side - 1) / math.sqrt(2)]])
    case.settings["azimuths"] -= 0.37 * math.pi / 32  # corners are at odd multiples of 45°
    center = torch.full((1, 2), (side - 1) / 2)
    assert_same_bits(case.replace(radii=radii, center=center))
