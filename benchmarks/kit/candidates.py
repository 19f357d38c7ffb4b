"""The candidates: our model, and the same model on the reference, eager and compiled."""

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.deploy.optimize import optimize
from darswin.deploy.own import own_linear
from darswin.deploy.quantize import quantize_model
from darswin.layers.linear import Linear
from darswin.layers.quantized import QuantizedLinear, quantize
from darswin.lens import Lens, Spherical
from darswin.models import create_model
from darswin.models.base import Model
from darswin.models.pixel import PixelModel
from darswin.models.registry import has_image_size, model_class
from darswin.ops import linear, use_reference
from kit import timing

Run = Callable[[], Tensor]
CLASSES, PIXEL_CLASSES = 200, 10  # of images, and of pixels


def lens_of(size: int) -> Lens:
    """The lens of all images."""
    return Spherical.from_fov(xi=0.5, fov=math.radians(170), radius=size / 2)


def network(name: str, size: int) -> Model:
    """A model with random weights, which are the same in every call."""
    torch.manual_seed(0)
    options: dict[str, Any] = dict(image_size=size) if has_image_size(name) else {}
    classes = PIXEL_CLASSES if issubclass(model_class(name), PixelModel) else CLASSES
    return create_model(name, num_classes=classes, **options)


def inference(
    name: str, size: int, dtype: torch.dtype, batch: int, *, compiled: bool
) -> dict[str, Run]:
    """The candidates for inference, by name: images (B, 3, size, size) → logits.

    The matrix products alone are those of the linear layers, one after the other, each by the
    library that computes it fastest: the roofline of a model on this machine. A model of 8 bits
    takes turns with itself in float32; its reference is one of float32, which is also compiled in
    bfloat16 where the CPU has it.
    """
    model, lens = network(name, size).eval(), lens_of(size)
    images = torch.randn(batch, 3, size, size)
    has_8_bits = dtype == torch.int8
    ours = quantize_model(model, [(images, lens)]) if has_8_bits else model
    ours_of_lens = optimize(ours, dtype, lens=lens)
    products = matmuls_of(ours, images, lens)
    runs: dict[str, Run] = {
        timing.OURS: optimized_run(ours, lens, dtype, images),
        timing.FIXED_LENS: lambda: ours_of_lens(images),
        timing.MATMULS: lambda: _all(products),
        timing.REFERENCE: reference_run(model, lens, images),
    }
    if has_8_bits:
        runs[timing.OURS_FLOAT32] = optimized_run(model, lens, torch.float32, images)
    if compiled:
        torch._dynamo.reset()
        kinds = {timing.COMPILED: torch.float32}
        if has_8_bits and torch.ops.mkldnn._is_mkldnn_bf16_supported():
            kinds[timing.COMPILED_BFLOAT16] = torch.bfloat16
        for name, kind in kinds.items():
            peer = copy.deepcopy(model).to(kind)
            graph = torch.compile(peer, options={"freezing": True}, dynamic=False)
            runs[name] = reference_run(graph, lens, images.to(kind))
    return {name: torch.no_grad()(run) for name, run in runs.items()}


def _all(products: list[tuple[Callable[[Tensor], Tensor], Tensor]]) -> Tensor:
    # Only the last result is kept. The others' memory is freed at once, as it is within a model.
    for layer, x in products:
        result = layer(x)
    return result


def optimized_run(model: Model, lens: Lens, dtype: torch.dtype, images: Tensor) -> Run:
    optimized = optimize(model, dtype)
    return lambda: optimized(images, lens)


def reference_run(model: Callable[..., Tensor], lens: Lens, images: Tensor) -> Run:
    """Inference with the PyTorch reference."""

    def run() -> Tensor:
        with use_reference():
            return model(images, lens)

    return run


def matmuls_of(
    model: Model, images: Tensor, lens: Lens
) -> list[tuple[Callable[[Tensor], Tensor], Tensor]]:
    """The linear layers that a model runs, each with an input, computed by the fastest library."""
    found: list[tuple[Callable[[Tensor], Tensor], Tensor]] = []
    fastest: dict[tuple[type, int, int, int], str] = {}
    for layer, rows in products_of(model, images, lens):
        x = torch.randn(rows, layer.in_features)
        if isinstance(layer, QuantizedLinear):
            x = quantize(x, layer.activation)
        libraries = _libraries(layer)
        shape = (type(layer), rows, layer.in_features, layer.out_features)
        if shape not in fastest:
            with torch.inference_mode():
                runs = {name: partial(run, x) for name, run in libraries.items()}
                fastest[shape] = timing.fastest(runs, turns=5)
        found.append((libraries[fastest[shape]], x))
    return found


def _libraries(layer: Any) -> dict[str, Callable[[Tensor], Tensor]]:
    """One linear layer by each library that computes it, in float32 or as it is quantized."""
    if isinstance(layer, QuantizedLinear):
        return {"darswin": own_linear(layer)}
    weight = layer.weight.detach()
    bias = None if layer.bias is None else layer.bias.detach()
    libraries: dict[str, Callable[[Tensor], Tensor]] = {
        "darswin": own_linear(layer),
        "torch": lambda x: F.linear(x, weight, bias),
    }
    if torch.backends.mkldnn.is_available():
        # oneDNN keeps the weight in its own layout.
        packed = torch.ops.mkldnn._reorder_linear_weight(weight)
        product = torch.ops.mkldnn._linear_pointwise.default
        libraries["onednn"] = lambda x: product(x, packed, bias, "none", [], "")
    return libraries


def products_of(model: Model, images: Tensor, lens: Lens) -> list[tuple[Any, int]]:
    """The linear layers that a model runs, in their order, and the number of rows of each input."""
    found: list[tuple[Any, int]] = []

    def hook(layer: Any, _inputs: tuple[Tensor], output: Tensor) -> None:
        found.append((layer, output.numel() // layer.out_features))

    layers = [layer for layer in model.modules() if isinstance(layer, (Linear, QuantizedLinear))]
    handles = [layer.register_forward_hook(hook) for layer in layers]
    with torch.no_grad():
        model(images, lens)
    for handle in handles:
        handle.remove()
    return found


def operations_of(name: str, size: int) -> int:
    """The floating-point operations of a model's matrix products for one image."""
    image, lens = torch.randn(1, 3, size, size), lens_of(size)
    products = products_of(network(name, size).eval(), image, lens)
    return sum(2 * rows * layer.in_features * layer.out_features for layer, rows in products)


def training(
    name: str, size: int, dtype: torch.dtype, batch: int, *, compiled: bool
) -> dict[str, Run]:
    """The candidates for a training step, by name: forward, backward, AdamW; → the loss.

    The matrix products alone are those of the linear layers with their backward, by our kernels or
    by torch, whichever is faster.
    """
    ours = training_products(name, size, dtype, batch)
    products = {"darswin": ours, "torch": by_torch(ours)}
    runs = {
        timing.OURS: training_step(name, size, dtype, batch),
        timing.REFERENCE: training_step(name, size, dtype, batch, is_reference=True),
        timing.MATMULS: products[timing.fastest(products, turns=3)],
    }
    if compiled:
        torch._dynamo.reset()
        runs[timing.COMPILED] = training_step(
            name, size, dtype, batch, is_reference=True, compiled=True
        )
    return runs


def by_torch(run: Run) -> Run:
    """The same with torch's products in training, as on CPUs where they are faster."""
    return mock.patch.object(linear, "IS_FASTER", False)(run)


def training_products(name: str, size: int, dtype: torch.dtype, batch: int) -> Run:
    """The matrix products of a training step, forward and backward; → the last gradient."""
    model = network(name, size)
    images = torch.randn(batch, 3, size, size)
    sides: list[tuple[Any, Tensor, list[Tensor], Tensor]] = []
    for layer, rows in products_of(model.eval(), images, lens_of(size)):
        # The first product takes the images, whose gradient is never needed.
        x = torch.randn(rows, layer.in_features, dtype=dtype, requires_grad=bool(sides))
        wanted = [t for t in (x, *layer.parameters()) if t.requires_grad]
        sides.append((layer, x, wanted, torch.randn(rows, layer.out_features, dtype=dtype)))

    def run() -> Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            for layer, x, wanted, grad in sides:
                found = torch.autograd.grad(layer(x), wanted, grad)
        return found[0]

    return run


def training_step(
    name: str,
    size: int,
    dtype: torch.dtype,
    batch: int,
    *,
    is_reference: bool = False,
    compiled: bool = False,
) -> Run:
    """A training step of our model or of the reference; bfloat16 means autocast."""
    model, lens = network(name, size).train(), lens_of(size)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, fused=True)
    images = torch.randn(batch, 3, size, size)
    pixels = (size, size) if isinstance(model, PixelModel) else ()
    labels = torch.randint(model.num_classes, (batch, *pixels))
    half = dtype == torch.bfloat16
    # So that it draws the same jitter.
    options: Any = {"fallback_random": True}
    run = torch.compile(model, options=options, dynamic=False) if compiled else model

    def step() -> Tensor:
        with use_reference(is_reference), torch.autocast("cpu", torch.bfloat16, enabled=half):
            loss = F.cross_entropy(run(images, lens).float(), labels)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return loss.detach()

    return step
