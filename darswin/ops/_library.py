"""Decides between the compiled operators and their twins in PyTorch."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.graph import increment_version

from darswin.ops import _module, triton

_reference = False


def cpu_capability() -> str:
    """The instruction-set tier that the operators run on: "generic", "avx2" or "avx512".

    It is the best one of this CPU; ATEN_CPU_CAPABILITY (default, avx2, avx512) lowers it, as it
    does in torch.
    """
    return _module.tier()


@contextlib.contextmanager
def use_reference(enabled: bool = True) -> Iterator[None]:
    """Within this context the operators run their PyTorch reference on every device, CPU included.

    It is the definition in plain steps, with all derivatives; other devices do without it.

    The switch is one for the process, not one a thread.
    """
    global _reference
    before, _reference = _reference, enabled
    try:
        yield
    finally:
        _reference = before


def reference_in_use() -> bool:
    """Whether `use_reference` is in force."""
    return _reference


def compiled(tensor: Tensor) -> bool:
    """Whether an operator on `tensor` runs compiled code rather than the reference."""
    return tensor.device.type == "cpu" and not _reference


def has_kernels(tensor: Tensor) -> bool:
    """Whether operators on `tensor` run the kernels of `darswin.ops.triton`, where these compute
    what is asked for.

    A graph that is exported consists of torch's own operations: it runs without this package.
    """
    usable = triton.INSTALLED and not _reference and not torch.compiler.is_exporting()
    return usable and tensor.device.type == "cuda" and _is_known_gpu(tensor.device.index)


def _constant(function: Callable[..., bool]) -> Callable[..., bool]:
    """Lets Dynamo call a function while it traces and build the result into the graph.

    `torch.compiler.assume_constant_result` sets the same mark, but it imports Dynamo, which takes
    as long as torch itself.
    """
    function._dynamo_marked_constant = True  # type: ignore[attr-defined]
    return function


@_constant
def _is_known_gpu(index: int) -> bool:
    """Whether the kernels were made for a CUDA device: NVIDIA's since the A100. AMD's are called
    "cuda" too."""
    return torch.version.hip is None and torch.cuda.get_device_capability(index) >= (8, 0)


@_constant  # before torch 2.12 Dynamo cannot trace what it calls
def _has_autocast(device: str) -> bool:
    return torch.amp.is_autocast_available(device)


def autocast_dtype(tensor: Tensor) -> torch.dtype | None:
    """What autocast, where it is on for the tensor's device, computes in."""
    device = tensor.device.type
    if not _has_autocast(device) or not torch.is_autocast_enabled(device):
        return None
    return torch.get_autocast_dtype(device)


def without_float16(tensor: Tensor) -> Tensor:
    """Under autocast, a float16 tensor as float32: the operators have no float16."""
    half = tensor.dtype == torch.float16 and autocast_dtype(tensor) is not None
    return tensor.float() if half else tensor


def output_bfloat16(image: Tensor) -> bool:
    """Whether an operator on `image` gives bfloat16: as the image is, or as autocast says."""
    if image.dtype == torch.float64:
        return False
    return image.dtype == torch.bfloat16 or autocast_dtype(image) == torch.bfloat16


def autocast_off(device: str) -> contextlib.AbstractContextManager:
    """A context in which autocast does not touch the arithmetic of a reference."""
    if not _has_autocast(device):
        return contextlib.nullcontext()
    return torch.autocast(device, enabled=False)


def run(
    reference: Callable[..., Tensor],
    on_devices: Callable[..., Tensor],
    *arguments: Any,
    kernel: bool = False,
) -> Tensor:
    """An operator on checked arguments: compiled, a kernel for GPUs, or one of its twins.

    The compiled one and the kernel take the fields of a NamedTuple one by one.

    Args:
        reference: the twin of the same name in reference.py.
        on_devices: what runs on devices other than the CPU, where there is no kernel.
        kernel: whether there is a kernel that computes this, where `has_kernels`.
    """
    flat: list[Any] = []
    for argument in arguments:
        flat.extend(argument if hasattr(argument, "_fields") else (argument,))
    fused = compiled(flat[0]) or (kernel and has_kernels(flat[0]))
    twin = reference if _reference else on_devices
    if fused or twin is not reference:
        refuse_other_derivatives(f"darswin.{reference.__name__}", flat)
    if fused:
        return getattr(torch.ops.darswin, reference.__name__)(*flat)
    with autocast_off(flat[0].device.type):
        return twin(*arguments)


def refuse_other_derivatives(operator: object, tensors: Iterable[object]) -> None:
    """NotImplementedError where forward-mode AD or torch.func differentiates one of the tensors.

    The first would come to zeros without a word, the second to an error about autograd's insides.
    While a graph is compiled only forward-mode AD is looked for: torch.func.grad fails by itself.
    """
    forward = forward_ad._current_level >= 0
    functional = (
        not torch.compiler.is_compiling()
        and torch._C._functorch.peek_interpreter_stack() is not None
    )
    if not forward and not functional:
        return
    for tensor in tensors:
        if not isinstance(tensor, Tensor):
            continue
        tracked, tensor = _unwrapped(tensor) if functional else (False, tensor)
        if tracked:
            mode = "torch.func's derivatives"
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
    """Whether a transform of torch.func differentiates with respect to the tensor, and what it
    wraps."""
    functorch, tracked = torch._C._functorch, False
    while functorch.is_functorch_wrapped_tensor(tensor):
        tracked |= functorch.is_gradtrackingtensor(tensor)
        tensor = functorch.get_unwrapped(tensor)
    return tracked, tensor


def no_second_derivative(name: str) -> None:
    """Makes an operator's backward raise where it is differentiated again, rather than be wrong."""

    def raise_error(ctx, *grads):
        raise NotImplementedError(
            f"{name} has no second derivative; run it within darswin.ops.use_reference() for one"
        )

    torch.library.register_autograd(f"{name}_backward", raise_error)


_implementations = torch.library.Library("darswin", "IMPL")


def without_gradient(name: str, *, changes: int, instead: str) -> None:
    """Makes an operator raise where a gradient of it would be recorded: it has none.

    Args:
        changes: how many of its first arguments it changes in place, which autograd then notices.
        instead: what has a gradient.
    """
    operator = getattr(torch.ops.darswin, name).default
    plain = name.removeprefix("_")

    def no_gradient(keyset, *arguments):
        refuse_other_derivatives(plain, arguments)
        wants = any(isinstance(a, Tensor) and a.requires_grad for a in arguments)
        if torch.is_grad_enabled() and wants:
            raise RuntimeError(
                f"{plain} has no gradient, but one of its tensors requires one: call it under "
                f"torch.no_grad(), or use {instead}"
            )
        with torch._C._AutoDispatchBelowAutograd():
            return operator.redispatch(keyset & torch._C._after_autograd_keyset, *arguments)

    def changed(keyset, *arguments):
        increment_version([a for a in arguments[:changes] if a is not None])
        return operator.redispatch(keyset & torch._C._after_ADInplaceOrView_keyset, *arguments)

    _implementations.impl(name, no_gradient, "Autograd", with_keyset=True)
    if changes:
        _implementations.impl(name, changed, "ADInplaceOrView", with_keyset=True)
