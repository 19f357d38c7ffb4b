"""The comparison of a program with its model, when it is made."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from darswin.deploy.hidden import name_of
from darswin.deploy.program import NoProgramError
from darswin.deploy.record import RULES, Trace
from darswin.layers.quantized import quantized_layers

# Differences of results, as parts of their largest number. In float32, rounding ends at about 1e-6.
# It may move a number of 8 bits by one step, and then grows up to the error of 8 bits itself.
IN_FLOAT32, IN_8_BITS = 1e-4, 0.25


def tolerance_of(model: nn.Module) -> float:
    """The largest difference between the results of a model and of its program."""
    return IN_8_BITS if quantized_layers(model) else IN_FLOAT32


@torch.no_grad()
def compare(
    trace: Trace, inputs: Sequence[Tensor], model: Callable[[], Any],
    layers: Callable[..., Any], pictures: Sequence[Tensor], tolerance: float,
) -> None:  # fmt: skip
    """Compares a program with its model.

    Args:
        trace: of the program. inputs: those of the program for random pictures.
        model: computes the result for them. layers: the optimized layers, called with `pictures`.
        tolerance: the largest difference, as a part of the largest number of a result.

    Raises:
        NoProgramError: names the first instruction that computes something else.
    """
    try:
        expected = model()
    except Exception as error:
        raise NoProgramError(f"the model, which takes no random pictures: {error}") from error
    found = trace.returned(trace.program.checked()(inputs))
    pairs = [(found, expected)]
    if isinstance(expected, list) and trace.is_list and len(expected) == len(found):
        pairs = [*zip(found, expected, strict=True)]
    if not all(_near(*pair, tolerance) for pair in pairs):
        raise NoProgramError(
            f"{_first_difference(trace, inputs, layers, pictures, tolerance)} computes something "
            "else than in the model"
        )


def _near(found: Any, expected: Any, tolerance: float) -> bool:
    """Whether two tensors are equal up to a part of the largest number."""
    if not (isinstance(found, Tensor) and isinstance(expected, Tensor)):
        return False
    if found.shape != expected.shape or found.dtype != expected.dtype:
        return False
    finite = expected.nan_to_num(0.0, 0.0, 0.0).abs()
    most = tolerance * float(finite.max()) if finite.numel() else 0.0
    return torch.allclose(found, expected, rtol=0.0, atol=most, equal_nan=True)


def _first_difference(
    trace: Trace, inputs: Sequence[Tensor], layers: Callable[..., Any],
    pictures: Sequence[Tensor], tolerance: float,
) -> str:  # fmt: skip
    """The module and the function of the first instruction that differs from its function."""
    made: list[tuple[Any, Tensor]] = []

    class Followed(Tensor):
        """A tensor of which is noted what functions make of it."""

        @classmethod
        def __torch_function__(cls, function, types, arguments=(), named=None):
            result = super().__torch_function__(function, types, arguments, named or {})
            if function in RULES and isinstance(result, Tensor):
                with torch._C.DisableTorchFunctionSubclass():
                    made.append((function, result.as_subclass(Tensor).clone()))
            return result

    layers(*(picture.as_subclass(Followed) for picture in pictures))
    functions, count = iter(made), len(trace.results)
    for step in trace.steps:
        trace.output(step.value)
    found = trace.program.checked()(inputs)[count:]
    for step, numbers, of in zip(trace.steps, found, trace.results[count:], strict=True):
        expected = next((each for function, each in functions if function == step.function), None)
        if expected is None or not _near(of.ordered(numbers), expected, tolerance):
            return f"{step.module}: {name_of(step.function)}"
    return f"{type(trace.network).__name__}, as a whole,"
