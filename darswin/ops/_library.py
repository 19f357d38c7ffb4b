"""Runs an operator, compiled or as its reference, and defines its derivatives."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch._ops import OpOverload
from torch.autograd import forward_ad

from darswin.ops import _module

transformed = torch._C._are_functorch_transforms_active  # True within a transform of torch.func
_LIBRARY = torch.library.Library("darswin", "IMPL")
_reference = _module.LACK is not None


@contextlib.contextmanager
def use_reference(enabled: bool = True) -> Iterator[None]:
    """Makes the operators run their PyTorch reference on every device within this context.

    The reference defines each operator in plain steps and has all derivatives. Without the compiled
    module it always runs.

    The switch holds for the whole process, not for one thread.
    """
    global _reference
    before, _reference = _reference, enabled or _module.LACK is not None
    try:
        yield
    finally:
        _reference = before


def reference_in_use() -> bool:
    """True within `use_reference`, and without the compiled module."""
    return _reference


def no_gradients() -> contextlib.AbstractContextManager[None]:
    """`torch.no_grad()` where gradients are recorded. Elsewhere it does nothing: a graph would be
    taken apart there, which takes seconds to export."""
    return torch.no_grad() if torch.is_grad_enabled() else contextlib.nullcontext()


def operator(name: str) -> Any:
    """An operator of the compiled module. Without the module, it refuses calls."""
    if _module.LACK is not None:
        return partial(_module.require, name)
    return getattr(torch.ops.darswin, name).default


def register_fake(name: str) -> Callable[[Callable], Callable]:
    """Registers the decorated function as the fake of an operator, if the module is loaded."""
    if _module.LACK is not None:
        return lambda fake: fake
    return torch.library.register_fake(f"darswin::{name}")


def _has_autocast(device: str) -> bool:
    return torch.amp.is_autocast_available(device)


# Dynamo calls the function and builds the result into the graph. Before torch 2.12 it cannot trace
# the call inside. torch.compiler.assume_constant_result sets the same mark, but it imports Dynamo,
# which takes as long as importing torch.
_has_autocast._dynamo_marked_constant = True  # type: ignore[attr-defined]


def autocast_dtype(tensor: Tensor) -> torch.dtype | None:
    """The dtype of autocast on the tensor's device, or None if autocast is off."""
    device = "cpu" if tensor.is_cpu else tensor.device.type
    if not (device == "cpu" or _has_autocast(device)) or not torch.is_autocast_enabled(device):
        return None
    return torch.get_autocast_dtype(device)


def call(
    operator: OpOverload,
    explain: Callable[..., None],
    reference: Callable[..., Any],
    arguments: Sequence[Any],
) -> Any:
    """The only way to an operator: compiled code on the CPU, elsewhere the reference.

    `explain(*arguments)` raises TypeError or ValueError if an argument does not fit. The compiled
    code refuses the same arguments, but gives no readable reason. The check takes longer than a
    small call, so it runs only after a refusal. It runs first for the reference and while a graph
    is compiled. The fakes of the operators call it too.
    """
    first = arguments[0]
    compiled = isinstance(first, Tensor) and first.is_cpu and not _reference
    if compiled and not torch.compiler.is_compiling():
        try:
            if torch.is_inference_mode_enabled() or _may_be_derived(arguments):
                return operator(*arguments)
            # The same, without the step into `differentiable`, which takes as long as the rest.
            with torch._C._AutoDispatchBelowAutograd():
                return operator(*arguments)
        except RuntimeError:
            try:
                explain(*arguments)
            except (TypeError, ValueError) as reason:
                raise reason from None
            raise
    explain(*arguments)
    if compiled:
        return operator(*arguments)
    # Autocast would change the arithmetic of the reference. Where it is off, there is no context:
    # in an exported graph it would become a graph of its own.
    if autocast_dtype(first) is None:
        return reference(*arguments)
    with torch.autocast(first.device.type, enabled=False):
        return reference(*arguments)


# -- derivatives -----------------------------------------------------------------------------------


def _may_be_derived(arguments: Sequence[Any]) -> bool:
    """True if a gradient is recorded, or another derivative may be asked for."""
    if forward_ad._current_level >= 0 or transformed():
        return True
    if torch.is_grad_enabled():
        for value in arguments:
            if isinstance(value, Tensor) and value.requires_grad:
                return True
    return False


def register_gradients(name: str, groups: dict[int, int]) -> None:
    """Registers the autograd of an operator, and the fake of its backward.

    `groups` maps the index of each argument that has a gradient to its group, in the order of the
    results of backward. The backward operator takes the operator's first arguments, what the
    operator returned after its output, the gradient of the output, and a bool for each group:
    whether a gradient of this group is wanted. A backward operator without these bools computes
    all gradients.
    """
    if _module.LACK is not None:  # torch differentiates the reference
        return
    backward = operator(f"{name}_backward")
    names = [argument.name for argument in backward._schema.arguments]
    taken = names.index("grad_out")
    bools = len(names) - taken - 1

    def gradients(ctx, grad_out, *_):
        tensors, needs = ctx.saved_tensors, ctx.needs_input_grad
        inputs = [o if t is None else t for t, o in zip(tensors, ctx.others, strict=True)]
        wanted = [any(needs[i] for i, of in groups.items() if of == k) for k in range(bools)]
        results = [None] * len(needs)
        found = backward(*inputs[:taken], grad_out, *wanted)
        for index, gradient in zip(groups, found, strict=True):
            if needs[index]:
                results[index] = gradient.to(inputs[index].dtype)
        return tuple(results)

    def second_derivative(ctx, *grads):
        raise NotImplementedError(
            f"darswin::{name} has no second derivative; run it within "
            "darswin.ops.use_reference() for one"
        )

    def fake_backward(*arguments):
        return empty_gradients(arguments, groups, arguments[taken + 1 :])

    keeps = len(operator(name)._schema.returns) > 1
    _register_autograd(operator(name), f"darswin.{name}", gradients, keeps)
    _register_autograd(backward, f"{name}'s backward", second_derivative)
    register_fake(f"{name}_backward")(fake_backward)


def _register_autograd(
    operator: OpOverload, title: str, gradients: Callable, keeps: bool = False
) -> None:
    """Makes autograd record the operator; `gradients(ctx, *grads)` is its derivative. If the
    operator `keeps` all results but the first, they are for the derivative alone.

    The dispatcher calls `differentiable` in every mode: eager, compiled, exported and traced.
    torch.library.register_autograd would do the same, but it takes 10 to 40 µs more to record a
    gradient, and gives zeros for forward-mode AD. A call of a public function takes 4 to 8 µs more
    than the compiled code alone, and 13 to 20 µs more if a gradient is recorded.
    """
    kinds = [str(argument.type) for argument in operator._schema.arguments]
    tensors = [index for index, kind in enumerate(kinds) if "Tensor" in kind]
    use_torch_threads = _module.torch_threads_switch()

    def record(ctx, *arguments):
        use_torch_threads(True)
        try:
            with torch._C._AutoDispatchBelowAutograd():
                results = operator(*arguments)
        finally:
            use_torch_threads(False)
        if keeps:
            ctx.mark_non_differentiable(*results[1:])
            ctx.set_materialize_grads(False)  # theirs would be as many zeros
            arguments = (*arguments, *results[1:])
        ctx.save_for_backward(*[x if isinstance(x, Tensor) else None for x in arguments])
        ctx.others = [None if isinstance(x, Tensor) else x for x in arguments]
        return results

    methods = {"forward": staticmethod(record), "backward": staticmethod(gradients)}
    name = operator._schema.name.removeprefix("darswin::")
    recorder = type(name, (torch.autograd.Function,), methods)

    def differentiable(*arguments):
        if forward_ad._current_level >= 0 or transformed():
            _refuse_other_derivatives(title, arguments)
        if torch.is_grad_enabled():
            for index in tensors:
                if arguments[index] is not None and arguments[index].requires_grad:
                    return recorder.apply(*arguments)
        with torch._C._AutoDispatchBelowAutograd():
            return operator(*arguments)

    _LIBRARY.impl(name, differentiable, "Autograd")


def _refuse_other_derivatives(title: str, arguments: Sequence[Any]) -> None:
    """Raises NotImplementedError if forward-mode AD or torch.func differentiates a tensor.

    Otherwise forward-mode AD would silently give zeros, and torch.func would raise an error about
    the internals of autograd.
    """
    for value in arguments:
        if not isinstance(value, Tensor):
            continue
        if forward_ad.unpack_dual(value).tangent is not None:
            mode = "forward-mode derivatives"
        elif transformed() and value.requires_grad:
            mode = "torch.func derivatives"
        else:
            continue
        raise NotImplementedError(
            f"{title} has no {mode}, only backward(); run it within "
            "darswin.ops.use_reference() for them"
        )


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
