import math

import pytest
import torch

from darswin import PolarSample, create_model, list_models
from darswin.lens import Perspective, Polynomial, Spherical
from darswin.models.stages import plan_stages
from darswin.ops import use_reference

LENS = Spherical.from_fov([0.2, 0.9], 2.6, 16.0)


def nano(**options):
    return create_model("darswin_a_nano", **(dict(num_classes=10) | options))


def images(batch=2, height=32, width=32):
    return torch.randn(batch, 3, height, width)


def plans(*args):
    return [(p.map_size, p.window, p.shift) for p in plan_stages(*args)]


def test_stage_plan_of_darswin_a():
    assert plans(16, 64, 4, "A", (1, 16)) == [
        ((16, 64), (1, 16), (0, 4)),
        ((16, 16), (1, 16), (0, 0)),
        ((16, 4), (4, 4), (2, 0)),
        ((16, 1), (16, 1), (0, 0)),
    ]


def test_stage_plan_of_given_merges():
    assert plans(16, 64, 4, "A", (1, 16), ((1, 4), (1, 4), (4, 1)))[2:] == [
        ((16, 4), (4, 4), (2, 0)),
        ((4, 4), (4, 4), (0, 0)),
    ]
    assert plans(8, 32, 3, "A", (1, 8), [[1, 4], [4, 1]]) == [
        ((8, 32), (1, 8), (0, 2)),
        ((8, 8), (1, 8), (0, 0)),
        ((2, 8), (1, 8), (0, 0)),
    ]


def test_stage_plan_of_darswin_ra():
    assert plans(16, 64, 4, "RA", (4, 4)) == [
        ((16, 64), (4, 4), (2, 2)),
        ((8, 32), (4, 4), (2, 2)),
        ((4, 16), (4, 4), (0, 2)),
        ((2, 8), (2, 8), (0, 0)),
    ]


def test_stage_plan_of_other_sizes():
    assert plans(32, 128, 4, "A", (1, 64))[0] == ((32, 128), (1, 64), (0, 16))
    assert plans(16, 16, 4, "A", (1, 16))[3] == ((4, 1), (4, 1), (0, 0))  # merged along the radius
    assert plans(6, 12, 2, "A", (1, 6)) == [((6, 12), (1, 6), (0, 1)), ((6, 3), (2, 3), (1, 0))]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((16, 60, 4, "A", (1, 16)), r"stage 1: window \(1, 16\) must divide the map, \(16, 60\)"),
        ((16, 6, 2, "A", (1, 6)), r"stage 2: a map of \(16, 6\) cannot be merged"),
        ((6, 64, 4, "A", (1, 16)), r"stage 3: window \(4, 4\) must divide the map, \(6, 4\)"),
        ((15, 64, 2, "RA", (5, 4)), r"stage 2: a map .* cannot be merged by \(2, 2\)"),
    ],
)
def test_sizes_that_do_not_divide(arguments, message):
    with pytest.raises(ValueError, match=message):
        plan_stages(*arguments)


@pytest.mark.parametrize(
    ("name", "classes", "parameters"),
    [("darswin_a_small", 200, 48_977_864), ("darswin_a_small", 1000, 49_593_064)],
)
def test_parameter_counts(name, classes, parameters):
    with torch.device("meta"):
        model = create_model(name, num_classes=classes)
    assert sum(p.numel() for p in model.parameters()) == parameters


DARSWINS = [name for name in list_models() if name.startswith(("darswin_a", "darswin_ra"))]


@pytest.mark.parametrize("name", DARSWINS)
def test_every_named_model_trains_a_step(name):
    torch.manual_seed(0)
    depths = dict(depths=(1, 1, 2, 1)) if "nano" not in name else {}
    model = create_model(name, num_classes=7, **depths)
    loss = model(images(1, 40, 40), LENS[:1]).square().sum()
    loss.backward()
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), parameter_name


OPTIONS = {
    "RA": dict(variant="RA", rings=8, sectors=16),
    "angular": dict(position_bias="angular"),
    "polar": dict(position_bias="polar", harmonics=4),
    "periodic bias": dict(periodic_bias=True),
    "few samples": dict(samples=(2, 5)),
    "no jitter": dict(jitter=0.0),
    "uniform sampling": dict(sample_spacing="radius"),
    "partition without lens": dict(spacing="radius"),
    "tan, edges": dict(spacing="tan", placement="edges"),
    "g": dict(spacing="g"),
    "drop path": dict(drop_path_rate=0.5),
    "window": dict(window=(1, 8)),
    "official": dict(compat="official", rings=16, sectors=64),
    "one stage": dict(depths=(2,), num_heads=(2,)),
}


@pytest.mark.parametrize("option", OPTIONS)
def test_every_option_trains_and_agrees_with_the_reference(option):
    model = nano(**OPTIONS[option])
    x = images()
    model(x, LENS).square().sum().backward()
    assert all(p.grad.isfinite().all() for p in model.parameters())
    model.eval()
    with torch.no_grad():
        ours = model(x, LENS)
        with use_reference():
            expected = model(x, LENS)
    torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [(32, 32), (17, 40), (64, 48), (1, 1)])
def test_any_image_size(size):
    for lens in (LENS, Polynomial([6.0, 0.4], 2.0), Perspective(5.0, 1.2, center=[3.0, 4.0])):
        assert nano()(images(2, *size), lens).shape == (2, 10)


def test_features_intermediates_and_head():
    model = nano().eval()
    x = images()
    features, maps = model.forward_intermediates(x, LENS)
    assert [tuple(m.shape) for m in maps] == [(2, 8, 32, 24), (2, 8, 8, 48), (2, 8, 2, 96)]
    assert torch.equal(features, model.forward_features(x, LENS))
    assert torch.equal(features, model.norm(maps[-1]))
    assert torch.equal(model.forward_head(features), model(x, LENS))
    assert torch.equal(model.forward_head(features, pre_logits=True), features.mean((1, 2)))
    (last,) = model.forward_intermediates(x, LENS, indices=1, intermediates_only=True)
    assert torch.equal(last, maps[-1])
    chosen = model.forward_intermediates(x, LENS, indices=[0, -1], intermediates_only=True)
    assert torch.equal(chosen[0], maps[0]) and torch.equal(chosen[1], maps[-1])
    for wrong in (0, 4, [3]):
        with pytest.raises(ValueError, match="indices"):
            model.forward_intermediates(x, LENS, indices=wrong)


def test_classifier_and_weight_decay():
    model = nano(num_classes=0)
    assert model(images(), LENS).shape == (2, 96)
    model.reset_classifier(5)
    assert model(images(), LENS).shape == (2, 5)
    excluded = model.no_weight_decay()
    names = dict(model.named_parameters())
    assert "stages.0.blocks.0.attn.position_bias.a_phi" in excluded and excluded <= names.keys()
    assert len(excluded) == 4 * 4


def test_a_lens_per_image_is_its_own():
    model = nano().eval()
    x = images()
    together = model(x, LENS)
    alone = torch.cat([model(x[k : k + 1], LENS[k]) for k in range(2)])
    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)


def test_empty_batch():
    out = nano()(images(0), LENS[:0])
    assert out.shape == (0, 10)
    out.sum().backward()


EVEN = dict(periodic_bias=True)
LAST_ALONG_RADIUS = EVEN | dict(merges=((1, 4), (1, 4), (4, 1)))
NANO_EVEN = EVEN | dict(merges=((1, 4), (4, 1)), window=(1, 8))
SHORT = dict(embed_dim=16, depths=(2, 2, 2, 2), num_heads=(1, 2, 4, 8))


@pytest.mark.parametrize(
    ("name", "options", "exact"),
    [  # the turns, in quarters, that the features follow exactly
        ("darswin_ra_nano", EVEN, {1, 2, 3}),
        ("darswin_ra_micro", EVEN, {1, 2, 3}),
        ("darswin_ra_tiny", EVEN | SHORT, {1, 2, 3}),
        ("darswin_ra_small", EVEN | SHORT, {1, 2, 3}),
        ("darswin_ra_micro", {}, set()),
        ("darswin_ra_micro", dict(position_bias="angular"), {1, 2, 3}),
        ("darswin_a_nano", EVEN, {2}),
        ("darswin_a_nano", NANO_EVEN, {1, 2, 3}),
        ("darswin_a_micro", EVEN, set()),
        ("darswin_a_tiny", EVEN | SHORT, set()),
        ("darswin_a_small", EVEN | SHORT, set()),
        ("darswin_a_micro", LAST_ALONG_RADIUS, {1, 2, 3}),
        ("darswin_a_tiny", LAST_ALONG_RADIUS | SHORT, {1, 2, 3}),
        ("darswin_a_small", LAST_ALONG_RADIUS | SHORT, {1, 2, 3}),
        ("darswin_a_micro", dict(merges=LAST_ALONG_RADIUS["merges"]), set()),
    ],
)
def test_turning_the_image_turns_the_features(name, options, exact):
    model = create_model(name, num_classes=10, **options).eval()
    with torch.no_grad():
        for parameter_name, parameter in model.named_parameters():
            if "position_bias" in parameter_name:
                parameter.normal_()  # as small as they begin they hide what they break
        x, lens = images(1, 48, 48), Spherical.from_fov(0.4, 2.6, 24.0)
        maps = model.forward_intermediates(x, lens, intermediates_only=True)
        logits = model(x, lens)
        for turns in (1, 2, 3):
            # Azimuth runs from right to down, clockwise on the screen.
            turned = x.rot90(-turns, (2, 3))
            others = model.forward_intermediates(turned, lens, intermediates_only=True)
            change = (model(turned, lens) - logits).norm() / logits.norm()
            assert change <= 1e-5 if turns in exact else change >= 1e-2, (turns, change)
            if turns in exact:
                for before, later in zip(maps, others, strict=True):
                    tokens = before.shape[2] * turns // 4
                    torch.testing.assert_close(later, before.roll(tokens, 2), rtol=1e-3, atol=1e-4)


def test_another_lens_shows_the_same_tokens():
    # What the network is for: a smooth scene through two lenses gives nearly the same tokens.
    def scene(lens, size):
        y, x = torch.meshgrid(torch.arange(size) - (size - 1) / 2,
                              torch.arange(size) - (size - 1) / 2, indexing="ij")  # fmt: skip
        theta = lens.unproject(torch.hypot(x, y))
        phi = torch.atan2(y, x)
        return torch.stack((torch.cos(3 * theta), torch.sin(2 * theta) * torch.cos(phi)))[None]

    lenses = [Spherical.from_fov(xi, math.radians(150), 100.0) for xi in (0.2, 0.9)]
    shared = dict(in_chans=2, jitter=0.0)
    errors = {}
    for spacing in ("theta", "radius"):
        torch.manual_seed(0)
        model = nano(spacing=spacing, **shared).eval()
        with torch.no_grad():
            a, b = (model.forward_features(scene(lens, 200), lens) for lens in lenses)
        errors[spacing] = ((a - b).norm() / a.norm()).item()
    assert errors["theta"] < 0.02 < 0.1 < errors["radius"], errors


def test_gradients_reach_the_lens_through_sampling_and_bias():
    xi = torch.tensor([0.3], requires_grad=True)
    focal = torch.tensor([12.0], requires_grad=True)
    theta_max = torch.tensor([1.3], requires_grad=True)
    center = torch.tensor([[15.0, 16.0]], requires_grad=True)
    model = nano().eval()
    model(images(), Spherical(xi, focal, theta_max, center)).square().sum().backward()
    for parameter in (xi, focal, theta_max, center):
        assert parameter.grad.isfinite().all() and (parameter.grad != 0).all()


def test_same_seed_same_training_step():
    results = []
    for _ in range(2):
        torch.manual_seed(5)
        model = nano(jitter=1.0, drop_path_rate=0.2)
        x = torch.randn(2, 3, 32, 32)
        loss = model(x, LENS).square().sum()
        loss.backward()
        results.append([loss.detach(), *(p.grad for p in model.parameters())])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("lens", [LENS, Perspective(10.0, 1.2), Polynomial([16.0, 1.0], 1.3)])
def test_compile_fullgraph_and_export(lens):
    model = nano(spacing="theta", sample_spacing="g", depths=(1, 2), num_heads=(1, 2))
    x = images()
    torch.manual_seed(1)
    expected = model(x, lens)
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    torch.manual_seed(1)
    got = compiled(x, lens)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)
    got.square().sum().backward()
    model.eval()
    program = torch.export.export(model, (x, lens))
    torch.testing.assert_close(program.module()(x, lens), model(x, lens))


def test_compiled_training_step_with_the_default_backend():
    model = nano(depths=(1, 1), num_heads=(1, 2), jitter=0.0)
    x = images()
    model(x, LENS).square().sum().backward()
    expected = {name: p.grad.clone() for name, p in model.named_parameters()}
    model.zero_grad()
    torch.compile(model, fullgraph=True)(x, LENS).square().sum().backward()
    for name, parameter in model.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-3, atol=1e-4, msg=name)


def test_autocast():
    model = nano().eval()
    x = images()
    with torch.no_grad():
        expected = model(x, LENS)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            got = model(x, LENS)
    torch.testing.assert_close(got.float(), expected, rtol=0.1, atol=0.05)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(variant="B"), "variant must be 'A' or 'RA', got 'B'"),
        (dict(compat="timm"), "compat must be None, or one of"),
        (dict(compat="official", variant="RA"), "variant 'A' and merges of its own"),
        (dict(depths=(2, 2)), "depths and num_heads must pair up"),
        (dict(spacing="log"), "spacing must be one of"),
        (dict(position_bias="rotary"), "position_bias must be"),
        (dict(jitter=3.0), "jitter must be"),
        (dict(num_heads=(5, 5, 5)), "num_heads must divide"),
        (dict(drop_path_rate=1.0), "drop path must be"),
        (dict(sectors=30), "window"),
        (dict(merges=((1, 4),)), "merges must have one entry for each stage but the first, 2, got"),
        (dict(merges=((1, 4), (3, 1))), r"a map of \(8, 8\) cannot be merged by \(3, 1\)"),
        (dict(merges=((1, 4), (0, 1))), "merges must be at least 1"),
        (dict(compat="official", merges=((1, 4), (4, 1))), "merges of its own"),
    ],
)
def test_constructor_errors(options, message):
    with pytest.raises(ValueError, match=message):
        nano(**options)


def test_call_errors():
    model = nano()
    with pytest.raises(ValueError, match="images must have 3 channels, got 1"):
        model(torch.zeros(2, 1, 32, 32), LENS)
    with pytest.raises(TypeError, match=r"lens must be a darswin.lens.Lens, got NoneType"):
        model(images(), None)
    with pytest.raises(ValueError, match="one lens or one an image, 3, got 2"):
        model(images(3), LENS)
    with pytest.raises(ValueError, match="needs square images"):
        nano(compat="official", rings=16, sectors=64)(images(2, 32, 40), LENS)
    with pytest.raises(ValueError, match="below 90°"):
        nano(spacing="tan")(images(), Spherical(0.9, 10.0, 1.8))
    with pytest.raises(ValueError, match="unknown model 'darswin_b'; there are darswin_a_micro"):
        create_model("darswin_b")


def test_camera_frames():
    # uint8 frames, channels last, normalised by the model.
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    model = create_model("darswin_a_nano", num_classes=5, mean=mean, std=std).eval()
    frames = torch.randint(256, (2, 32, 40, 3), dtype=torch.uint8)
    lens = Spherical.from_fov([0.3, 0.7], 2.6, 16.0)
    planes = frames.permute(0, 3, 1, 2) / 255
    planes = (planes - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None]
    torch.testing.assert_close(model(frames, lens), model(planes, lens), rtol=1e-4, atol=1e-4)
    polar = PolarSample(4, 8, (2, 2), mean=mean, std=std)
    torch.testing.assert_close(polar(frames, lens), polar(planes, lens), rtol=1e-4, atol=1e-4)


def test_bfloat16_model():
    model = create_model("darswin_a_nano", num_classes=5).eval()
    images, lens = torch.randn(2, 3, 32, 32), Spherical.from_fov(0.5, 2.6, 16.0)
    expected = model(images, lens)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = model(images, lens)
    torch.testing.assert_close(half.float(), expected, rtol=0.1, atol=0.05)


FAMILIES = ["darswin_a", "darswin_ra", "swin", "swin_undis", "dat"]


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-6), (torch.bfloat16, 0.03)])
def test_camera_frames_in_models_of_any_dtype(family, dtype, tolerance):
    options = dict(num_classes=5, mean=(0.485, 0.456, 0.406), std=0.25)
    model = create_model(f"{family}_nano", **options).eval()
    frames = torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8)
    with torch.no_grad():
        expected = model(frames, LENS)
        got = model.to(dtype)(frames, LENS)
    assert got.dtype == dtype
    assert (got.float() - expected).norm() <= tolerance * expected.norm()


def test_camera_frames_are_as_exact_as_a_float64_model():
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    frames = torch.randint(256, (2, 3, 32, 32), dtype=torch.uint8)
    m, s = torch.tensor([mean, std], dtype=torch.float64)[..., None, None]
    for family in FAMILIES:
        model = create_model(f"{family}_nano", num_classes=5, mean=mean, std=std).double().eval()
        with torch.no_grad():
            got, expected = model(frames, LENS), model((frames.double() / 255 - m) / s, LENS)
        torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-14, msg=family)


@pytest.mark.parametrize("family", FAMILIES)
def test_images_of_another_dtype_than_the_models(family):
    model = create_model(f"{family}_nano", num_classes=5).eval()
    pairs = [
        (torch.bfloat16, torch.float32),
        (torch.float64, torch.float32),
        (torch.float32, torch.bfloat16),
        (torch.float32, torch.float64),
    ]
    for ours, theirs in pairs:
        message = f"images must be uint8, or {ours} as the model's weights are, got {theirs}"
        with pytest.raises(TypeError, match=message):
            model.to(ours)(images().to(theirs), LENS)
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        for dtype in (torch.float32, torch.bfloat16):  # autocast makes them equal
            assert model.float()(images().to(dtype), LENS).dtype == torch.bfloat16


@pytest.mark.parametrize("family", FAMILIES)
def test_a_new_classifier_is_of_the_models_kind(family):
    model = create_model(f"{family}_nano", num_classes=5).bfloat16().eval()
    model.set_matmul_backend("onednn")
    for classes in (7, 0, 3):
        model.reset_classifier(classes)
    assert model.head.matmul_backend == "onednn" and not model.head.training
    frames = torch.randint(256, (2, 32, 32, 3), dtype=torch.uint8)
    assert model(frames, LENS).dtype == torch.bfloat16 and model(frames, LENS).shape == (2, 3)
    model.to("meta").reset_classifier(4)
    assert model.head.weight.device.type == "meta"
