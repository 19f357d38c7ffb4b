"""`create_model(features_only=True)`, as timm's `FeatureListNet` of Swin (1.0.31) was seen to work:
maps in the order of the stages, channels last and not normed, and no more weights than they need.
"""

import pytest
import torch

from darswin import create_model, optimize
from darswin.lens import Spherical

LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
FAMILIES = ("darswin_a", "darswin_ra", "swin", "swin_undis", "dat")


def pair(family, **options):
    """A classifier, and the maps of some of its stages, with the same weights."""
    model = create_model(f"{family}_nano", num_classes=5).eval()
    maps = create_model(f"{family}_nano", num_classes=5, features_only=True, **options).eval()
    names = {f"encoder.{name}": tensor for name, tensor in model.state_dict().items()}
    maps.load_state_dict({name: names[name] for name in maps.state_dict()})
    return model, maps


@torch.no_grad()
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(
    ("out_indices", "stages"),
    [(None, [0, 1, 2]), ([0], [0]), ((1, 0), [0, 1]), (2, [1, 2]), ((0, -1), [0, 2])],
)
def test_the_maps_that_timm_gives(family, out_indices, stages):
    model, maps = pair(family, out_indices=out_indices)
    images = torch.randn(2, 3, 32, 32)
    every = model.forward_intermediates(images, LENSES, intermediates_only=True)
    got = maps(images, LENSES)
    assert isinstance(got, list) and len(got) == len(stages)
    for k, one in zip(stages, got, strict=True):
        assert torch.equal(one, every[k])
    assert maps.out_indices == tuple(stages) and maps.output_fmt == "NHWC"
    info = model.feature_info
    assert maps.feature_info.channels() == info.channels(stages) == [m.shape[3] for m in got]
    assert maps.feature_info.reduction() == info.reduction(stages)
    assert maps.feature_info.get("map_size") == [tuple(m.shape[1:3]) for m in got]
    for module, k in zip(maps.feature_info.module_name(), stages, strict=True):
        assert maps.get_submodule(module) is maps.encoder.stages[k]
    assert len(maps.encoder.stages) == max(stages) + 1
    assert not any(name.startswith(("encoder.norm", "encoder.head")) for name in maps.state_dict())


def test_every_weight_has_a_gradient():
    _, maps = pair("darswin_a", out_indices=(0, 1))
    loss = sum(m.square().sum() for m in maps(torch.randn(2, 3, 32, 32), LENSES))
    loss.backward()
    assert all(p.grad is not None for p in maps.parameters())


@torch.no_grad()
def test_channels_first_fixed_lenses_and_optimized():
    _, last = pair("darswin_ra", out_indices=(1, 2))
    _, first = pair("darswin_ra", out_indices=(1, 2), output_fmt="NCHW")
    first.load_state_dict(last.state_dict())
    images = torch.randn(2, 3, 40, 32)
    expected = last(images, LENSES[:1])
    prepared = first.prepare(LENSES[:1], (40, 32))
    for a, b in zip(first.run(images, prepared), expected, strict=True):
        assert a.is_contiguous() and torch.equal(a, b.permute(0, 3, 1, 2))
    for fast, given in ((optimize(last), [LENSES[:1]]), (optimize(last, lens=LENSES[:1]), [])):
        for a, b in zip(fast(images, *given), expected, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_uint8_images_have_as_many_channels_as_the_encoder_takes():
    options = dict(features_only=True, in_chans=4, mean=0.5, std=0.2)
    maps = create_model("darswin_a_nano", **options).eval()
    frames = torch.randint(256, (2, 40, 32, 4), dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2)
    for expected in (maps((planes / 255 - 0.5) / 0.2, LENSES), maps(planes, LENSES)):
        torch.testing.assert_close(maps(frames, LENSES), expected, rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match=r"images of uint8 must have 4 channels .* neither has"):
        maps(frames[..., :3], LENSES)


def test_what_it_says_of_itself():
    _, maps = pair("swin_undis", out_indices=[0])
    config = maps.pretrained_cfg
    assert config["architecture"] == "swin_undis_nano" and maps.num_classes == 0
    assert maps.get_submodule(config["first_conv"]) is maps.encoder.patch_embed.proj
    assert maps.image_size == (32, 32) and maps.square_images and maps.in_chans == 3


def test_wrong_arguments():
    for wrong in ([3], [-4], [], 0, 4):
        with pytest.raises(ValueError, match="indices must name some of 3 stages"):
            create_model("swin_nano", features_only=True, out_indices=wrong)
    with pytest.raises(ValueError, match="output_fmt must be 'NHWC' or 'NCHW', got 'NLC'"):
        create_model("swin_nano", features_only=True, output_fmt="NLC")
    with pytest.raises(ValueError, match="out_indices and output_fmt need features_only=True"):
        create_model("swin_nano", out_indices=[0])
    with pytest.raises(ValueError, match="features_only is for encoders"):
        create_model("swin_unet_nano", features_only=True)
