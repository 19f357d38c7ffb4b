"""What is compared: our model, the same on the operators' PyTorch reference, and that compiled."""

import copy
import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from darswin.bench.timing import COMPILED, ONE_LENS, OURS, PRODUCTS, REFERENCE
from darswin.deploy.optimize import optimize
from darswin.layers.embed import PolarPatchEmbed
from darswin.layers.linear import Linear
from darswin.layers.onednn import PackedLinear
from darswin.lens import Lens, Spherical
from darswin.models import create_model
from darswin.models.encoder import Encoder
from darswin.models.registry import model_class
from darswin.ops import use_reference

Run = Callable[[], Tensor]
CLASSES = 200


def lens_of(size: int) -> Lens:
    """The lens of all images."""
    return Spherical.from_fov(xi=0.5, fov=math.radians(170), radius=size / 2)


def network(name: str, size: int) -> Encoder:
    """A model of random weights, the same at every call."""
    torch.manual_seed(0)
    options = {} if model_class(name).image_size is None else dict(image_size=size)
    return create_model(name, num_classes=CLASSES, **options)


def inference(
    name: str, size: int, dtype: torch.dtype, batch: int, *, compiled: bool
) -> dict[str, Run]:
    """The candidates for inference, by name: images (B, 3, size, size) → logits.

    The products alone are those of the linear layers, one after the other with nothing between, by
    oneDNN and with weights packed for it: the roof of what a model can reach that way.
    """
    model, lens = network(name, size).eval(), lens_of(size)
    images = torch.randn(batch, 3, size, size)
    ours_of_lens = optimize(model, dtype, lens=lens)
    products = products_of(model, images, lens, dtype)
    peer = copy.deepcopy(model) if dtype == torch.bfloat16 else model
    runs: dict[str, Run] = {
        OURS: inference_run(model, lens, dtype, images, reference=False),
        ONE_LENS: lambda: ours_of_lens(images),
        PRODUCTS: lambda: _all(products),
        REFERENCE: inference_run(peer, lens, dtype, images, reference=True),
    }
    if compiled:
        torch._dynamo.reset()
        graph = torch.compile(peer, options={"freezing": True}, dynamic=False)
        runs[COMPILED] = inference_run(graph, lens, dtype, images, reference=True)
    return {name: torch.no_grad()(run) for name, run in runs.items()}


def _all(products: list[tuple[PackedLinear, Tensor]]) -> Tensor:
    """The last of the products. The others' memory is free again at once, as a model's is."""
    for layer, x in products:
        result = layer(x)
    return result


def inference_run(
    model: nn.Module, lens: Lens, dtype: torch.dtype, images: Tensor, *, reference: bool
) -> Run:
    """Inference by one of the candidates; the reference's model becomes one of `dtype`, which in
    bfloat16 is faster than autocast."""
    if not reference:
        optimized = optimize(model, dtype)
        return lambda: optimized(images, lens)
    model, pixels = model.to(dtype), images.to(dtype)

    def run() -> Tensor:
        with use_reference():
            return model(pixels, lens)

    return run


def products_of(
    model: Encoder, images: Tensor, lens: Lens, dtype: torch.dtype
) -> list[tuple[PackedLinear, Tensor]]:
    """The linear layers that a model runs, packed, and an input of each."""
    found: list[tuple[PackedLinear, Tensor]] = []

    def add(layer: Linear, rows: int) -> None:
        found.append((PackedLinear(layer, dtype), torch.randn(rows, layer.in_features).to(dtype)))

    def hook(layer: Linear | PolarPatchEmbed, _inputs: tuple[Tensor], output: Tensor) -> None:
        # A polar embedding's linear layer is not called: `polar_embed` takes its weight.
        linear = layer.proj if isinstance(layer, PolarPatchEmbed) else layer
        add(linear, output.numel() // linear.out_features)

    layers = [layer for layer in model.modules() if isinstance(layer, (Linear, PolarPatchEmbed))]
    handles = [layer.register_forward_hook(hook) for layer in layers]
    with torch.no_grad():
        model(images, lens)
    for handle in handles:
        handle.remove()
    return found


def operations_of(name: str, size: int) -> int:
    """Floating-point operations of the products that a model runs for one image."""
    image, lens = torch.randn(1, 3, size, size), lens_of(size)
    products = products_of(network(name, size).eval(), image, lens, torch.float32)
    return sum(2 * x.numel() * layer.out_features for layer, x in products)


def training(name: str, size: int, dtype: torch.dtype, batch: int) -> dict[str, Run]:
    """The candidates for a step of training, by name: forward, backward, AdamW; → the loss."""
    return {
        OURS: training_step(name, size, dtype, batch, reference=False),
        REFERENCE: training_step(name, size, dtype, batch, reference=True),
    }


def training_step(name: str, size: int, dtype: torch.dtype, batch: int, *, reference: bool) -> Run:
    """A step of one of the candidates; bfloat16 is autocast."""
    model, lens = network(name, size).train(), lens_of(size)
    if not reference:
        model.set_matmul_backend("autotune")
        model.set_grad_checkpointing(True)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, fused=True)
    images, labels = torch.randn(batch, 3, size, size), torch.randint(CLASSES, (batch,))

    def step() -> Tensor:
        with (
            use_reference(reference),
            torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16),
        ):
            loss = F.cross_entropy(model(images, lens).float(), labels)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        return loss.detach()

    return step
