"""What all dense models share."""

import copy

import pytest
import torch
import torch.nn.functional as F

from darswin import create_model, list_models, optimize
from darswin.lens import KannalaBrandt, Polynomial, Spherical
from darswin.models.registry import has_image_size, model_class
from darswin.models.saving import ModelCard, load_model, save_model
from darswin.models.unet import Unet
from darswin.ops import use_reference

DENSE = [name for name in list_models() if issubclass(model_class(name), Unet)]
NANOS = [name for name in DENSE if name.endswith("nano")]
LENSES = Spherical.from_fov([0.2, 0.9], 2.6, 32.0)
GENERAL = KannalaBrandt(
    20.0, [0.01], 1.5, center=[30.0, 35.0], affine=[[1.0, 0.1], [0.0, 1.1]],
    tangential=[0.02, 0.01],
)  # fmt: skip
# Images of 64 px: fixed sizes are options of the models on images.


def network(name="darswin_unet_a_nano", **options):
    """A model for images of 64×64, in eval mode, whose every parameter counts."""
    if has_image_size(name):
        options = dict(image_size=64) | options
    model = create_model(name, **(dict(num_classes=5) | options)).eval()
    for key, parameter in model.named_parameters():
        spread = 1.0 if parameter.dim() == 1 and key.endswith("weight") else 0.0
        torch.nn.init.normal_(parameter, mean=spread, std=0.1)
    return model


def test_all_names_in_all_sizes():
    families = ("darswin_unet_a", "darswin_unet_ra", "swin_unet", "swin_unet_undis",
                "swin_unet_adapted")  # fmt: skip
    sizes = ("micro", "nano", "small", "tiny")
    assert sorted(f"{family}_{size}" for family in families for size in sizes) == sorted(DENSE)


@pytest.mark.parametrize("size", ["small", "tiny", "micro", "nano"])
def test_models_of_a_size_are_equally_large_to_1_percent(size):
    counts = []
    for name in DENSE:
        if name.endswith(size):
            with torch.device("meta"):
                model = create_model(name, num_classes=10)
            counts.append(sum(p.numel() for p in model.parameters()))
            tokens = [rows * columns for rows, columns in model.feature_info.get("map_size")]
            assert tokens[0] == 1024 and tokens[1] == 256
    assert len(counts) == 5 and max(counts) <= 1.01 * min(counts)


@pytest.mark.parametrize("name", NANOS)
@pytest.mark.parametrize("task", ["segmentation", "distance"])
def test_gradients_reach_all_parameters(name, task):
    model = network(name, task=task).train()
    out = model(torch.randn(2, 3, 64, 64), LENSES)
    assert out.shape == (2, 5 if task == "segmentation" else 1, 64, 64)
    assert model.num_classes == out.shape[1] and model.task == task
    out.log().square().sum().backward() if task == "distance" else out.square().sum().backward()
    for key, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), key
        # A window of one ring has no two rings apart: sin 0 is 0.
        alone = ".position_bias.a_theta" in key and len(parameter) == 1
        assert alone or parameter.grad.abs().sum() > 0, key
    if task == "distance":
        assert (out > 0).all() and out.isfinite().all()


@torch.no_grad()
@pytest.mark.parametrize("name", NANOS)
@pytest.mark.parametrize("lens", [LENSES, LENSES[:1], Polynomial([16.0, 0.4], 2.1), GENERAL])
def test_one_preparation_serves_many_runs_and_the_reference_agrees(name, lens):
    model = network(name, mean=0.5, std=0.2)
    prepared = model.prepare(lens, (64, 64))
    frames = torch.randint(256, (2, 64, 64, 3), dtype=torch.uint8)
    pixels = (frames.permute(0, 3, 1, 2) / 255 - 0.5) / 0.2
    for images in (torch.randn(2, 3, 64, 64), frames):
        out = model(images, lens)
        assert torch.equal(model.run(images, prepared), out) and out.isfinite().all()
    torch.testing.assert_close(model(pixels, lens), out, rtol=1e-4, atol=1e-4)
    with use_reference():
        expected = model(images, lens)
    torch.testing.assert_close(out, expected, rtol=1e-3, atol=1e-4 * expected.abs().max().item())


@torch.no_grad()
@pytest.mark.parametrize("name", NANOS)
def test_a_batch_of_lenses_is_one_by_one_and_may_be_empty(name):
    model = network(name)
    images = torch.randn(2, 3, 64, 64)
    together = model(images, LENSES)
    alone = torch.cat([model(images[k : k + 1], LENSES[k]) for k in range(2)])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-4)
    assert model(images[:0], LENSES[:0]).shape == model(images[:0], LENSES[:1]).shape
    assert model(images[:0], LENSES[:0]).shape == (0, 5, 64, 64)


@pytest.mark.parametrize("name", NANOS)
def test_what_needs_a_lens_and_which_one(name):
    model, images = network(name), torch.zeros(3, 3, 64, 64)
    if name == "swin_unet_nano":
        assert model(images).shape == (3, 5, 64, 64)
        return
    with pytest.raises(TypeError, match=r"lens must be a darswin\.lens\.Lens, got NoneType"):
        model(images)
    camera = LENSES.replace(image_size=torch.tensor([[64.0, 64.0]] * 2))
    with pytest.raises(ValueError, match=r"belongs to images of \(H, W\) = \(64, 64\), got"):
        model.prepare(camera, (80, 64))
    with pytest.raises(ValueError, match="one lens or one an image, 3, got 2"):
        model.run(images, model.prepare(camera, (64, 64)))


@pytest.mark.parametrize("name", NANOS)
def test_the_images_that_it_takes(name):
    any_size = name.startswith("darswin")
    model = network(name)
    assert model.image_size == (None if any_size else (64, 64))
    assert has_image_size(name) != any_size
    assert model.square_images != any_size
    if not any_size:
        with pytest.raises(ValueError, match=r"image_size, \(H, W\) = \(64, 64\), got \(64, 72\)"):
            model(torch.zeros(1, 3, 64, 72), LENSES[:1])
    with pytest.raises(ValueError, match="images must have 3 channels, got 4"):
        model(torch.zeros(1, 4, 64, 64), LENSES[:1])
    with pytest.raises(TypeError, match=r"images must be uint8, or torch\.float32"):
        model(torch.zeros(1, 3, 64, 64, dtype=torch.float64), LENSES[:1])


def test_wrong_options():
    for name in ("darswin_unet_a_nano", "swin_unet_nano"):
        for options, message in (
            (dict(task="classification"), r"task must be one of \('segmentation', 'distance'\)"),
            (dict(num_classes=0), "num_classes must be at least 1, got 0"),
            (dict(skip_width=-1), "skip_width must be at least 0, got -1"),
            (dict(decoder_depths=0), "decoder_depths must be an int of at least 1, or one for"),
            (dict(decoder_depths=(1, 2, 3)), r"each stage but the last, 2, got \[1, 2, 3\]"),
            (dict(task="distance", typical_distance=0), "typical_distance must be above 0 m"),
        ):
            with pytest.raises(ValueError, match=message):
                create_model(name, **options)
    model = create_model("swin_unet_nano", decoder_depths=(1, 3))
    assert [len(stage.blocks) for stage in model.decoder.stages] == [1, 3]


@pytest.mark.parametrize("name", NANOS)
def test_it_is_described_as_timm_describes_models(name):
    model = network(name, num_classes=7)
    config = model.pretrained_cfg
    assert config["architecture"] == name and config["num_classes"] == 7
    assert model.get_submodule(config["first_conv"]) is model.encoder.patch_embed.proj
    head = model.get_submodule(config["classifier"])
    assert head is model.segmentation_head.proj and head.out_features == 7
    assert config["input_size"] == (3, *(model.image_size or (128, 128)))
    assert model.feature_info.channels() == [24, 48, 96]
    undecayed = model.no_weight_decay()
    assert any(key.startswith("decoder.") for key in undecayed)
    assert all(".position_bias." in key for key in undecayed)


def test_a_new_head():
    model = network().bfloat16()
    model.set_matmul_backend("onednn")
    model.reset_classifier(3)
    assert model.num_classes == 3 and model.segmentation_head.proj.matmul_backend == "onednn"
    assert {p.dtype for p in model.parameters()} == {torch.bfloat16}
    assert not model.segmentation_head.training and model.get_classifier() is model.head
    assert model.float()(torch.zeros(1, 3, 64, 64), LENSES[:1]).shape == (1, 3, 64, 64)
    with pytest.raises(ValueError, match="num_classes must be at least 1, got 0"):
        model.reset_classifier(0)
    far = network(task="distance", typical_distance=40.0)
    far.reset_classifier(9)
    assert far.num_classes == 1 and far.distance_head.typical_distance == 40.0
    assert far.get_classifier() is far.distance_head


@torch.no_grad()
@pytest.mark.parametrize(
    ("classifier", "unet", "options"),
    [
        ("darswin_a_micro", "darswin_unet_a_micro", {}),
        ("darswin_ra_nano", "darswin_unet_ra_nano", dict(rings=8, sectors=32)),
        ("swin_nano", "swin_unet_nano", dict(image_size=32, patch_size=2)),
        ("swin_undis_nano", "swin_unet_undis_nano", dict(image_size=32, patch_size=2)),
    ],
)
def test_its_encoder_starts_from_a_trained_classifier(classifier, unet, options):
    trained = create_model(classifier, num_classes=4).eval()
    for parameter in trained.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    model = create_model(unet, num_classes=5, **options).eval()
    x, lens = torch.randn(1, 3, 32, 32), Spherical.from_fov(0.5, 2.6, 16.0)
    maps = trained.forward_intermediates(x, lens, intermediates_only=True)
    trained.reset_classifier(0)
    model.encoder.load_state_dict(trained.state_dict())
    if "undis" in classifier:  # the unet makes the view
        x = model.view.look(x, model.view.prepare(lens, (32, 32)).there)
    got = model.encoder.forward_intermediates(x, lens, intermediates_only=True)
    assert all(torch.equal(a, b) for a, b in zip(got, maps, strict=True))


@pytest.mark.parametrize("task", ["segmentation", "distance"])
def test_a_saved_model_computes_the_same(tmp_path, task):
    options = dict(num_classes=3, in_chans=1, task=task, skip_width=4)
    card = ModelCard(
        "darswin_unet_ra_nano", options, ["a", "b", "c"], 64, task=task,
        colors=[[0, 0, 0], [255, 0, 0], [0, 0, 255]],
    )  # fmt: skip
    model = card.create().eval()
    save_model(tmp_path / "m.safetensors", model.state_dict(), card)
    loaded, read = load_model(tmp_path / "m.safetensors")
    assert read == card and loaded.task == task and not loaded.training
    assert loaded.pretrained_cfg["input_size"] == (1, 64, 64)
    images = torch.rand(2, 1, 64, 64)
    assert torch.equal(loaded(images, LENSES), model(images, LENSES))


@pytest.mark.parametrize("name", ["darswin_unet_a_nano", "swin_unet_adapted_nano"])
def test_gradients_with_checkpointing_are_the_same(name):
    model = network(name).train()
    images, lens = torch.randn(2, 3, 64, 64), LENSES
    if name.startswith("darswin"):
        model.encoder.patch_embed.sample.jitter = 0.0
    gradients = []
    for enable in (False, True):
        model.set_grad_checkpointing(enable)
        assert model.decoder.stages[0].blocks[0].grad_checkpointing == enable
        loss = model(images, lens).square().sum()
        gradients.append(torch.autograd.grad(loss, list(model.parameters())))
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


@pytest.mark.parametrize("name", NANOS)
def test_it_learns(name):
    """Which side of an edge a pixel is on: 30 steps find it to a pixel or two."""
    torch.manual_seed(0)
    options = {} if name.startswith("darswin") else dict(image_size=64)
    model = create_model(name, num_classes=2, in_chans=1, **options)
    lens = Spherical.from_fov(0.5, 2.6, 32.0)
    images = torch.randn(4, 1, 64, 64) * 0.1
    labels = torch.zeros(4, 64, 64, dtype=torch.long)
    for k, edge in enumerate((20, 28, 36, 44)):
        labels[k, :, edge:] = 1
    images += labels[:, None]
    optimizer = torch.optim.AdamW(model.parameters(), lr=5e-3)
    for _ in range(30):
        loss = F.cross_entropy(model(images, lens), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        right = (model.eval()(images, lens).argmax(1) == labels).float()
    assert right[:, 12:52, 12:52].mean() > 0.97


# -- optimize ---------------------------------------------------------------------------------


def error(got, want):
    return ((got.float() - want).norm() / want.norm()).item()


@torch.no_grad()
@pytest.mark.parametrize("name", NANOS)
@pytest.mark.parametrize("task", ["segmentation", "distance"])
def test_optimized_it_is_the_same(name, task):
    model = network(name, task=task)
    images = torch.randn(2, 3, 64, 64)
    want = model(images, LENSES)
    fast = optimize(model)
    assert error(fast(images, LENSES), want) < 1e-5
    assert torch.equal(fast.run(images, fast.prepare(LENSES, (64, 64))), fast(images, LENSES))
    fixed = optimize(model, lens=LENSES[:1])
    assert error(fixed(images), model(images, LENSES[:1])) < 1e-5
    maps = model.encoder.forward_intermediates(images, LENSES, intermediates_only=True)
    for got, expected in zip(fast.encoder.maps(images, fast.encoder.prepare(LENSES, (64, 64))),
                             maps, strict=True):  # fmt: skip
        assert error(got, expected) < 1e-5
    with torch.autocast("cpu", torch.bfloat16):
        autocast = error(model(images, LENSES), want)
    half = optimize(model, torch.bfloat16)(images, LENSES)
    assert half.dtype == (torch.bfloat16 if task == "segmentation" else torch.float32)
    assert error(half, want) < 2 * autocast < 0.1


@torch.no_grad()
def test_an_optimized_model_prepares_a_fixed_lens_once(monkeypatch):
    model, images = network(), torch.randint(256, (1, 80, 64, 3), dtype=torch.uint8)
    fixed = optimize(model, lens=LENSES[:1])
    want = model(images, LENSES[:1])
    assert error(fixed(images), want) < 1e-5
    monkeypatch.setattr(type(LENSES), "project", None)
    assert error(fixed(images), want) < 1e-5
    with pytest.raises(ValueError, match="call it without one"):
        fixed(images, LENSES[:1])
    with pytest.raises(TypeError, match="neither copied nor pickled"):
        copy.deepcopy(fixed)
    with pytest.raises(TypeError, match="not saved"):
        fixed.state_dict()
    with torch.enable_grad(), pytest.raises(RuntimeError, match="has no gradients"):
        fixed(torch.rand(1, 3, 80, 64, requires_grad=True))
