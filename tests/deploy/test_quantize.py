"""Models with 8 bits: what they lose and what stays in float32. test_contract.py has the table of
models whose fast ones and files compute the same."""

import math
import sys

import pytest
import torch
from frame_samples import model_of
from helpers import output, refused, relative_error
from torch import nn

from darswin import optimize
from darswin.deploy import quantize as module
from darswin.deploy.export import export_onnx, export_package
from darswin.deploy.quantize import quantize_model, sensitivities
from darswin.layers.linear import Linear
from darswin.layers.quantized import (
    Quantization,
    QuantizedLinear,
    dequantize,
    quantize,
    quantized_layers,
    with_quantized_layers,
)
from darswin.layers.transformer import Mlp
from darswin.lens import Spherical
from darswin.models import ModelCard, load_model, save_model
from darswin.ops import _module

HAS_VNNI = _module.byte_products() != "pairs"  # or dot products of ARM


def network(family="darswin_a", **options):
    small = dict(rings=8, sectors=16) if family == "darswin_unet_a" else {}
    return model_of(family, **small, **options)


def batch(count=4, size=32):
    lens = Spherical.from_fov(torch.rand(count), math.radians(160), size / 2)
    return torch.randn(count, 3, size, size), lens


@torch.no_grad()
def test_batches_and_quantized_models_come_to_the_same():
    model, seen = network(), batch()
    direct = optimize(model, torch.int8, batches=iter([(*seen, torch.zeros(4))]))
    by_model = optimize(quantize_model(model, [seen]), torch.int8)
    assert torch.equal(direct(*seen), by_model(*seen))
    images, lens = seen
    assert direct(images[:0], lens[:0]).shape == (0, 10)
    assert relative_error(direct(images[:1], lens[:1]), direct(images, lens)[:1]) < 1e-5


@torch.no_grad()
def test_layers_of_8_bits():
    linear = nn.Linear(40, 6)
    linear.weight[2] = 0
    x, steps = torch.randn(50, 40), Quantization(8 / 255, 128)
    layer = QuantizedLinear.of(linear, steps)
    assert layer.weight.dtype == torch.int8 and (layer.weight[2] == 0).all()
    assert (layer.weight.abs().amax(1)[[0, 1, 3, 4, 5]] == 127).all()
    rounded = dequantize(quantize(x, steps), steps)
    assert (rounded - x).abs().max() <= 0.51 * steps.scale + (x.abs() - 4).clamp(min=0).max()
    assert relative_error(layer(x), linear(x)) < 0.02
    torch.testing.assert_close(layer.to_linear()(rounded), layer(x))


@pytest.mark.slow
@torch.no_grad()
def test_what_disturbs_most_stays_in_float32():
    model, seen = network(), batch()
    # A channel a thousand times as large as the others leaves these few of the 8 bits, and only
    # the others count.
    model.stages[1].blocks[0].norm1.weight[3] = 1000.0
    model.stages[1].blocks[0].attn.qkv.weight[:, 3] = 0.0
    found = sensitivities(model, [seen])
    assert next(iter(found)) == "stages.1.blocks.0.attn.qkv"
    assert list(found.values()) == sorted(found.values(), reverse=True)
    all_of_it = quantized_layers(quantize_model(model, [seen], tolerance=math.inf))
    some = quantized_layers(quantize_model(model, [seen], tolerance=1e-2))
    assert "stages.1.blocks.0.attn.qkv" in all_of_it.keys() - some.keys()
    refused(r"exceeds the `tolerance` 0\.0", quantize_model, model, [seen], tolerance=0.0)


def test_ranges_lose_least():
    values = torch.randn(200_000)
    values[:2] = torch.tensor([12.0, -12.0])

    def loss(given):
        return (dequantize(quantize(values, given), given) - values).square().mean().item()

    found = module._best_range("x", values, torch.stack(values.aminmax()))
    shares = torch.linspace(0.05, 1, 96).tolist()
    best = min(loss(module._of_range(-12 * share, 12 * share)) for share in shares)
    assert loss(found) < 1.05 * best < 0.8 * loss(module._of_range(-12, 12))


def test_the_model_stays_as_it_is_and_its_copy_has_no_gradients():
    model, seen = network().train(), batch()
    model.stages[0].eval()
    modes = [m.training for m in model.modules()]
    quantized = quantize_model(model, [seen])
    assert [m.training for m in model.modules()] == modes
    assert all(p.requires_grad for p in model.parameters())
    assert not quantized(*seen).requires_grad
    with pytest.raises(RuntimeError, match="a quantized layer has no gradient"):
        quantized(seen[0].requires_grad_(), seen[1])


def test_layers_that_cannot_go_together_are_named():
    steps = Quantization(0.05, 128)
    for name, layer, message in (
        ("darswin_a", "stages.0.blocks.0.mlp.fc1", "both products of an MLP"),
        ("darswin_a", "stages.0.blocks.0.mlp.fc2", "both products of an MLP"),
        ("darswin_unet_a", "segmentation_head.proj", "must be a linear one"),
    ):
        model = network(name)
        with_quantized_layers(model, {layer: steps})
        refused(message, optimize, model, torch.int8)


@pytest.mark.slow
def test_what_is_to_stay_stays():
    model, seen = network(), batch()
    keep = ["stages.0", "stages.1.blocks.0.attn", "stages.2.blocks.0.mlp.fc1"]
    layers = quantized_layers(quantize_model(model, [seen], keep=keep, tolerance=math.inf))
    assert not any(name.startswith(tuple(keep)) for name in layers)
    # The two products of an MLP go together.
    assert "stages.2.blocks.0.mlp.fc2" not in layers and "stages.1.blocks.0.mlp.fc2" in layers
    one = quantize_model(model, [seen], keep="stages.0", tolerance=math.inf)
    assert not any(name.startswith("stages.0") for name in quantized_layers(one))
    for wrong in ("stages.9", [""]):
        with pytest.raises(ValueError, match=r"keep: the model has no module named (stages\.9)?"):
            quantize_model(model, [seen], keep=wrong)
    for keep in ("attn.qkv", "attn.proj", "mlp", "norm1"):
        names = [name for name, _ in model.named_modules() if name.endswith(keep)]
        quantized = quantize_model(model, [seen], keep=names, tolerance=math.inf)
        with torch.no_grad():
            fast = optimize(quantized, torch.int8)(*seen)
            assert relative_error(fast, quantized(*seen)) < 0.02


@pytest.mark.slow
@torch.no_grad()
def test_saved_and_loaded(tmp_path):
    model, seen = network(), batch()
    quantized = quantize_model(model, [seen])
    card = ModelCard("darswin_a_nano", dict(num_classes=10), quantized=quantized_layers(quantized))
    save_model(tmp_path / "q.safetensors", quantized.state_dict(), card)
    loaded, read = load_model(tmp_path / "q.safetensors")
    assert torch.equal(loaded(*seen), quantized(*seen))
    assert set(read.quantized) == set(card.quantized)
    # The file alone says all of it, and a wrong name is an error.
    wrong = ModelCard("darswin_a_nano", dict(num_classes=10), quantized={"head.x": (1.0, 0)})
    save_model(tmp_path / "w.safetensors", quantized.state_dict(), wrong)
    refused(r"no linear layer 'head\.x'", load_model, tmp_path / "w.safetensors")


@pytest.mark.slow
@torch.no_grad()
@pytest.mark.parametrize("name", ["darswin_a", "dat"])
def test_the_largest_sums_do_not_overflow(name):
    """CPUs without VNNI may add the products of two bytes in 16 bits, where 2 · 255 · 127 is too
    large."""
    model, (images, lens) = network(name), batch()
    for layer in model.modules():
        if isinstance(layer, Mlp):
            layer.fc1.bias.fill_(4.0)  # then the GELU of every token is as large
            layer.fc2.weight.abs_()
    quantized = quantize_model(model, [(images, lens)], tolerance=math.inf)
    found = optimize(quantized, torch.int8)(images, lens)
    assert relative_error(found, quantized(images, lens)) < 0.01


@torch.no_grad()
@pytest.mark.parametrize("size", ["nano", "micro"])
def test_every_way_of_8_bits_has_the_same_bits(size):
    quantized, seen = quantize_model(network(size=size), [batch()], tolerance=math.inf), batch()
    fast, found = optimize(quantized, torch.int8, strict=True), []
    try:
        for way in _module.BYTE_PRODUCTS:  # those that the CPU lacks are the way before
            _module.byte_products(way)
            found.append(fast(*seen))
    finally:
        _module.byte_products(_module.BYTE_PRODUCTS[-1])
    assert all(torch.equal(one, found[0]) for one in found)


@torch.no_grad()
def test_blocks_with_other_attention_go_layer_by_layer():
    class Doubled(nn.Module):
        """Another kind of attention than ours, around it."""

        def __init__(self, attn):
            super().__init__()
            self.attn, self.position_bias = attn, attn.position_bias

        def forward(self, x, table):
            return 2 * self.attn(x, table)

    quantized, seen = quantize_model(network(), [batch()], tolerance=math.inf), batch()
    block = quantized.stages[1].blocks[1]
    block.attn = Doubled(block.attn)
    fast = optimize(quantized, torch.int8)
    assert relative_error(fast(*seen), quantized(*seen)) < 0.02


def test_wrong_arguments():
    model, seen = network(), batch()
    quantized = quantize_model(model, [seen])
    assert sum(isinstance(m, Linear) for m in quantized.modules())  # the head is one still
    images = seen[0].clone()
    images[0, 0, 16, 16] = math.nan
    for given, batches, kind, message in (
        (nn.Linear(2, 3), [seen], TypeError, "model of create_model, got Linear"),
        (quantized, [seen], ValueError, "quantized already"),
        *(
            (model, wrong, TypeError, r"batches must be of \(images, lens\)")
            for wrong in (seen, seen[0], [(seen[0],)], [seen[0]], [(seen[0], 1.0)])
        ),
        (network().double(), [seen], ValueError, "float32 on the CPU"),
        (network().bfloat16(), [seen], ValueError, "float32 on the CPU"),
        (model, [], ValueError, "have pictures, got none"),
        (model, [(seen[0][:0], seen[1])], ValueError, "have pictures, got none"),
        (model, [(images, seen[1])], ValueError, "not finite"),
    ):
        refused(message, quantize_model, given, batches, error=kind)
    for given, dtype, batches in (
        (quantized, torch.float32, None),
        (model, torch.float32, [seen]),
        (model, torch.int8, None),
        (quantized, torch.int8, [seen]),
    ):
        refused(r"quantized? model|quantize_model", optimize, given, dtype, batches=batches)


def may_overflow(weight):
    """Whether x86 CPUs without VNNI may multiply wrongly with weights (D', D), of 8 bits.

    ONNX Runtime multiplies uint8 × int8 by `vpmaddubsw` there, which adds two products in 16 bits,
    signed and saturated. Its products of uint8 × uint8 have 32 bits.
    """
    if weight.dtype == torch.uint8:
        return False
    pairs = weight.int().unflatten(1, (-1, 2))
    largest = torch.stack([255 * pairs.clamp(min=0).sum(2), 255 * pairs.clamp(max=0).sum(2)])
    return not torch.equal(largest, largest.clamp(-(2**15), 2**15 - 1))


WITHOUT_VNNI = """
import torch
from darswin.layers.quantized import Quantization, QuantizedLinear
linear = torch.nn.Linear(64, 64)
linear.weight.data.fill_(1.0)
layer, x = QuantizedLinear.of(linear, Quantization(1 / 255, 0)), torch.ones(64, 64)
with torch.no_grad():
    compiled = torch.compile(layer, options={"freezing": True})
    torch.testing.assert_close(compiled(x), layer(x), rtol=1e-5, atol=1e-5)
"""


@pytest.mark.slow
def test_no_integer_products_of_onednn_without_vnni():
    output(sys.executable, "-c", WITHOUT_VNNI, env={"ONEDNN_MAX_CPU_ISA": "AVX2"})


@pytest.fixture(scope="module", params=[False, True], ids=["any CPU", "VNNI"])
def exported(request, tmp_path_factory):
    """A quantized model, its results for some images, its ONNX file, the inputs of the file, and
    whether this is for CPUs with VNNI alone."""
    pytest.importorskip("onnxscript")
    torch.manual_seed(0)
    model, (images, lens) = network(depths=(1, 1), num_heads=(1, 2)), batch(6)
    quantized = quantize_model(model, [(images, lens)])
    path = tmp_path_factory.mktemp("quantized") / "q.onnx"
    export_onnx(quantized, path, images, lens, vnni_only=request.param)
    inputs = dict(images=images, xi=lens.xi, focal=lens.focal, theta_max=lens.theta_max)
    with torch.no_grad():
        expected = quantized(images, lens)
    return quantized, expected, path, {k: v.numpy() for k, v in inputs.items()}, request.param


@pytest.mark.slow
def test_onnx_runtime_says_the_same(exported):
    runtime, onnx = (pytest.importorskip(name) for name in ("onnxruntime", "onnx"))
    quantized, expected, path, inputs, vnni_only = exported
    graph = onnx.load(path).graph
    kinds = [node.op_type for node in graph.node]
    assert kinds.count("QuantizeLinear") == len(quantized_layers(quantized))
    constants = {one.name: onnx.numpy_helper.to_array(one) for one in graph.initializer}
    overflows = dict.fromkeys(quantized_layers(quantized))
    for node in graph.node:
        if node.op_type == "DequantizeLinear" and node.input[0] in constants:
            weight, _, zero_points = (torch.tensor(constants[name]) for name in node.input)
            name = node.input[0].removeprefix("model.").removesuffix(".weight")
            steps = weight.int() - zero_points[:, None].int()
            assert torch.equal(steps, quantized.get_submodule(name).weight.int())
            overflows[name] = may_overflow(weight)
    assert set(overflows.values()) == {vnni_only}
    if HAS_VNNI or not vnni_only:
        (logits,) = map(torch.from_numpy, runtime.InferenceSession(path).run(None, inputs))
        assert (logits.argmax(1) == expected.argmax(1)).all()
        assert relative_error(logits, expected) < 0.05


@pytest.mark.slow
def test_openvino_multiplies_with_8_bits_in_files_for_vnni(exported):
    openvino = pytest.importorskip("openvino")
    quantized, expected, path, inputs, vnni_only = exported
    if vnni_only and not HAS_VNNI:
        pytest.skip("such a file is not for this CPU")
    settings = {"INFERENCE_PRECISION_HINT": "f32"}
    compiled = openvino.Core().compile_model(path, "CPU", settings)
    nodes = [op.get_rt_info() for op in compiled.get_runtime_model().get_ordered_ops()]
    products = [n["primitiveType"].value for n in nodes if n["layerType"].value == "FullyConnected"]
    in_8_bits = [product for product in products if product.endswith("I8")]
    assert len(in_8_bits) == (len(quantized_layers(quantized)) if vnni_only else 0)
    logits = torch.from_numpy(compiled(inputs)["logits"])
    assert (logits - expected).abs().max() < 0.05 * expected.abs().max()


@pytest.mark.slow
def test_a_package_computes_as_the_quantized_model(tmp_path):
    model, (images, lenses) = network(depths=(1,), num_heads=(1,)), batch(6)
    quantized = quantize_model(model, [(images, lenses)])
    export_package(quantized, tmp_path / "q.pt2", images, lenses[0], fixed_lens=True)
    package = torch._inductor.aoti_load_package(tmp_path / "q.pt2")
    with torch.no_grad():
        assert relative_error(package(images), quantized(images, lenses[0])) < 0.01
