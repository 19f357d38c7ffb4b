"""The contract of all models in `list_models()`: their inputs, results, errors and descriptions,
and graphs of them. tests/deploy/test_contract.py optimizes, saves and quantizes them.

The expectations for intermediates and pruning were compared with timm's own Swin (1.0.31).
"""

import copy
import math
from collections import defaultdict
from functools import cache

import pytest
import torch
from helpers import CAMERAS, network, product, products, refused, side_of, slow_but
from torch._dynamo.testing import CompileCounter

from darswin import create_model, list_models, optimize
from darswin.lens import KannalaBrandt, Polynomial, Spherical, cat
from darswin.models import registry
from darswin.models.conv_unet import ConvUnet
from darswin.models.encoder import Encoder
from darswin.models.features import take_indices
from darswin.models.registry import has_image_size, model_class
from darswin.ops import linear, use_reference
from darswin.views import make_view

NAMES = list_models()
TRANSFORMERS = [name for name in NAMES if not issubclass(model_class(name), ConvUnet)]
ENCODERS = [name for name in NAMES if issubclass(model_class(name), Encoder)]
NANOS = [name for name in NAMES if name.endswith("nano")]
NANO_ENCODERS = [name for name in NANOS if name in ENCODERS]
NANO_UNETS = [name for name in NANOS if name not in ENCODERS]
WITH_VIEWS = ("swin_nano perspective", "swin_unet_nano perspective", "swin_unet_nano square")
IGNORE_THE_LENS = ("swin_nano", "swin_unet_nano", "dat_nano")
ONE_OF_EACH_KIND = ("darswin_a_nano", "swin_nano", "darswin_unet_a_nano", WITH_VIEWS[1])
IN_GRAPHS = ("darswin_unet_ra_nano", "dat_nano", "swin_unet_nano", "conv_unet_nano")
CASES = {name: (name, {}) for name in NANOS} | {
    case: (case.split()[0], dict(view=case.split()[1])) for case in WITH_VIEWS
} | {
    "darswin_unet_a_nano distance": ("darswin_unet_a_nano", dict(task="distance")),
    "swin_unet_nano perspective distance": (
        "swin_unet_nano",
        dict(task="distance", view="perspective"),
    ),
    "official": ("official", {}),
    "feature maps": ("darswin_ra_nano", dict(features_only=True, out_indices=(0, 2))),
    "square view": ("swin_nano", dict(view=dict(name="square", spacing="g"))),
    "conv_unet_nano mercator": (
        "conv_unet_nano",
        dict(view=dict(name="mercator", size=[36, 28], fov=2.6)),
    ),
    "swin_unet_nano equirectangular distance": (
        "swin_unet_nano",
        dict(
            task="distance", window=[4, 6],
            view=dict(name="equirectangular", size=[64, 96], fov=2.6),
        ),
    ),
}  # fmt: skip
cases = pytest.mark.parametrize("case", CASES)
nanos = pytest.mark.parametrize("name", NANOS)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def made(case, **options):
    """A model, images and their lenses."""
    name, own = CASES[case]
    side = side_of(name)
    lenses = Spherical.from_fov([0.2, 0.9], 2.6, side / 2)
    if name == "conv_unet_nano":  # it has no blocks
        options.pop("drop_path_rate", None)
    return network(name, **(own | options)), torch.randn(2, 3, side, side), lenses


def tensors_of(out):
    return [out] if isinstance(out, torch.Tensor) else out


def total(out):
    return sum(tensor.square().mean() for tensor in tensors_of(out))


def assert_close(got, expected, tolerance=1e-4):
    """Compares tensors. The tolerance is relative to the largest number of each."""
    for a, b in zip(tensors_of(got), tensors_of(expected), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * b.abs().max().item())


def assert_equal(got, expected):
    """Compares tensors bit for bit."""
    assert all(
        torch.equal(a, b) for a, b in zip(tensors_of(got), tensors_of(expected), strict=True)
    )


def assert_gradients_close(model, got, expected, tolerance=1e-4):
    """Compares the gradients of all parameters.

    The tolerance is relative to the largest gradient of the module. It is not relative to each
    gradient itself, because some gradients are 0 except for rounding. An example is the `b_theta`
    of a window of one ring: it adds the same number to all logits, which softmax ignores.
    """
    modules = [name.rpartition(".")[0] for name, _ in model.named_parameters()]
    scales = defaultdict[str, float](float)
    for module, b in zip(modules, expected, strict=True):
        scales[module] = max(scales[module], b.abs().max().item())
    for module, a, b in zip(modules, got, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=tolerance * scales[module], msg=module)


# -- results --------------------------------------------------------------------------------------


@cases
def test_gradients_reach_all_parameters(case):
    model, images, lenses = made(case)
    out = model.train()(images, lenses)
    if "unet" in case:
        assert model.num_classes == out.shape[1] == (1 if "distance" in case else 5)
        assert out.shape[2:] == images.shape[2:]
    loss = out.log().square().mean() if "distance" in case else total(out)
    loss.backward()
    for key, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), key
        # In a window of one ring, Δθ is 0. sin Δθ is 0, and softmax ignores cos Δθ, which is the
        # same for all logits.
        alone = ".position_bias." in key and len(parameter) == 1
        assert alone or parameter.grad.any(), key


@torch.no_grad()
@cases
def test_one_preparation_serves_pixels_of_any_kind_and_the_reference_agrees(case):
    model, images, lenses = made(case, mean=MEAN, std=STD)
    size = tuple(images.shape[2:])
    frames = torch.randint(256, (2, *size, 3), dtype=torch.uint8)
    planes = frames.permute(0, 3, 1, 2).contiguous()
    mean, std = torch.tensor([MEAN, STD])[..., None, None]
    others = [Polynomial([size[0] / 4, 0.4], 1.3)]
    if case != "official":
        affine, tangential = [[1.0, 0.1], [0.0, 1.1]], [0.02, 0.01]
        general = KannalaBrandt(9.0, [0.01], 1.5, affine=affine, tangential=tangential)
        others = [CAMERAS[0].resized(size), general]
    for lens in (lenses, *others):
        prepared = model.prepare(lens, size)
        for pixels in (frames, planes):
            out = model(pixels, lens)
            assert_equal(model.run(pixels, prepared), out)
        assert all(tensor.isfinite().all() for tensor in tensors_of(out))
        assert_close(model.run((planes / 255 - mean) / std, prepared), out, 1e-3)
        with use_reference():
            assert_close(out, model(planes, lens), 1e-3)


@torch.no_grad()
@cases
def test_the_pixels_that_it_takes_sampled_already(case):
    """tests/deploy/test_contract.py compares the results in float32."""
    model, images, lenses = made(case, mean=MEAN, std=STD)
    size = tuple(images.shape[2:])
    prepared, expected = model.prepare(lenses, size), model(images, lenses)
    sampled = model.sample(images, prepared)
    wrong = "the size of the view" if model.view.in_pixels else r"shape .* = \(any, .*\), got"
    refused(f"sampled must have {wrong}", model.run_sampled, sampled[..., :-1], prepared, images)
    if model.uses_lens:
        with pytest.raises(ValueError, match="one for each of the 1 images, got 2"):
            model.run_sampled(sampled[:1], prepared, images[:1])
    for dtype in (torch.int32, torch.float16, torch.float64, torch.bfloat16):
        if model.view.in_pixels or dtype in (torch.int32, torch.float16):
            with pytest.raises(TypeError, match=rf"sampled must be .*, got {dtype}"):
                model.run_sampled(sampled.to(dtype), prepared, images)
        else:
            assert_close(model.run_sampled(sampled.to(dtype), prepared, images), expected, 0.1)
    if model.view.in_pixels:  # such as a camera's undistorted frames
        frames = torch.randint(256, sampled.shape, dtype=torch.uint8)
        expected = model.run_sampled(model.view.normalized(frames, torch.float32), prepared)
        assert_equal(model.run_sampled(frames, prepared), expected)
    elif "unet" in case:
        refused("images are missing", model.run_sampled, sampled, prepared, error=TypeError)
    elif case != "official":
        assert sampled.shape == (2, 8, 32, 4 * 4 * 3)
        double = copy.deepcopy(model).double()
        got = double.run_sampled(sampled, double.prepare(lenses.to(torch.float64), size))
        assert_close(tensors_of(got), [t.double() for t in tensors_of(expected)])


@cases
def test_a_preparation_without_gradients_is_refused_in_training(case):
    model, images, lenses = made(case)
    size = tuple(images.shape[2:])
    with torch.no_grad():
        prepared = model.prepare(lenses, size)
        sampled = model.sample(images, prepared)
    runs = (
        lambda prepared: model.run(images, prepared),
        lambda prepared: model.run_sampled(sampled, prepared, images),
    )
    has_biases = bool(model.no_weight_decay())
    assert has_biases == ("conv_unet" not in case)
    for run in runs:
        run(prepared)
        model.train()
        run(model.prepare(lenses, size))
        with torch.no_grad():
            run(prepared)
        if has_biases:
            refused("without gradients, so the position biases would", run, prepared)
        for name in model.no_weight_decay():
            model.get_parameter(name).requires_grad_(False)
        run(prepared)
        model.requires_grad_(True).eval()


@torch.no_grad()
@cases
def test_a_batch_is_one_image_after_the_other_and_may_be_empty(case):
    model, images, lenses = made(case)
    if case == "official":  # it uses the field of view of image 0 for all images
        lenses = Spherical(lenses.xi, lenses.focal, 1.3)
    together = tensors_of(model(images, lenses))
    alone = [tensors_of(model(images[k : k + 1], lenses[k])) for k in range(2)]
    assert_close([torch.cat(pair) for pair in zip(*alone, strict=True)], together)
    for lens in (lenses[:0], lenses[:1]):
        for empty, out in zip(tensors_of(model(images[:0], lens)), together, strict=True):
            assert empty.shape == (0, *out.shape[1:])


@pytest.mark.parametrize(("name", "half"), product(NANOS, [False, True]))
def test_a_training_step_repeats_with_a_seed_with_checkpointing_and_other_products(
    name, half, monkeypatch
):
    model, images, lenses = made(name, drop_path_rate=0.2)
    parameters, found = [*model.train().parameters()], {}
    monkeypatch.setattr(linear, "LEAST_ROWS", 1)
    # Under autocast all products are torch's.
    for ours in (False,) if half else (False, True):
        monkeypatch.setattr(linear, "IS_FASTER", ours)
        for enable in (False, False, True):
            model.set_grad_checkpointing(enable)
            torch.manual_seed(5)  # of jitter and drop path
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                out = model(images, lenses)
            gradients = torch.autograd.grad(total(out), parameters)
            assert_equal(gradients, found.setdefault(ours, gradients))
    assert_gradients_close(model, found[not half], found[False])


@torch.no_grad()
@nanos
def test_dtypes(name):
    model, images, lenses = made(name, mean=MEAN, std=STD)
    frames = torch.randint(256, tuple(images.shape), dtype=torch.uint8)
    mean, std = torch.tensor([MEAN, STD], dtype=torch.float64)[..., None, None]
    expected = model(frames, lenses)
    with torch.autocast("cpu", dtype=torch.bfloat16):  # converts images and weights to one dtype
        for dtype in (torch.float32, torch.bfloat16):
            half = model(images.to(dtype), lenses)
            assert half.dtype == torch.bfloat16 or "unet" in name
            assert_close(half.float(), model.float()(images, lenses).float(), 0.2)
    for dtype, tolerance in ((torch.float64, 1e-5), (torch.bfloat16, 0.1)):
        got = model.to(dtype)(frames, lenses)
        assert got.dtype == dtype
        assert (got.float() - expected).norm() <= tolerance * expected.norm()
        message = f"images must be uint8 or {dtype}, the dtype of the weights, got torch.float32"
        refused(message, model, images, lenses, error=TypeError)
    exact = model.double()((frames.double() / 255 - mean) / std, lenses)
    assert_close(model(frames, lenses), exact, 1e-10)


# -- inputs -------------------------------------------------------------------------------


@cases
def test_the_images_and_the_lens_that_it_takes(case):
    model, images, lenses = made(case)
    name, side = CASES[case][0], images.shape[2]
    any_size = name.startswith(("darswin", "conv", "official"))
    assert model.image_size == (None if any_size else (side, side))
    assert case == "official" or has_image_size(name) != any_size
    assert model.square_images == (not any_size or case == "official")
    refused("images must have 3 channels, got 4", model, torch.zeros(1, 4, side, side), lenses[:1])
    refused("images must be a tensor, got list", model, [1], lenses, error=TypeError)
    refused(r"shape \(B, C, H, W\), got \(3, 8, 8\)", model, torch.zeros(3, 8, 8), lenses)
    if any_size and case != "official":
        for size in ((1, 1), (17, 40)):
            images = torch.randn(2, 3, *size)
            out = model(images, lenses)
            assert "unet" not in name or out.shape[2:] == size
            with use_reference():
                assert_close(out, model(images, lenses), 1e-3)
    else:
        with pytest.raises(ValueError, match=r"image_size, \(H, W\) = |needs square images, got"):
            model(torch.zeros(1, 3, side, side + 8), lenses[:1])
    if case in IGNORE_THE_LENS:
        model.requires_grad_(False)
        for lens in (lenses, "no lens at all"):
            assert torch.equal(model(images, lens), model(images))
        return
    refused(r"lens must be a darswin\.lens\.Lens, got NoneType", model, images, error=TypeError)
    camera = lenses.replace(image_size=torch.tensor([[side, side]] * 2))
    with pytest.raises(ValueError, match=rf"belongs to images of \(H, W\) = \({side}, {side}\), g"):
        model.prepare(camera, (side + 8, side))
    with pytest.raises(ValueError, match="each of the 3 images, got 2"):
        model.run(images[[0, 0, 1]], model.prepare(camera, (side, side)))


@torch.no_grad()
def test_a_batch_of_several_lens_models_is_each_of_them():
    spherical = Spherical.from_fov(0.7, 3.0, 48.0, center=[63.5, 47.5], image_size=(96, 128))
    lenses = [CAMERAS[0], CAMERAS[1].replace(tangential=None), spherical]
    lenses = [lens.resized((96, 128)) for lens in lenses]
    model, images = network("darswin_a_nano"), torch.rand(3, 3, 96, 128)
    alone = [model(images[k : k + 1], lens) for k, lens in enumerate(lenses)]
    assert_close(model(images, cat(lenses)), torch.cat(alone), 2e-5)


WRONG = [
    ("darswin_a_nano", dict(variant="B"), "variant must be 'A' or 'RA', got 'B'"),
    ("darswin_a_nano", dict(depths=(2, 2)), "depths and num_heads must pair up"),
    ("darswin_a_nano", dict(spacing="log"), "spacing must be one of"),
    ("darswin_a_nano", dict(position_bias="rotary"), "position_bias must be"),
    ("darswin_a_nano", dict(jitter=3.0), "jitter must be"),
    ("darswin_a_nano", dict(num_heads=(5, 5, 5)), "num_heads must divide"),
    ("darswin_a_nano", dict(drop_path_rate=1.0), "drop path must be"),
    ("darswin_a_nano", dict(num_classes=-1), "num_classes must be at least 0, got -1"),
    ("darswin_a_nano", dict(in_chans=0), "in_chans must be at least 1, got 0"),
    ("darswin_a_nano", dict(embed_dim=0), "embed_dim must be at least 1, got 0"),
    ("darswin_a_nano", dict(mlp_ratio=0.04), "embed_dim · mlp_ratio must be at least 1, got 0.96"),
    ("darswin_a_nano", dict(mlp_ratio=math.nan), "embed_dim · mlp_ratio must be at least 1, got"),
    ("darswin_a_nano", dict(depths=(1, -1, 1)), "depths must be at least 0, got -1"),
    ("darswin_a_nano", dict(num_heads=(1, 0, 4)), "num_heads must be at least 1, got 0"),
    ("darswin_a_nano", dict(window=(0, 4)), "window must be at least 1 along both axes"),
    ("darswin_a_nano", dict(position_bias="polar", harmonics=0), "harmonics must be at least 1"),
    ("swin_nano", dict(patch_size=0), r"divide the view's .* = \(32, 32\), got 0"),
    ("swin_nano", dict(window=(4, 0)), "window must be at least 1 along both axes"),
    ("dat_nano", dict(groups=(1, 1, 0)), "groups must divide num_heads = 4, got 0"),
    ("darswin_a_nano", dict(sectors=30), "window"),
    ("darswin_a_nano", dict(std=0.0), "std must be positive"),
    ("darswin_a_nano", dict(merges=((1, 4),)), "merges must have one .* but the first, 2, got"),
    ("darswin_a_nano", dict(merges=((1, 4), (3, 1))), r"\(8, 8\) cannot be merged by \(3, 1\)"),
    ("darswin_a_nano", dict(merges=((1, 4), (0, 1))), "merges must be at least 1"),
    ("swin_nano", dict(view="round"), "view must be one of .*, got 'round'"),
    ("swin_nano", dict(image_size=33), r"divide the view's .* = \(33, 33\), got 2"),
    ("swin_nano", dict(image_size=36), r"stage 1: window \(4, 4\) must divide the map, \(18,"),
    ("swin_nano", dict(image_size=24), r"stage 2: window \(4, 4\) must divide the map, \(6, 6"),
    ("swin_nano", dict(view=dict(name="perspective", fov=4)), r"fov must be in \(0, 3.14\] rad"),
    ("swin_nano", dict(view=dict(fov=1.0)), "view must have a name, got {'fov': 1.0}"),
    ("swin_nano", dict(view=make_view("mercator", 32), mean=0.4), "its own mean: leave them"),
    ("conv_unet_nano", dict(view=make_view("mercator", 32), size=32), "has its own size: leave"),
    *(("conv_unet_nano", dict(widths=wrong), "widths must be at least 1")
      for wrong in ((), (0,), (8, -1))),
    ("swin_nano", dict(view=make_view("none", 64)), r"must have image_size = \(32, 32\), got"),
    ("dat_nano", dict(blocks=("L", "N", "D")), "blocks must be of the kinds 'L', 'S' and 'D'"),
    ("dat_nano", dict(blocks=("L", "", "D")), "blocks must be of the kinds"),
    ("dat_nano", dict(blocks=("L", "D")), "one entry for each stage, 3"),
    ("dat_nano", dict(groups=(1, 1, 3)), "groups must divide num_heads = 4, got 3"),
    ("dat_nano", dict(num_heads=(5, 5, 5)), "num_heads must divide"),
    ("swin_unet_nano", dict(image_size=66), r"divide the view's .* = \(66, 66\), got 4"),
    ("swin_unet_nano", dict(view=dict(name="square", spacing="r")), "spacing must be one of .*'r'"),
    ("swin_unet_nano", dict(view="square", image_size=(64, 128)), r"be square, got \(64, 128\)"),
] + [
    (name, options, message)
    for name in ("darswin_unet_a_nano", "swin_unet_nano")
    for options, message in (
        (dict(task="classification"), r"task must be one of \('segmentation', 'distance'\)"),
        (dict(num_classes=0), "num_classes must be at least 1, got 0"),
        (dict(skip_width=-1), "skip_width must be at least 0, got -1"),
        (dict(decoder_depths=0), "decoder_depths must be an int of at least 1, or one int for"),
        (dict(decoder_depths=(1, 2, 3)), r"stage but the last, 2, got \[1, 2, 3\]"),
        (dict(task="distance", typical_distance=0), "typical_distance must be above 0 m"),
        (dict(task="distance", typical_distance=math.inf), "typical_distance must be above 0 m"),
        (dict(task="distance", typical_distance=math.nan), "typical_distance must be above 0 m"),
    )
]  # fmt: skip


@pytest.mark.parametrize(("name", "options", "message"), WRONG)
def test_wrong_options(name, options, message):
    refused(message, create_model, name, **options)


def test_a_view_has_options_of_its_own():
    unknown = dict(view=dict(name="perspective", spacing="g"))
    refused("got an unexpected keyword", create_model, "swin_nano", fov=1.0, error=TypeError)
    refused("has no option", create_model, "swin_unet_nano", **unknown, error=TypeError)


@torch.no_grad()
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("name", ONE_OF_EACH_KIND)
def test_uint8_images_have_as_many_channels_as_the_model_takes(name, channels):
    model, side = network(name, in_chans=channels, mean=0.5, std=0.2), side_of(name)
    lenses = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)
    sizes = ((side, side), (20, 7 - channels), (1, 1))[: 1 if model.image_size else 3]
    for size in sizes:
        planes = torch.randint(256, (2, channels, *size), dtype=torch.uint8)
        expected = model((planes / 255 - 0.5) / 0.2, lenses)
        if size != (1, 1) or channels == 1:  # 1 × 1 × C is ambiguous
            assert_close(model(planes.permute(0, 2, 3, 1), lenses), expected, 1e-3)
        assert_close(model(planes, lenses), expected, 1e-3)
    for shape, message in (
        ((2, channels, side, channels), r"both have .*: pass it in floating point"),
        ((2, side, side, 2), rf"neither has in shape \(2, {side}, {side}, 2\)$"),
        ((2, 12, side, side), rf"neither has in shape \(2, 12, {side}, {side}\)$"),
    ):
        with pytest.raises(ValueError, match=f"uint8 must have {channels} channels .*{message}"):
            model.run(torch.zeros(shape, dtype=torch.uint8), None)


# -- descriptions, heads, files -------------------------------------------------------------------

# The parameters of the "small" models with 200 and with 1000 classes.
PARAMETERS = {
    "darswin_a_small": (48_977_864, 49_593_064),
    "swin_small": (48_953_762, 49_568_962),
    "dat_small": (49_006_434, 49_621_634),
}


@cache
def described(name):
    """A model on "meta", and its number of parameters."""
    with torch.device("meta"):
        model = create_model(name)
    return model, sum(p.numel() for p in model.parameters())


@pytest.mark.parametrize("name", NAMES)
def test_sizes(name):
    model, count = described(name)
    of_its_size = f"darswin{'_unet' * ('unet' in name)}_a_{name.split('_')[-1]}"
    other, expected = described(of_its_size)
    if name not in TRANSFORMERS:
        assert abs(count / expected - 1) < 0.12
        return
    assert abs(count / expected - 1) < (0.01 if "unet" in name else 0.03), (count, expected)
    sides = [net.feature_info.get("map_size", 0) for net in (model, other)]
    assert sides[0][0] * sides[0][1] == sides[1][0] * sides[1][1]  # tokens of the first map
    width = 24 if "nano" in name else 32 if "micro" in name else 96
    assert model.feature_info.channels() == [width * 2**k for k in range(len(model.feature_info))]
    for classes, count in zip((200, 1000), PARAMETERS.get(name, ()), strict=False):
        changed = copy.deepcopy(model)
        changed.reset_classifier(classes)
        assert sum(p.numel() for p in changed.parameters()) == count


def test_a_model_is_registered_in_four_sizes(monkeypatch):
    monkeypatch.setattr(registry, "_MODELS", {})

    @registry.register_model("ours", presets=dict(nano=dict(embed_dim=8)), variant="A")
    class Ours(Encoder):
        def __init__(self, **options):
            super().__init__()
            self.options = options

    names = [f"ours_{size}" for size in ("micro", "nano", "small", "tiny")]
    assert registry.list_models() == names
    assert all(registry.model_class(name) is Ours for name in names)
    nano, small = (create_model(f"ours_{size}").options for size in ("nano", "small"))
    # A preset overrides the option of its size.
    assert nano["embed_dim"] == 8 and small["embed_dim"] == 96
    assert nano.keys() == small.keys() and nano["variant"] == small["variant"] == "A"
    assert create_model("ours_nano", variant="B").options["variant"] == "B"
    with pytest.raises(ValueError, match="unknown model 'swin_nano'; did you mean ours_nano or "):
        registry.model_class("swin_nano")


@nanos
def test_it_is_described_as_timm_describes_models(name):
    model, config = network(name, num_classes=7), create_model(name, num_classes=7).pretrained_cfg
    if name in TRANSFORMERS:
        encoder, part = (model.encoder, "encoder.") if name in NANO_UNETS else (model, "")
        assert config["first_conv"] == f"{part}patch_embed.proj"
        assert model.get_submodule(config["first_conv"]) is encoder.patch_embed.proj
    assert config["architecture"] == name and config["num_classes"] == model.num_classes == 7
    head = model.get_submodule(config["classifier"])
    assert head is getattr(model.get_classifier(), "proj", model.head) and head.out_features == 7
    assert config["fixed_input_size"] == has_image_size(name)
    assert model.pretrained_cfg["input_size"] == (3, *(model.image_size or [2 * side_of(name)] * 2))
    assert config["mean"] == (0, 0, 0) and config["std"] == (1, 1, 1)
    undecayed = model.no_weight_decay()
    names = {key for key, _ in model.named_parameters()}
    assert undecayed == {key for key in names if ".position_bias." in key}
    assert len(undecayed) > 3 or name not in TRANSFORMERS


@nanos
def test_a_new_head_is_of_the_models_kind(name):
    model, images, lenses = made(name)
    model.bfloat16()
    for classes in (7, 3):
        model.reset_classifier(classes)
        head = model.get_submodule(model.pretrained_cfg["classifier"])
        assert head.out_features == model.num_classes == classes
        assert not head.training
    assert {p.dtype for p in model.parameters()} == {torch.bfloat16}
    assert model(images.bfloat16(), lenses).shape[:2] == (2, 3)
    if name in NANO_UNETS:
        refused("num_classes must be at least 1, got 0", model.reset_classifier, 0)
        return
    model.to("meta").reset_classifier(4)
    assert model.head.weight.device.type == "meta"
    model.reset_classifier(0)
    assert isinstance(model.head, torch.nn.Identity) and model.num_classes == 0


# -- intermediates, as timm has them --------------------------------------------------------------


@torch.no_grad()
@pytest.mark.parametrize("name", ENCODERS)
def test_what_a_model_tells_of_its_stages_is_what_they_give(name):
    model = create_model(name, num_classes=5, depths=(1,) * (3 if "nano" in name else 4)).eval()
    height, width = model.image_size or (32, 32)
    x, lens = torch.randn(1, 3, height, width), Spherical.from_fov(0.4, 2.6, height / 2)
    info = model.feature_info
    maps = model.forward_intermediates(x, lens, intermediates_only=True)
    assert [m.shape[3] for m in maps] == info.channels()
    assert [tuple(m.shape[1:3]) for m in maps] == info.get("map_size")
    assert model.num_features == model.head_hidden_size == info.channels(-1)
    # The size of a map is that of the images, or of the sampling grid, divided by the reduction.
    whole = model.image_size or [
        count * s for count, s in zip(info[0]["map_size"], model.view.samples, strict=True)
    ]
    for (rows, columns), reduction in zip(info.get("map_size"), info.reduction(), strict=True):
        assert max(whole[0] // rows, whole[1] // columns) == reduction
    assert [model.get_submodule(module) for module in info.module_name()] == [*model.stages]
    assert info.channels([0, -1]) == [info.channels(0), info.channels(-1)]


def stages_that_run(model, x, lens, **options):
    """The stages that compute intermediates, and the result."""
    ran = []
    hooks = [
        stage.register_forward_hook(lambda *_, k=k: ran.append(k))
        for k, stage in enumerate(model.stages)
    ]
    out = model.forward_intermediates(x, lens, **options)
    for hook in hooks:
        hook.remove()
    return ran, out


@pytest.mark.compiled
@torch.no_grad()
@pytest.mark.parametrize("optimized", [False, True])
@pytest.mark.parametrize("name", NANO_ENCODERS)
def test_the_intermediates_that_timm_gives(name, optimized):
    model, x, lens = made(name)
    model = optimize(model) if optimized else model
    features, every = model.forward_intermediates(x, lens)
    assert torch.equal(features, model.forward_features(x, lens))
    assert torch.equal(features, model.norm(every[-1]))
    assert torch.equal(model.forward_head(features, pre_logits=True), features.mean((1, 2)))
    assert torch.equal(model.forward_head(features), model(x, lens))
    for indices, stages in (
        (None, [0, 1, 2]), (1, [2]), ([0], [0]), ([1, 0], [0, 1]), ([-2, 1], [1]), ((0, -1), [0, 2])
    ):  # fmt: skip
        last, maps = model.forward_intermediates(x, lens, indices=indices)
        assert torch.equal(last, features) and len(maps) == len(stages)
        assert all(torch.equal(m, every[k]) for m, k in zip(maps, stages, strict=True))
        chosen = dict(indices=indices, intermediates_only=True)
        normed = model.forward_intermediates(x, lens, norm=True, **chosen)
        for got, k in zip(normed, stages, strict=True):
            assert torch.equal(got, features if k == 2 else every[k])
        end = max(stages)
        early = dict(indices=indices, stop_early=True, output_fmt="NCHW")
        ran, (last, maps) = stages_that_run(model, x, lens, **early)
        assert ran == [0, 1, 2][: end + 1]
        assert torch.equal(last, features if end == 2 else every[end])
        for got, k in zip(maps, stages, strict=True):
            assert got.is_contiguous() and torch.equal(got, every[k].permute(0, 3, 1, 2))
        ran, _ = stages_that_run(model, x, lens, **chosen)
        assert ran == [0, 1, 2]


@pytest.mark.compiled
@torch.no_grad()
@pytest.mark.parametrize("name", NANO_ENCODERS)
def test_pruning_and_feature_maps(name):
    model, x, lens = made(name)
    every = model.forward_intermediates(x, lens, intermediates_only=True)
    pruned = copy.deepcopy(model)
    assert pruned.prune_intermediate_layers([0, -2]) == [0, 1]
    assert len(pruned.stages) == len(pruned.feature_info) == 2
    assert torch.equal(pruned.forward_features(x, lens), every[1])
    assert pruned(x, lens).shape == (2, 48) and pruned.num_features == 48
    pruned.reset_classifier(7)
    assert pruned(x, lens).shape == (2, 7)
    whole = copy.deepcopy(model)  # no stage is removed, so the norm stays, and the head if wanted
    assert whole.prune_intermediate_layers(1, prune_head=False) == [2]
    assert torch.equal(whole(x, lens), model(x, lens))
    whole.prune_intermediate_layers(prune_norm=True)
    assert torch.equal(whole.forward_features(x, lens), every[2]) and whole.num_classes == 0
    sized = dict(image_size=32) if has_image_size(name) else {}
    for out_indices, stages in ((None, [0, 1, 2]), ([0], [0]), ((1, 0), [0, 1]), (2, [1, 2])):
        for output_fmt in ("NHWC", "NCHW"):
            maps = create_model(name, features_only=True, out_indices=out_indices,
                                output_fmt=output_fmt, **sized).eval()  # fmt: skip
            names = {f"encoder.{key}": value for key, value in model.state_dict().items()}
            assert not any(key.startswith(("encoder.norm", "encoder.head")) for key in
                           maps.state_dict())  # fmt: skip
            maps.load_state_dict({key: names[key] for key in maps.state_dict()})
            for k, one in zip(stages, maps(x, lens), strict=True):
                expected = every[k] if output_fmt == "NHWC" else every[k].permute(0, 3, 1, 2)
                assert torch.equal(one, expected) and one.is_contiguous()
            info = maps.feature_info
            assert info.channels() == model.feature_info.channels(stages)
            for module, k in zip(info.module_name(), stages, strict=True):
                assert maps.get_submodule(module) is maps.encoder.stages[k]
            first = maps.get_submodule(maps.pretrained_cfg["first_conv"])
            assert first is maps.encoder.patch_embed.proj and maps.num_classes == 0
            assert maps.image_size == model.image_size and maps.out_indices == tuple(stages)
            assert len(maps.encoder.stages) == max(stages) + 1


def test_wrong_arguments_of_intermediates():
    model, x, lens = made("darswin_a_nano")
    maps = dict(features_only=True)
    for wrong in (0, 4, -1, [3], [-4], []):
        said = "indices must name some of 3 stages, got"
        refused(said, model.forward_intermediates, x, lens, indices=wrong)
        refused(said, create_model, "swin_nano", **maps, out_indices=wrong)
    said = "output_fmt must be 'NHWC' or 'NCHW', got 'NLC'"
    refused(said, model.forward_intermediates, x, lens, output_fmt="NLC")
    refused(said, create_model, "swin_nano", **maps, output_fmt="NLC")
    refused("and output_fmt need features_only=True", create_model, "swin_nano", out_indices=[0])
    refused("for encoders, but swin_unet_nano is", create_model, "swin_unet_nano", **maps)
    assert take_indices(4, 2) == [2, 3] and take_indices(4, (-1, 0)) == [3, 0]


# -- graphs ---------------------------------------------------------------------------------------


@pytest.fixture
def no_graphs_before_or_after():
    """Clears torch.compile's cache, which keeps at most eight graphs of the shared forward."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


@pytest.mark.slow
@pytest.mark.usefixtures("no_graphs_before_or_after")
@pytest.mark.parametrize("name", slow_but(NANOS, *IN_GRAPHS, marks=products))
def test_one_graph_at_any_batch_size_with_the_same_results(name):
    model, _, _ = made(name, drop_path_rate=0.1)
    model.set_grad_checkpointing()  # without effect: in a graph the compiler decides this
    side, counter = side_of(name), CompileCounter()
    compiled = torch.compile(model.train(), fullgraph=True, dynamic=True, backend=counter)
    for batch in (2, 3, 5):
        lens = Spherical.from_fov(torch.linspace(0.2, 0.9, batch), 2.6, side / 2)
        assert compiled(torch.randn(batch, 3, side, side), lens).shape[:2] == (batch, 5)
    assert counter.frame_count == 1
    torch._dynamo.reset()
    model, images, lenses = made(name)
    with torch.no_grad():
        eager = torch.compile(model, fullgraph=True, backend="aot_eager")
        assert_close(eager(images, lenses), model(images, lenses), 1e-3)
        program = torch.export.export(model, (images, lenses))
        assert_close(program.module()(images, lenses), model(images, lenses), 1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("no_graphs_before_or_after")
@pytest.mark.parametrize(
    "name", ["darswin_a_nano", pytest.param("swin_nano perspective", marks=products)]
)
def test_a_compiled_training_step_with_the_default_backend(name):
    options = dict(jitter=0.0) if name.startswith("darswin") else {}
    # Compiling a single block takes seconds.
    model, images, lenses = made(name, depths=(1,), num_heads=(1,), **options)
    parameters = [*model.train().parameters()]
    expected = torch.autograd.grad(model(images, lenses).square().sum(), parameters)
    compiled = torch.compile(model, fullgraph=True)
    got = torch.autograd.grad(compiled(images, lenses).square().sum(), parameters)
    assert_gradients_close(model, got, expected)


@pytest.mark.slow
@pytest.mark.usefixtures("no_graphs_before_or_after")
def test_compiled_inference_with_the_default_backend():
    # tests/deploy/test_export.py compiles a DarSwin.
    options = dict(depths=(1,), num_heads=(1,), blocks=("D",), groups=(1,))
    model, images, lenses = made("dat_nano", **options)
    with torch.no_grad():
        compiled = torch.compile(model, fullgraph=True)
        assert_close(compiled(images, lenses), model(images, lenses))
