"""Loads the compiled module, and decides between it and the PyTorch reference."""

import contextlib
import importlib
from collections.abc import Iterator

import torch  # before the module: both must share the libgomp that torch loads

_reference = False


def load_extension():
    """Imports `darswin._C`; its ImportError says what was tried and how to rebuild."""
    try:
        return importlib.import_module("darswin._C")
    except ImportError as error:
        file = error.path or "darswin/_C.*.so (not found)"
        raise ImportError(
            f"cannot load the compiled module of darswin, {file}: {error}. It is built on "
            f"libtorch's stable ABI for torch>=2.10; torch {torch.__version__} is running. "
            "Rebuild it with `pip install --no-build-isolation --force-reinstall --no-deps darswin`"
            ", or in a checkout with `make build`."
        ) from error


@contextlib.contextmanager
def use_reference(enabled: bool = True) -> Iterator[None]:
    """Within this context the operators run their PyTorch reference on every device, CPU included.

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


def compiled(tensor: torch.Tensor) -> bool:
    """Whether an operator on `tensor` runs compiled code rather than the reference."""
    return tensor.device.type == "cpu" and not _reference


def autocast_dtype(tensor: torch.Tensor) -> torch.dtype | None:
    """What autocast, where it is on for the tensor's device, computes in."""
    device = tensor.device.type
    if not torch.amp.is_autocast_available(device) or not torch.is_autocast_enabled(device):
        return None
    return torch.get_autocast_dtype(device)


def without_float16(tensor: torch.Tensor) -> torch.Tensor:
    """Under autocast, a float16 tensor as float32: the operators have no float16."""
    half = tensor.dtype == torch.float16 and autocast_dtype(tensor) is not None
    return tensor.float() if half else tensor


def output_bfloat16(image: torch.Tensor) -> bool:
    """Whether an operator on `image` gives bfloat16: as the image is, or as autocast says."""
    if image.dtype == torch.float64:
        return False
    return image.dtype == torch.bfloat16 or autocast_dtype(image) == torch.bfloat16


def autocast_off(device: str) -> contextlib.AbstractContextManager:
    """A context in which autocast does not touch the arithmetic of a reference."""
    if not torch.amp.is_autocast_available(device):
        return contextlib.nullcontext()
    return torch.autocast(device, enabled=False)


def no_second_derivative(name: str) -> None:
    """Makes an operator's backward raise where it is differentiated again, rather than be wrong."""

    def raise_error(ctx, *grads):
        raise NotImplementedError(
            f"{name} has no second derivative; run it within darswin.ops.use_reference() for one"
        )

    torch.library.register_autograd(f"{name}_backward", raise_error)


load_extension()
