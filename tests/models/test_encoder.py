"""What all models share: prepare and run, and what they say of the images they take."""

import pytest
import torch

from darswin import create_model
from darswin.lens import Spherical
from darswin.models.registry import has_image_size

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
FAMILIES = ("darswin_a", "darswin_ra", "swin", "swin_undis", "dat")
# With the dense models, whose preset is named otherwise.
NANOS = (*(f"{family}_nano" for family in FAMILIES), "darswin_unet_a_nano", "swin_unet_nano")


@torch.no_grad()
@pytest.mark.parametrize("family", FAMILIES)
def test_one_preparation_serves_many_runs(family):
    model = create_model(f"{family}_nano", num_classes=5, mean=0.5, std=0.2).eval()
    images = torch.randn(2, 3, 32, 32), torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8)
    for lens in (LENSES, LENSES[:1]):
        prepared = model.prepare(lens, (32, 32))
        for batch in images:
            _, expected = model.forward_intermediates(batch, lens)
            logits = model.forward_head(model.norm(expected[-1]))
            assert torch.equal(logits, model(batch, lens))
            assert torch.equal(logits, model.run(batch, prepared))


def network(name, channels):
    size = {} if name.startswith("darswin") else dict(image_size=32)
    options = dict(in_chans=channels, mean=0.5, std=0.2, num_classes=5, **size)
    return create_model(name, **options).eval()


@torch.no_grad()
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("name", NANOS)
def test_uint8_images_have_as_many_channels_as_the_model_takes(name, channels):
    model = network(name, channels)
    any_size = model.image_size is None
    for size in ((32, 32), (20, 24), (20, 7 - channels))[: 3 if any_size else 1]:
        frames = torch.randint(256, (2, *size, channels), dtype=torch.uint8)
        planes = frames.permute(0, 3, 1, 2).contiguous()
        expected = model((planes / 255 - 0.5) / 0.2, LENSES)
        for images in (frames, planes):
            torch.testing.assert_close(model(images, LENSES), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("name", NANOS)
def test_uint8_images_whose_channels_are_not_known(name, channels):
    model = network(name, channels)
    cases = {
        (2, channels, 32, channels): r"both have .*: pass it in floating point, which is always",
        (2, 32, 32, 2): r"neither has in shape \(2, 32, 32, 2\)$",
        (2, 12, 32, 32): r"neither has in shape \(2, 12, 32, 32\)$",
    }
    for shape, message in cases.items():
        message = f"images of uint8 must have {channels} channels .*{message}"
        with pytest.raises(ValueError, match=message):
            model(torch.zeros(shape, dtype=torch.uint8), LENSES)
    prepared = model.prepare(LENSES, (32, 32))
    with pytest.raises(ValueError, match=f"uint8 must have {channels} channels .* neither"):
        model.run(torch.zeros(2, 12, 32, 32, dtype=torch.uint8), prepared)


@torch.no_grad()
def test_a_uint8_image_of_one_pixel():
    model, image = network("darswin_a_nano", 1), torch.tensor([[[[200]]]], dtype=torch.uint8)
    torch.testing.assert_close(
        model(image, LENSES[:1]), model((image / 255 - 0.5) / 0.2, LENSES[:1])
    )


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
        assert has_image_size(f"{family}_nano") != any_size
        assert model.square_images != any_size
    assert not create_model("swin_nano", image_size=(16, 32)).square_images
    assert create_model("darswin_a_nano", compat="official", rings=16, sectors=64).square_images
