"""Views within torch.compile."""

import pytest
import torch
from torch.testing import assert_close

from darswin import create_model
from darswin.lens import Spherical


@pytest.mark.slow
@torch.no_grad()
def test_a_compiled_model_keeps_nothing_of_a_lens():
    # The view finds what it covers, which differs from lens to lens.
    model = create_model("conv_unet_nano", num_classes=3, widths=(4,), view="mercator", size=16)
    images, lenses = torch.rand(1, 3, 32, 32), Spherical.from_fov(0.5, [3.0, 1.8], 16.0)
    expected = [model.eval()(images, lens) for lens in (lenses[0], lenses[1])]
    compiled = torch.compile(model, backend="eager")
    for lens, right in zip((lenses[0], lenses[1]), expected, strict=True):
        assert_close(compiled(images, lens), right, atol=1e-4, rtol=1e-4)
        assert_close(model(images, lens), right)
    assert_close(model(images, lenses[0]), expected[0])
