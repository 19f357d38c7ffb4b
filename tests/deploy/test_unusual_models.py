"""Valid models of unusual sizes × everything that is made from a model."""

import pytest
import torch
from helpers import relative_error

from darswin import create_model, optimize
from darswin.deploy.camera import plan
from darswin.deploy.export import export_program
from darswin.deploy.quantize import quantize_model
from darswin.frames import Sampler
from darswin.layers.quantized import quantized_layers
from darswin.lens import Spherical
from darswin.models.saving import ModelCard, load_model, save_model

LENS = Spherical.from_fov(0.4, 2.6, 8.0)
ONE = dict(embed_dim=6, depths=(1,), num_heads=(2,))
TWO = dict(embed_dim=6, depths=(1, 1), num_heads=(2, 1))
POLAR = dict(rings=2, sectors=8, samples=(2, 3), window=(1, 8))
A, RA = dict(ONE, **POLAR), dict(TWO, **POLAR, merges=((1, 2),))
KINDS = {
    "narrow MLP": ("darswin_a_nano", dict(A, mlp_ratio=0.5)),
    "one number in the MLP": ("darswin_a_nano", dict(A, mlp_ratio=0.17)),
    "no block": ("darswin_a_nano", dict(A, depths=(0,))),
    "no block in the first stage": ("darswin_ra_nano", dict(RA, depths=(0, 1))),
    "no block in the last stage": ("darswin_ra_nano", dict(RA, depths=(2, 0))),
    "one ring, one sample": ("darswin_a_nano", dict(A, rings=1, samples=(1, 1))),
    "one sector": ("darswin_a_nano", dict(A, rings=4, sectors=1, window=(4, 1))),
    "windows of one token": ("darswin_a_nano", dict(A, window=(1, 1))),
    "heads of one number": ("darswin_a_nano", dict(A, num_heads=(6,))),
    "one number": ("darswin_a_nano", dict(A, embed_dim=1, num_heads=(1,))),
    "odd widths": ("darswin_ra_nano", dict(RA, embed_dim=15, num_heads=(5, 3), mlp_ratio=2.7)),
    "one harmonic": ("darswin_a_nano", dict(A, position_bias="angular", harmonics=1)),
    "two channels": ("darswin_a_nano", dict(A, in_chans=2)),
    "no head": ("darswin_a_nano", dict(A, num_classes=0)),
    "one class": ("darswin_a_nano", dict(A, num_classes=1)),
    "dropping": ("darswin_a_nano", dict(A, depths=(3,), drop_path_rate=0.9)),
    "maps": ("darswin_ra_nano", dict(RA, features_only=True, output_fmt="NCHW")),
    "maps of an empty stage": ("darswin_ra_nano", dict(RA, depths=(0, 1), features_only=True)),
    "patches of one pixel": ("swin_nano", dict(ONE, image_size=(8, 16), patch_size=1)),
    "one patch": ("swin_nano", dict(ONE, image_size=16, patch_size=16, mlp_ratio=0.5)),
    "a view and no block": ("swin_nano", dict(ONE, view="perspective", image_size=16, depths=(0,))),
    "deformable, narrow": (
        "dat_nano", dict(ONE, image_size=16, blocks=("D",), groups=(2,), mlp_ratio=0.5)
    ),
    "deformable, empty": (
        "dat_nano", dict(TWO, image_size=16, depths=(0, 1), blocks=("D", "LD"), groups=(1, 1))
    ),
    "Unet without blocks": ("darswin_unet_a_nano", dict(RA, depths=(0, 0), skip_width=1)),
    "Unet of one stage": ("darswin_unet_ra_nano", dict(A, depths=(0,), task="distance")),
    "narrow Unet": ("swin_unet_nano", dict(TWO, image_size=16, patch_size=2, mlp_ratio=0.5)),
    "convolutions of one channel": ("conv_unet_nano", dict(widths=(1,), rays=False)),
}  # fmt: skip


def network(kind):
    name, options = KINDS[kind]
    torch.manual_seed(0)
    model = create_model(name, **(dict(num_classes=5) | options)).eval()
    for parameter in model.parameters():
        mean = 1.0 if parameter.dim() == 1 else 0.0
        torch.nn.init.normal_(parameter, mean=mean, std=0.2)
    return model, torch.rand(2, model.in_chans, *(model.image_size or (16, 16)))


def maps_of(result):
    return [result] if isinstance(result, torch.Tensor) else result


def same(found, expected, tolerance):
    for one, other in zip(maps_of(found), maps_of(expected), strict=True):
        assert one.shape == other.shape and relative_error(one, other) < tolerance


@torch.no_grad()
@pytest.mark.parametrize("kind", KINDS)
def test_optimized(kind):
    model, images = network(kind)
    expected, fast = model(images, LENS), optimize(model)
    same(fast(images, LENS), expected, 1e-4)
    same(optimize(model, lens=LENS)(images), expected, 1e-4)
    same(optimize(model, torch.bfloat16)(images, LENS), expected, 0.2)
    for one, other in zip(*map(maps_of, (fast(images[:0], LENS), expected)), strict=True):
        assert one.shape == other[:0].shape


@torch.no_grad()
@pytest.mark.parametrize("kind", KINDS)
def test_quantized(kind):
    model, images = network(kind)
    blocks = any("blocks.0" in name or "reduction" in name for name, _ in model.named_modules())
    if not blocks:
        with pytest.raises(ValueError, match="no part that could be quantized: no block"):
            quantize_model(model, [(images, LENS)])
        return
    quantized = quantize_model(model, [(images, LENS)], tolerance=1e9)
    assert quantized_layers(quantized)
    same(optimize(quantized, torch.int8)(images, LENS), quantized(images, LENS), 0.05)


@torch.no_grad()
@pytest.mark.parametrize("kind", [kind for kind in KINDS if "maps" not in kind])
def test_saved_and_planned(kind, tmp_path):
    model, images = network(kind)
    name, options = KINDS[kind]
    card = ModelCard(name, dict(num_classes=5) | options)
    save_model(tmp_path / "model.safetensors", model.state_dict(), card)
    loaded, _ = load_model(tmp_path / "model.safetensors")
    same(loaded(images, LENS), model(images, LENS), 1e-6)
    if not model.uses_lens or model.in_chans == 2:  # a camera has 1, 3 or 4 channels
        return
    size = images.shape[2], images.shape[3]
    frame = torch.randint(256, (*size, model.in_chans), dtype=torch.uint8)
    sampled = Sampler(plan(loaded, LENS, size))(frame.numpy())
    expected = model.sample(frame[None], model.prepare(LENS, size))[0]
    torch.testing.assert_close(torch.from_numpy(sampled), expected, rtol=1e-4, atol=1e-4)


@torch.no_grad()
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_exported(kind):
    model, images = network(kind)
    program = export_program(model, images[:1], LENS, fixed_lens=True).module()
    for batch in (images, images[:0]):
        torch.testing.assert_close(program(batch), model(batch, LENS), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_trained(kind):
    model, images = network(kind)
    result = model.train()(images, LENS)
    sum(one.sum() for one in maps_of(result)).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
