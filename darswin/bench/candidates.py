"""What is compared: our model, the same on the operators' PyTorch reference, and that compiled."""

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.bench.timing import COMPILED, ONE_LENS, OURS, PRODUCTS, REFERENCE
from darswin.lens import Lens, Spherical
from darswin.linear import Linear
from darswin.models import DarSwin, create_model
from darswin.models.encoder import Encoder
from darswin.onednn import PackedLinear
from darswin.ops import use_reference
from darswin.optimized import optimize

Run = Callable[[], Tensor]
CLASSES = 200


def lens_of(size: int) -> Lens:
    """The lens of all images."""
    return Spherical.from_fov(xi=0.5, fov=math.radians(170), radius=size / 2)


def network(name: str, size: int) -> Encoder:
    """A model of random weights, the same at every call."""
    torch.manual_seed(0)
    options = {} if name.startswith("darswin") else dict(image_size=size)
    return create_model(name, num_classes=CLASSES, **options)


def inference(
    name: str, size: int, dtype: torch.dtype, batch: int, *, compiled: bool
) -> dict[str, Run]:
    """The candidates for inference, by name: images (B, 3, size, size) → logits.

    The products alone are those of the linear layers, one after the other with nothing between, by
    oneDNN and with weights packed for it: the roof of what a model can reach that way.
    """
    lens, images = lens_of(size), torch.randn(batch, 3, size, size)
    ours_of_lens = optimize(network(name, size), dtype, lens=lens)
    products = products_of(name, size, dtype, batch)
    runs: dict[str, Run] = {
        OURS: inference_run(name, size, dtype, images, reference=False),
        ONE_LENS: lambda: ours_of_lens(images),
        PRODUCTS: lambda: [layer(x) for layer, x in products][-1],
        REFERENCE: inference_run(name, size, dtype, images, reference=True),
    }
    if compiled:
        torch._dynamo.reset()
        runs[COMPILED] = inference_run(name, size, dtype, images, reference=True, compiled=True)
    return {name: torch.no_grad()(run) for name, run in runs.items()}


def inference_run(
    name: str,
    size: int,
    dtype: torch.dtype,
    images: Tensor,
    *,
    reference: bool,
    compiled: bool = False,
) -> Run:
    """Inference by one of the candidates."""
    model, lens = network(name, size).eval(), lens_of(size)
    if not reference:
        optimized = optimize(model, dtype)
        return lambda: optimized(images, lens)
    # A model whose weights are bfloat16 is faster than autocast.
    model, pixels = model.to(dtype), images.to(dtype)
    if compiled:
        model = torch.compile(model, options={"freezing": True}, dynamic=False)

    def run() -> Tensor:
        with use_reference():
            return model(pixels, lens)

    return run


def products_of(
    name: str, size: int, dtype: torch.dtype, batch: int
) -> list[tuple[PackedLinear, Tensor]]:
    """The linear layers that a model runs, packed, and an input of each."""
    model = network(name, size).eval()
    found: list[tuple[PackedLinear, Tensor]] = []

    def add(layer: Linear, rows: int) -> None:
        found.append((PackedLinear(layer, dtype), torch.randn(rows, layer.in_features).to(dtype)))

    def hook(layer: Linear, _inputs: tuple[Tensor], output: Tensor) -> None:
        add(layer, output.numel() // layer.out_features)

    for layer in model.modules():
        if isinstance(layer, Linear):
            layer.register_forward_hook(hook)
    if isinstance(model, DarSwin):  # its first one is inside of `polar_embed`
        sample = model.patch_embed.sample
        add(model.patch_embed.proj, batch * sample.rings * sample.sectors)
    with torch.no_grad():
        model(torch.randn(batch, 3, size, size), lens_of(size))
    return found


def operations(products: list[tuple[PackedLinear, Tensor]]) -> int:
    """Floating-point operations of products."""
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
        model.set_products("fastest")
        model.set_recompute(True)
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4)
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
