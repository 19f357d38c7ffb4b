"""What all models share: prepare and run, and what they say of the images they take."""

import pytest
import torch

from darswin import create_model
from darswin.lens import Spherical
from darswin.models.registry import model_class

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
FAMILIES = ("darswin_a", "darswin_ra", "swin", "swin_undis", "dat")


@torch.no_grad()
@pytest.mark.parametrize("family", FAMILIES)
def test_one_preparation_serves_many_runs(family):
    model = create_model(f"{family}_nano", num_classes=5, mean=0.5, std=0.2).eval()
    images = torch.randn(2, 3, 32, 32), torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8)
    for lens in (LENSES, LENSES[:1]):
        prepared = model.prepare(lens, (32, 32))
        for batch in images:
            _, expected = model.forward_intermediates(batch, lens)
            maps = model.run(batch, prepared)
            assert all(torch.equal(a, b) for a, b in zip(maps, expected, strict=True))
            logits = model.forward_head(model.norm(maps[-1]))
            assert torch.equal(logits, model(batch, lens))


@pytest.mark.parametrize("family", ["darswin_a", "swin_undis"])
def test_what_needs_a_lens(family):
    model = create_model(f"{family}_nano", num_classes=5)
    with pytest.raises(TypeError, match=r"lens must be a darswin.lens.Lens, got NoneType"):
        model.prepare(None, (32, 32))
    camera = LENSES.replace(image_size=torch.tensor([[32.0, 32.0]] * 2))
    with pytest.raises(ValueError, match=r"belongs to images of \(H, W\) = \(32, 32\), got"):
        model.prepare(camera, (40, 32))
    with pytest.raises(ValueError, match="one lens or one an image, 3, got 2"):
        model.run(torch.zeros(3, 3, 32, 32), model.prepare(camera, (32, 32)))


def test_the_images_that_models_take():
    for family in FAMILIES:
        any_size = family.startswith("darswin")
        model = create_model(f"{family}_nano")
        assert model.image_size == (None if any_size else (32, 32))
        assert (model_class(f"{family}_nano").image_size is None) == any_size
        assert model.square_images != any_size
    assert not create_model("swin_nano", image_size=(16, 32)).square_images
    assert create_model("darswin_a_nano", compat="official", rings=16, sectors=64).square_images
