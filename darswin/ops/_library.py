"""Chooses the code that an operator runs, compiled or reference, and defines its derivatives."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.autograd import forward_ad

_reference = False
_PLAIN = (Tensor, torch.nn.Parameter)
# Operator → the function that records its gradient in eager mode.
_recorders: dict[OpOverload, type[torch.autograd.Function]] = {}


@contextlib.contextmanager
def use_reference(enabled: bool = True) -> Iterator[None]:
    """Makes the operators run their PyTorch reference on every device within this context.

    The reference defines each operator in plain steps and has all derivatives.

    The switch holds for the whole process, not for one thread.
    """
    global _reference
    before, _reference = _reference, enabled
    try:
        yield
    finally:
        _reference = before


def reference_in_use() -> bool:
    """True within `use_reference`."""
    return _reference


def _constant(function: Callable[..., bool]) -> Callable[..., bool]:
    """Lets Dynamo call a function while it traces and build the result into the graph."""
    # torch.compiler.assume_constant_result sets the same mark, but it imports Dynamo, which takes
    # as long as importing torch.
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


@_constant  # before torch 2.12 Dynamo cannot trace the call inside
def _has_autocast(device: str) -> bool:
    return torch.amp.is_autocast_available(device)


def autocast_dtype(tensor: Tensor) -> torch.dtype | None:
    """The dtype of autocast on the tensor's device, or None if autocast is off."""
    device = tensor.device.type
    if not _has_autocast(device) or not torch.is_autocast_enabled(device):
        return None
    return torch.get_autocast_dtype(device)


def output_bfloat16(image: Tensor) -> bool:
    """True if an operator on `image` returns bfloat16, due to the image's dtype or autocast."""
    if image.dtype == torch.float64:
        return False
    return image.dtype == torch.bfloat16 or autocast_dtype(image) == torch.bfloat16


def autocast_off(device: str) -> contextlib.AbstractContextManager:
    """A context in which autocast does not change the arithmetic of a reference."""
    # Where autocast is off, no context: in an exported graph it would become a graph of its own.
    if not _has_autocast(device) or not torch.is_autocast_enabled(device):
        return contextlib.nullcontext()
    return torch.autocast(device, enabled=False)


def run(operator: OpOverload, reference: Callable[..., Tensor], *arguments: Any) -> Tensor:
    """Runs an operator on checked arguments: compiled code on the CPU, otherwise the reference. A
    `Sampling` is passed field by field."""
    first, *others = arguments
    flat = [*first, *others] if isinstance(first, tuple) else arguments
    first = flat[0]
    if not _reference:
        refuse_other_derivatives(f"darswin.{reference.__name__}", flat)
        if first.device.type == "cpu":
            return call(operator, flat)
    with autocast_off(first.device.type):
        return reference(*arguments)


def attempt(operator: OpOverload, arguments: Sequence[Any]) -> Any:
    """The operator's result, or None if it refuses the arguments. It does not explain why."""
    try:
        return call(operator, arguments)
    except RuntimeError:
        return None


def may_attempt() -> bool:
    """True if plain tensors may go to the compiled operator unchecked: no special mode is on."""
    return not (
        _reference
        or not eager()
        or forward_ad._current_level >= 0
        or torch.is_autocast_enabled("cpu")
    )


def plain(*tensors: Any) -> bool:
    """True if all are tensors on the CPU and none is of a subclass of Tensor or Parameter."""
    for tensor in tensors:  # all() with a generator takes twice as long
        if type(tensor) not in _PLAIN:
            return False
        if not tensor.is_cpu:
            return False
    return True


def call(operator: OpOverload, arguments: Sequence[Any]) -> Any:
    """Calls the operator and skips the autograd of torch.library where it is not needed: that
    takes 9 µs without a gradient and 100 µs to record one."""
    if not eager():
        return operator(*arguments)
    if torch.is_grad_enabled():
        recorder = _recorders.get(operator)
        if recorder is None:
            return operator(*arguments)
        for value in arguments:
            if isinstance(value, Tensor) and value.requires_grad:
                return recorder.apply(*arguments)
    with torch._C._AutoDispatchBelowAutograd():
        return operator(*arguments)


def eager() -> bool:
    """True in eager mode: no graph is being compiled, exported or traced, and no transform of
    torch.func is active."""
    return not (torch.compiler.is_compiling() or transformed() or torch._C._is_tracing())


def transformed() -> bool:
    """True within a transform of torch.func."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def refuse_other_derivatives(operator: object, tensors: Iterable[object]) -> None:
    """Raises NotImplementedError if forward-mode AD or torch.func differentiates a tensor.

    Otherwise forward-mode AD would silently give zeros, and torch.func would raise an error about
    the internals of autograd.
    """
    # While a graph is compiled, torch.func.grad fails by itself.
    forward = forward_ad._current_level >= 0
    functional = not torch.compiler.is_compiling() and transformed()
    if not forward and not functional:
        return
    for tensor in tensors:
        if not isinstance(tensor, Tensor):
            continue
        tracked, tensor = _unwrapped(tensor) if functional else (False, tensor)
        if tracked:
            mode = "torch.func derivatives"
        elif forward and forward_ad.unpack_dual(tensor).tangent is not None:
            mode = "forward-mode derivatives"
        else:
            continue
        message = (
            f"{operator} has no {mode}, only backward(); run it within "
            "darswin.ops.use_reference() for them"
        )
        if torch.compiler.is_dynamo_compiling():
            # After an exception Dynamo would compile the parts of the function without tangents.
            with torch._dynamo.error_on_graph_break(True):
                torch._dynamo.graph_break(message)
        raise NotImplementedError(message)


def _unwrapped(tensor: Tensor) -> tuple[bool, Tensor]:
    """True if torch.func differentiates with respect to the tensor; and the wrapped tensor."""
    functorch, tracked = torch._C._functorch, False
    while functorch.is_functorch_wrapped_tensor(tensor):
        tracked |= functorch.is_gradtrackingtensor(tensor)
        tensor = functorch.get_unwrapped(tensor)
    return tracked, tensor


def empty_gradients(
    arguments: Sequence[Any], groups: dict[int, int], wanted: Sequence[bool]
) -> tuple[Tensor, ...]:
    """Empty gradients shaped like those of backward: (0,) for arguments that are None and for
    gradients that are not wanted."""
    gradients = []
    for index, group in groups.items():
        value = arguments[index]
        like = arguments[1] if value is None else value  # all arguments of a lens share a dtype
        shape = (0,) if value is None or not (wanted[group] if wanted else True) else value.shape
        gradients.append(like.new_empty(shape))
    return tuple(gradients)


def register_gradients(
    name: str, groups: dict[int, int], fake: Callable[..., tuple[Tensor, ...]] | None = None
) -> None:
    """Registers the autograd of an operator, and `fake` or a default as the fake of its backward.

    `groups` maps the index of each argument that has a gradient to its group, in the order of the
    results of backward. The backward operator takes the operator's first arguments, the gradient
    of the output, and a bool for each group: whether a gradient of this group is wanted. A
    backward operator without these bools computes all gradients.
    """
    backward = getattr(torch.ops.darswin, f"{name}_backward").default
    names = [argument.name for argument in backward._schema.arguments]
    taken = names.index("grad_out")
    bools = len(names) - taken - 1

    def fake_backward(*arguments):
        return empty_gradients(arguments, groups, arguments[taken + 1 :])

    operator = getattr(torch.ops.darswin, name).default

    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*[x if isinstance(x, Tensor) else None for x in inputs])
        ctx.others = [None if isinstance(x, Tensor) else x for x in inputs]

    def record(ctx, *inputs):
        setup_context(ctx, inputs, None)
        with torch._C._AutoDispatchBelowAutograd():
            return operator(*inputs)

    def gradients(ctx, grad_out):
        refuse_other_derivatives(f"{name}'s backward", (grad_out,))
        tensors, needs = ctx.saved_tensors, ctx.needs_input_grad
        inputs = [o if t is None else t for t, o in zip(tensors, ctx.others, strict=True)]
        wanted = [any(needs[i] for i, of in groups.items() if of == k) for k in range(bools)]
        results = [None] * len(inputs)
        found = call(backward, [*inputs[:taken], grad_out, *wanted])
        for index, gradient in zip(groups, found, strict=True):
            if needs[index]:
                results[index] = gradient.to(inputs[index].dtype)
        return tuple(results)

    def second_derivative(ctx, *grads):
        raise NotImplementedError(
            f"darswin::{name} has no second derivative; run it within "
            "darswin.ops.use_reference() for one"
        )

    torch.library.register_fake(f"darswin::{name}_backward", fake or fake_backward)
    torch.library.register_autograd(f"darswin::{name}", gradients, setup_context=setup_context)
    torch.library.register_autograd(f"darswin::{name}_backward", second_derivative)
    methods = {"forward": staticmethod(record), "backward": staticmethod(gradients)}
    _recorders[operator] = type(name, (torch.autograd.Function,), methods)
