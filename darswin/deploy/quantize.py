"""Quantization of models to 8 bits, calibrated on pictures."""

import copy
import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import partial
from typing import Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from darswin.layers.attention import WindowAttention
from darswin.layers.quantized import (
    Quantization,
    dequantize,
    quantize,
    quantized_layers,
    with_quantized_layers,
)
from darswin.layers.transformer import Mlp, PatchMerging
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.utils.parameters import naming
from darswin.utils.progress import Progress

__all__ = ["quantize_model", "sensitivities"]

Net = TypeVar("Net", bound=Model)
Batches = Sequence[tuple[Tensor, Lens | None]]

# The linear layers that may be quantized, of each kind of layer. Those of a tuple go together.
_QUANTIZED: dict[type[nn.Module], dict[str, tuple[str, ...]]] = {
    WindowAttention: {".qkv": (".qkv",), ".proj": (".proj",)},
    Mlp: {"": (".fc1", ".fc2")},
    PatchMerging: {".reduction": (".reduction",)},
}
# Numbers of an activation that are drawn at random from each batch to choose its range.
_KEPT = 2**15
# A range covers one of these shares of the whole range.
_SHARES = torch.linspace(0.1, 1.0, 46).tolist()


def quantize_model(
    model: Net,
    batches: Iterable[Sequence],
    *,
    keep: Collection[str] = (),
    tolerance: float = 0.01,
) -> Net:
    """A copy of a model whose blocks and merging layers use 8-bit weights and activations.

    The copy simulates integer products in float32, so it can be evaluated, saved and exported on
    any machine. `darswin.optimize` turns the simulated products into integer products. The copy has
    no gradients.

    The range of each activation minimises the mean squared error over the batches. If the
    copy's error is above `tolerance`, the parts of the model with the largest errors go back to
    float32, one after the other. `sensitivities` lists the parts and their errors.

    Args:
        model: a model of `create_model`, in float32 on the CPU.
        batches: of (images, lens, ...), such as a data loader. Use a few hundred typical
            pictures with their lenses.
        keep: names of modules that stay in float32, together with their submodules.
        tolerance: largest error: the mean squared change of the result, divided by the variance of
            the result.

    Raises:
        TypeError: another kind of model, or of batches.
        ValueError: no pictures; an unknown name; a model that is not float32, not on the CPU or
            already quantized; or no part of the model stays within the tolerance.
    """
    found = _Ranges(model, batches, keep)
    chosen = list(found.parts)
    result = found.quantized(chosen)
    error = found.error(result)
    if error > tolerance:
        chosen.sort(key=found.alone().__getitem__)
    with Progress("taking parts back to float32"):
        while error > tolerance and len(chosen) > 1:
            chosen.pop()
            result = found.quantized(chosen)
            error = found.error(result)
    if error > tolerance:
        text = f"with 8 bits, every part of the model exceeds the `tolerance` {tolerance}"
        raise naming(ValueError(text), "tolerance")
    return result


def sensitivities(model: Model, batches: Iterable[Sequence]) -> dict[str, float]:
    """Error of the model's result for each part, if only that part computes with 8 bits.

    The parts are "attn.qkv", "attn.proj" and "mlp" of each block, and "reduction" of each merging
    layer.

    Args:
        model, batches: see `quantize_model`.

    Returns:
        the error of each part by name, the largest first. The error is the mean squared change of
        the result, divided by the variance of the result.
    """
    errors = _Ranges(model, batches, ()).alone()
    return dict(sorted(errors.items(), key=lambda item: -item[1]))


class _Ranges(Generic[Net]):
    """A model, typical pictures, and the ranges of its activations."""

    def __init__(self, model: Net, batches: Iterable[Sequence], keep: Collection[str]):
        self.batches = _checked(model, batches)
        self.model, self.parts = model, _parts(model, keep)
        if not self.parts:
            raise ValueError("the model has no part that could be quantized: no block, or all kept")
        names = [name for names in self.parts.values() for name in names]
        self._activations, self._expected = _observed(model, self.batches, names)

    def quantized(self, parts: Iterable[str]) -> Net:
        """A copy of the model with the given parts quantized."""
        copied = copy.deepcopy(self.model).eval().requires_grad_(False)
        names = [name for part in parts for name in self.parts[part]]
        with_quantized_layers(copied, {name: self._activations[name] for name in names})
        return copied

    def error(self, model: Net) -> float:
        """The error of a copy: its mean squared change, divided by the variance of the result."""
        change = Change()
        for expected, found in zip(self._expected, _results(model, self.batches), strict=True):
            change.add(expected, found)
        return change.share()

    def alone(self) -> dict[str, float]:
        """The error of each part, if it alone is quantized."""
        errors = {}
        with Progress("measuring the error of each part", len(self.parts)) as progress:
            for part in self.parts:
                errors[part] = self.error(self.quantized([part]))
                progress.done += 1
        return errors


class Change:
    """The mean squared difference of two models' results, divided by their variance."""

    def __init__(self) -> None:
        self.count, self.sums = 0, torch.zeros(3, dtype=torch.float64)

    def add(self, expected: Tensor, found: Tensor) -> None:
        """Adds the results of one batch."""
        want, got = expected.double(), found.double()
        self.count += want.numel()
        squares = want.square().sum(), (got - want).square().sum()
        self.sums += torch.stack((want.sum(), *squares))

    def share(self) -> float:
        """The result so far. It is infinite if a constant result changed."""
        mean, square, changed = (self.sums / self.count).tolist()
        variance = square - mean**2
        if variance > 0:
            return changed / variance
        return math.inf if changed else 0.0


def _checked(model: nn.Module, batches: Iterable[Sequence]) -> Batches:
    if not isinstance(model, Model):
        raise TypeError(f"model must be a model of create_model, got {type(model).__name__}")
    if quantized_layers(model):
        raise ValueError("the model is quantized already")
    kinds = {(p.dtype, p.device.type) for p in model.parameters()}
    if kinds != {(torch.float32, "cpu")}:
        raise ValueError(f"model must be in float32 on the CPU, got {kinds}")
    found = []
    for batch in batches:
        if isinstance(batch, Tensor) or len(batch) < 2 or not isinstance(batch[1], Lens | None):
            raise TypeError(
                f"batches must be of (images, lens), got a batch of type {type(batch).__name__}"
            )
        found.append((batch[0], batch[1]))
    if not sum(len(images) for images, _ in found):
        raise ValueError("batches must have pictures, got none")
    return found


def _parts(model: nn.Module, keep: Collection[str]) -> dict[str, list[str]]:
    """The linear layers of each part that may be quantized, by name."""
    keep = (keep,) if isinstance(keep, str) else keep
    if unknown := sorted(set(keep) - {name for name, _ in model.named_modules() if name}):
        raise ValueError(f"keep: the model has no module named {', '.join(unknown)}")
    parts: dict[str, list[str]] = {}
    for name, module in model.named_modules():
        for kind in type(module).__mro__:
            for part, layers in _QUANTIZED.get(kind, {}).items():
                parts[name + part] = [name + layer for layer in layers]
    kept = tuple(f"{name}." for name in keep)
    return {
        part: names
        for part, names in parts.items()
        if not any(f"{name}.".startswith(kept) for name in (part, *names))
    }


def _results(model: Model, batches: Batches) -> Iterator[Tensor]:
    """The result of each batch, flattened to (B, numbers)."""
    modes = [(module, module.training) for module in model.modules()]
    model.eval()
    try:
        for images, lens in batches:
            with torch.inference_mode():
                result = model(images, lens)
                maps = pytree.tree_leaves(result)
                flat = torch.cat([one.float().flatten(1) for one in maps], 1)
            yield flat
    finally:
        for module, training in modes:
            module.training = training


def _observed(
    model: Model, batches: Batches, names: Collection[str]
) -> tuple[dict[str, Quantization], list[Tensor]]:
    """The quantization of the input of each named layer, and the model's result of each batch."""
    kept: dict[str, list[Tensor]] = defaultdict(list)
    ends: dict[str, list[Tensor]] = defaultdict(list)
    chance = torch.Generator().manual_seed(0)

    def keep(name, module, arguments):
        values = arguments[0].detach().float().flatten()
        if values.numel():
            # Drawn at random: a fixed step would meet the same few channels.
            drawn = torch.randint(values.numel(), (_KEPT,), generator=chance)
            kept[name].append(values[drawn])
            ends[name].extend(values.aminmax())

    layers = dict(model.named_modules())
    hooks = [layers[name].register_forward_pre_hook(partial(keep, name)) for name in names]
    results = []
    try:
        with Progress("running the model on the pictures", len(batches)) as progress:
            for result in _results(model, batches):
                results.append(result)
                progress.done += 1
    finally:
        for hook in hooks:
            hook.remove()
    found = {}
    with Progress("choosing the ranges of activations", len(names)) as progress:
        for name in names:
            found[name] = _best_range(name, torch.cat(kept[name]), torch.stack(ends[name]))
            progress.done += 1
    return found, results


def _best_range(name: str, values: Tensor, ends: Tensor) -> Quantization:
    """The quantization with the least mean squared error."""
    if not ends.isfinite().all():
        raise ValueError(f"the input of {name} is not finite: check the pictures")
    lower, upper = min(ends.min().item(), 0.0), max(ends.max().item(), 0.0)

    def error(ends: tuple[float, float]) -> float:
        given = _of_range(*ends)
        return (dequantize(quantize(values, given), given) - values).square().sum().item()

    best = min(((share * lower, share * upper) for share in _SHARES), key=error)
    best = min(((best[0], share * upper) for share in _SHARES), key=error)
    best = min(((share * lower, best[1]) for share in _SHARES), key=error)
    return _of_range(*best)


def _of_range(lower: float, upper: float) -> Quantization:
    """The steps that reach from `lower` to `upper`, 0 being one of them exactly."""
    scale = max((upper - lower) / 255, 1e-12)
    return Quantization(scale, min(max(round(-lower / scale), 0), 255))
