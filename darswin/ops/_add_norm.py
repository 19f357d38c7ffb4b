"""add_norm_: a residual and the layer norm behind it, in place. Private: it has no reference."""

import torch
from torch import Tensor
from torch.autograd.graph import increment_version

from darswin.ops import _library


def add_norm_(x: Tensor, y: Tensor, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
    """Adds y to x, then makes y the layer norm of the sum: one pass over memory, for inference.

    Args:
        x: (..., D), contiguous, float32 or bfloat16; it becomes x + y.
        y: of the same type and size, contiguous; it becomes the norm, and is returned.
        weight, bias: (D,), float32. eps: added to the variance.

    With bfloat16 the arithmetic is float32, and the sum is rounded before it is normalized.
    Results do not depend on the number of threads.

    Raises:
        RuntimeError: tensors that do not fit, that share memory, or that require a gradient where
            one would be recorded: there is none.
    """
    torch.ops.darswin._add_norm_.default(x, y, weight, bias, eps)
    return y


@torch.library.register_fake("darswin::_add_norm_")
def _fake(x, y, weight, bias, eps):
    return None


_implementations = torch.library.Library("darswin", "IMPL")


def _no_gradient(keyset, *arguments):
    _library.refuse_other_derivatives("add_norm_", arguments)
    wants = [isinstance(t, Tensor) and t.requires_grad for t in arguments[:4]]
    if torch.is_grad_enabled() and any(wants):
        raise RuntimeError(
            "add_norm_ has no gradient, but one of its tensors requires one: call it under "
            "torch.no_grad(), or use torch.layer_norm(x + y, ...)"
        )
    with torch._C._AutoDispatchBelowAutograd():
        return torch.ops.darswin._add_norm_.default.redispatch(
            keyset & torch._C._after_autograd_keyset, *arguments
        )


def _changed(keyset, x, y, *others):
    # Autograd then notices where a value that it has saved was changed.
    increment_version((x, y))
    return torch.ops.darswin._add_norm_.default.redispatch(
        keyset & torch._C._after_ADInplaceOrView_keyset, x, y, *others
    )


_implementations.impl("_add_norm_", _no_gradient, "Autograd", with_keyset=True)
_implementations.impl("_add_norm_", _changed, "ADInplaceOrView", with_keyset=True)
