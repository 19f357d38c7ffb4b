import pytest
import torch
import torch.nn.functional as F

from darswin import create_model
from darswin.lens import Perspective, Spherical
from darswin.lens.pixels import reproject
from darswin.models import LensAdapter

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 32.0)


def network(name, **options):
    model = create_model(name, **(dict(num_classes=4, image_size=64) | options)).eval()
    for key, parameter in model.named_parameters():
        spread = 1.0 if parameter.dim() == 1 and key.endswith("weight") else 0.0
        torch.nn.init.normal_(parameter, mean=spread, std=0.1)
    return model


def of_the_same_weights(model, name, **options):
    other = network(name, **options)
    other.load_state_dict(model.state_dict())
    return other


@torch.no_grad()
def test_it_ignores_the_lens():
    model, images = network("swin_unet_nano"), torch.randn(2, 3, 64, 64)
    assert torch.equal(model(images, LENSES), model(images))


@torch.no_grad()
def test_a_map_coarser_than_the_image_is_resized():
    model = network("swin_unet_nano", image_size=(128, 64), patch_size=8, skip_width=0)
    maps = model.encoder.forward_intermediates(torch.randn(2, 3, 128, 64), intermediates_only=True)
    x = model.segmentation_head.proj(model.decoder(maps, [(), ()]))
    assert x.shape == (2, 64, 32, 4)
    got = model.view.to_pixels(x, None, (128, 64))
    x = x.permute(0, 3, 1, 2)
    torch.testing.assert_close(got, F.interpolate(x, (128, 64), mode="bilinear"))


@torch.no_grad()
def test_undistorted_it_predicts_in_the_view_and_brings_back():
    undis = network("swin_unet_undis_nano", max_fov=2.0)
    plain = of_the_same_weights(undis, "swin_unet_nano")
    images = torch.randn(2, 3, 64, 64)
    half = torch.full((2,), 1.0)  # of 2.6 rad the view shows 2.0
    view = Perspective(32 / torch.tan(half), half)
    logits = plain(reproject(images, LENSES, view, (64, 64)))
    torch.testing.assert_close(undis(images, LENSES), reproject(logits, view, LENSES, (64, 64)))
    theta, _ = LENSES.unproject_pixels(torch.tensor([[[0.0, 32.0]]]), (64, 64))
    assert (theta > 1.0).all() and (undis(images, LENSES)[:, :, 32, 0] == 0).all()


@torch.no_grad()
@pytest.mark.parametrize("spacing", ["theta", "g", "radius"])
def test_adapted_it_is_a_lens_adapter_around_it(spacing):
    adapted = network("swin_unet_adapted_nano", spacing=spacing)
    plain = of_the_same_weights(adapted, "swin_unet_nano")
    images = torch.randn(2, 3, 64, 64)
    got = adapted(images, LENSES)
    assert torch.equal(got, LensAdapter(plain, 64, spacing)(images, LENSES))
    assert (got[:, :, 0, 0] == 0).all() and (got[:, :, 32, 1] != 0).all()


def test_wrong_options():
    for options, message in (
        (dict(spacing="r"), "spacing must be one of .*'theta'.*, got 'r'"),
        (dict(image_size=(64, 128)), r"image_size must be square, got \(64, 128\)"),
    ):
        with pytest.raises(ValueError, match=message):
            create_model("swin_unet_adapted_nano", **options)
    with pytest.raises(ValueError, match=r"max_fov must be in \(0, π\), got 4"):
        create_model("swin_unet_undis_nano", max_fov=4)
    with pytest.raises(ValueError, match=r"patch_size must divide image_size = \(66, 66\), got 4"):
        create_model("swin_unet_nano", image_size=66)
