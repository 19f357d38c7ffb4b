"""window_attention: attention in the windows of a polar map. Public function, fake and autograd."""

import torch
from torch import Tensor

from darswin.ops import _library, reference
from darswin.ops.checks import DTYPES, check_pair, check_tensor

_ATTENTION = _library.operator("window_attention")


def window_attention(
    qkv: Tensor,
    bias: Tensor,
    *,
    window: tuple[int, int],
    shift: tuple[int, int] = (0, 0),
    periodic: tuple[bool, bool] = (False, True),
    scale: float | None = None,
) -> Tensor:
    """Attends inside each window of a polar map: `softmax(q·k·scale + bias)·v`.

    The windows tile the map after a roll by `-shift`. Along an axis that is not periodic, tokens do
    not attend to tokens that the roll brought in from the opposite border. The operator computes
    indices instead of rolling, partitioning or masking tensors in memory.

    Args:
        qkv: (B, R, A, 3, heads, d), float32, float64 or bfloat16. bfloat16 is computed in float32,
            and the result and the gradient of qkv are rounded once.
        bias: (B or 1, heads, 2·M_r-1, 2·M_φ-1): entry [Δr+M_r-1, Δφ+M_φ-1], Δ = query - key. It has
            the dtype of qkv. For a bfloat16 qkv it may be float32, and is used in float32.
        window: (M_r, M_φ), which divides (R, A).
        shift: (s_r, s_φ), 0 ≤ s_r < R and 0 ≤ s_φ < A.
        periodic: two bools, True if the map wraps around along (radius, azimuth). A plain Swin map
            is (False, False).
        scale: the factor of the logits; None means d^-½.

    Returns:
        (B, R, A, heads·d).

    backward() gives gradients for qkv and bias. It recomputes the probabilities, so only the
    arguments are kept. Results and gradients do not depend on the number of threads.

    Raises:
        TypeError: a tensor has an unsupported dtype, or an argument has the wrong type.
        ValueError: a shape, device or range does not fit.
        NotImplementedError: forward-mode, torch.func or second derivatives are requested.

    Source: DarSwin, ICCV 2023, sec. 4.4; Swin Transformer, ICCV 2021, sec. 3.2.
    """
    window = check_pair("window", window, lowest=1)
    shift = check_pair("shift", shift, lowest=0)
    if not isinstance(periodic, (tuple, list)) or len(periodic) != 2:
        raise TypeError(f"periodic must be a pair of bools, got {periodic!r}")
    # torch.jit.trace rejects lists of bools.
    wrap = int(bool(periodic[0])), int(bool(periodic[1]))
    if not isinstance(qkv, Tensor) or qkv.dim() != 6 or qkv.shape[5] == 0:
        _check(qkv, bias, window, shift)  # raises: the scale comes from the head dim
    # The bias of a bfloat16 qkv is used in float32; autocast may have narrowed it.
    if isinstance(bias, Tensor) and bias.dtype == torch.bfloat16:
        narrow = qkv.dtype == torch.bfloat16 or _library.autocast_dtype(qkv) is not None
        bias = bias.float() if narrow else bias
    scale = qkv.shape[5] ** -0.5 if scale is None else float(scale)
    arguments = (qkv, bias, window, shift, wrap, scale)
    return _library.call(_ATTENTION, _check, reference.window_attention, arguments)


def _check(qkv, bias, window, shift, *others) -> None:
    """Raises TypeError or ValueError unless the arguments of the operator fit."""
    shape = (None, None, None, 3, None, None)
    check_tensor("qkv", qkv, (*DTYPES, torch.bfloat16), "(B, R, A, 3, heads, d)", shape)
    batch, rings, sectors, _, heads, head_dim = qkv.shape
    if rings == 0 or sectors == 0 or head_dim == 0:
        raise ValueError(f"qkv must have rings, sectors and a head dim, got {tuple(qkv.shape)}")
    if rings % window[0] or sectors % window[1]:
        raise ValueError(f"window must divide (R, A) = ({rings}, {sectors}), got {tuple(window)}")
    if shift[0] >= rings or shift[1] >= sectors:
        raise ValueError(f"shift must lie inside (R, A) = ({rings}, {sectors}), got {tuple(shift)}")
    real = torch.float32 if qkv.dtype == torch.bfloat16 else qkv.dtype
    table = (heads, 2 * window[0] - 1, 2 * window[1] - 1)
    form = "(B or 1, heads, 2·M_r-1, 2·M_φ-1) = ({} or 1, {}, {}, {})"
    check_tensor("bias", bias, (real,), form, (batch, *table), (1, *table), like=qkv)


@_library.register_fake("window_attention")
def _fake(qkv, bias, window, shift, periodic, scale):
    _check(qkv, bias, window, shift)
    batch, rings, sectors, _, heads, head_dim = qkv.shape
    return qkv.new_empty((batch, rings, sectors, heads * head_dim))


_library.register_gradients("window_attention", {0: 0, 1: 0})
