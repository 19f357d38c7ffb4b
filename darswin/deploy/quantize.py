"""Models whose large products take 8 bits: ranges and what stays in float32 come from pictures."""

import copy
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor, nn

from darswin.layers.attention import WindowAttention
from darswin.layers.block import Block, PatchMerging
from darswin.layers.quantized import quantized_layers, with_quantized_layers
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.ops._quantized import Quantization, dequantize, quantize

Net = TypeVar("Net", bound=Model)
Batches = Sequence[tuple[Tensor, Lens | None]]

# Of an activation, so many numbers of each batch are kept, evenly spread, to choose its range by.
_KEPT = 2**14
# A range is the whole one, or ends at one of these shares of it.
_SHARES = torch.linspace(0.3, 1.0, 36).tolist()


def quantize_model(
    model: Net,
    calibration: Iterable[Sequence],
    *,
    keep: Collection[str] = (),
    tolerance: float = 0.01,
) -> Net:
    """A copy of a model whose blocks and mergings compute with weights and activations of 8 bits.

    The copy computes in float32 what integer products compute, so it can be evaluated, saved and
    exported anywhere; `darswin.optimize` makes integer products of it.

    Each activation gets the range that loses least, in squares, over the calibration. What disturbs
    the result most stays in float32, one part after the other, until the copy's result is within
    `tolerance` of the model's: parts are those of `sensitivities`.

    Args:
        model: one of `create_model`, in float32 on the CPU.
        calibration: batches (images, lens), or a loader of them; what else a batch holds is
            ignored. A few hundred pictures like those to come, through lenses like theirs.
        keep: names of modules that stay in float32, with all that they hold.
        tolerance: of the mean square of what changes, over the variance of the result.

    Raises:
        TypeError: another kind of model. ValueError: no calibration, a name that the model lacks,
            or a model that is quantized already.
    """
    batches = _batches(model, calibration)
    parts = _parts(model, keep)
    activations = _activations(model, batches, [name for names in parts.values() for name in names])
    expected = _results(model, batches)

    def quantized(chosen: Iterable[str]) -> Net:
        copied = copy.deepcopy(model).eval().requires_grad_(False)
        with_quantized_layers(
            copied, {name: activations[name] for part in chosen for name in parts[part]}
        )
        return copied

    chosen = list(parts)
    result = quantized(chosen)
    if _error(_results(result, batches), expected) <= tolerance:
        return result
    errors = {part: _error(_results(quantized([part]), batches), expected) for part in parts}
    chosen.sort(key=errors.__getitem__)
    while chosen and _error(_results(result, batches), expected) > tolerance:
        chosen.pop()
        result = quantized(chosen)
    return result


def sensitivities(model: Model, calibration: Iterable[Sequence]) -> dict[str, float]:
    """How much each part of a model disturbs its result when it alone computes with 8 bits.

    Parts are a block's "attn.qkv", "attn.proj" and "mlp", and a merging's "reduction", by name.

    Args:
        model, calibration: as `quantize_model`.

    Returns:
        for each part the mean square of what changes over the variance of the result, the largest
        first.
    """
    batches, parts = _batches(model, calibration), _parts(model, ())
    activations = _activations(model, batches, [name for names in parts.values() for name in names])
    expected, errors = _results(model, batches), {}
    for part, names in parts.items():
        copied = copy.deepcopy(model).eval().requires_grad_(False)
        with_quantized_layers(copied, {name: activations[name] for name in names})
        errors[part] = _error(_results(copied, batches), expected)
    return dict(sorted(errors.items(), key=lambda item: -item[1]))


def _batches(model: nn.Module, calibration: Iterable[Sequence]) -> Batches:
    if not isinstance(model, Model):
        raise TypeError(f"model must be one of create_model, got {type(model).__name__}")
    if quantized_layers(model):
        raise ValueError("the model is quantized already")
    batches = [(batch[0], batch[1]) for batch in calibration]
    if not sum(len(images) for images, _ in batches):
        raise ValueError("calibration has no pictures")
    return batches


def _parts(model: nn.Module, keep: Collection[str]) -> dict[str, list[str]]:
    """The names of the linear layers of each part that may become 8 bits."""
    if unknown := sorted(set(keep) - {name for name, _ in model.named_modules()}):
        raise ValueError(f"the model has no {', '.join(unknown)} to keep in float32")
    parts: dict[str, list[str]] = {}
    for name, module in model.named_modules():
        if isinstance(module, Block):
            parts[f"{name}.mlp"] = [f"{name}.mlp.fc1", f"{name}.mlp.fc2"]
        elif isinstance(module, WindowAttention):
            parts |= {f"{name}.{layer}": [f"{name}.{layer}"] for layer in ("qkv", "proj")}
        elif isinstance(module, PatchMerging):
            parts[f"{name}.reduction"] = [f"{name}.reduction"]
    kept = tuple(f"{name}." for name in keep)
    return {
        part: names
        for part, names in parts.items()
        if not any(f"{name}.".startswith(kept) for name in (part, *names))
    }


def _results(model: Model, batches: Batches) -> Tensor:
    """The results of all batches, one row a picture."""
    with torch.inference_mode(), _evaluating(model):
        return torch.cat([_flat(model(images, lens)) for images, lens in batches])


def _flat(result: Tensor | list[Tensor]) -> Tensor:
    """The result, or the maps of a model of features, as (B, numbers)."""
    maps = [result] if isinstance(result, Tensor) else result
    return torch.cat([one.float().flatten(1) for one in maps], 1)


def _error(found: Tensor, expected: Tensor) -> float:
    """The mean square of the difference, over the variance of what is expected."""
    variance = (expected - expected.mean()).square().mean()
    return ((found - expected).square().mean() / variance).item()


def _activations(model: Model, batches: Batches, names: Collection[str]) -> dict[str, Quantization]:
    """How the input of each named layer becomes 8 bits."""
    kept: dict[str, list[Tensor]] = defaultdict(list)

    def keeper(name):
        def keep(module, arguments):
            values = arguments[0].detach().float().flatten()
            step = max(values.numel() // _KEPT, 1)
            ends = torch.stack(values.aminmax()) if values.numel() else values
            kept[name].append(torch.cat((values[::step], ends)))

        return keep

    layers = dict(model.named_modules())
    hooks = [layers[name].register_forward_pre_hook(keeper(name)) for name in names]
    try:
        _results(model, batches)
    finally:
        for hook in hooks:
            hook.remove()
    return {name: _best_range(name, torch.cat(kept[name])) for name in names}


def _best_range(name: str, values: Tensor) -> Quantization:
    """The quantization of least squared error: each end is a share of the whole range."""
    if not values.isfinite().all():
        raise ValueError(f"{name} takes numbers that are not finite: look at the calibration")
    lower, upper = min(values.min().item(), 0.0), max(values.max().item(), 0.0)

    def error(ends: tuple[float, float]) -> float:
        given = _of_range(*ends)
        return (dequantize(quantize(values, given), given) - values).square().sum().item()

    best = min(((lower, share * upper) for share in _SHARES), key=error)
    best = min(((share * lower, best[1]) for share in _SHARES), key=error)
    return _of_range(*best)


def _of_range(lower: float, upper: float) -> Quantization:
    """The steps that reach from `lower` to `upper`, 0 being one of them exactly."""
    scale = max((upper - lower) / 255, 1e-12)
    return Quantization(scale, min(max(round(-lower / scale), 0), 255))


@contextmanager
def _evaluating(model: nn.Module) -> Iterator[None]:
    training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(training)
