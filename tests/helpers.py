"""What several test files share."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor

from darswin.compat import OfficialPolynomial
from darswin.lens import Spherical
from darswin.ops import use_reference


def assert_accurate(
    operator: Callable[..., Tensor],
    make: Callable[[], Sequence[Tensor]],
    grad_mask: Callable[..., Tensor] | None = None,
    draws: int = 3,
    times: float = 2.0,
) -> None:
    """The accuracy rule: the float32 operator's error against the float64 reference is at most
    twice the float32 reference's own, for the output and for each gradient.

    Errors are largest absolute differences over all draws of `make`: a tensor of four numbers is
    too few to measure rounding with. Below four roundings of the largest value, a reference that
    happens to be exact sets no bar.

    Args:
        make: float32 inputs of `operator`. grad_mask: of the output's gradient, from the inputs.
        times: how many times the reference's own error is allowed, where twice is not the rule.
    """
    errors: dict[int, list[float]] = {}
    for _ in range(draws):
        inputs = make()
        mask = None if grad_mask is None else grad_mask(*inputs)
        oracle = _results(operator, inputs, torch.float64, mask, reference=True)
        baseline = _results(operator, inputs, torch.float32, mask, reference=True)
        ours = _results(operator, inputs, torch.float32, mask, reference=False)
        for index, (exact, base, got) in enumerate(zip(oracle, baseline, ours, strict=True)):
            assert got.dtype == torch.float32 and got.shape == exact.shape
            assert torch.equal(got.isnan(), exact.isnan()), f"result {index} is NaN elsewhere"
            if exact.numel() == 0:
                continue
            eps = torch.finfo(torch.float32).eps
            row = [(got - exact).abs().max(), (base - exact).abs().max(), eps * exact.abs().max()]
            before = errors.get(index, [0.0] * 3)
            errors[index] = [max(a, b.item()) for a, b in zip(before, row, strict=True)]
    for index, (error, base, rounding) in errors.items():
        allowed = max(times * base, 4 * rounding)
        assert error <= allowed, f"result {index}: error {error:.3g}, allowed {allowed:.3g}"


def _results(operator, inputs, dtype, grad_mask, *, reference: bool) -> list[Tensor]:
    leaves = [t.detach().to(dtype).requires_grad_() for t in inputs]
    with use_reference(reference):
        out = operator(*leaves)
    generator = torch.Generator().manual_seed(7)
    grad = torch.randn(out.shape, generator=generator).to(dtype)
    if grad_mask is not None:
        grad = grad * grad_mask
    return [out.detach(), *torch.autograd.grad(out, leaves, grad, allow_unused=False)]


def with_gradients(operator: Callable[..., Tensor], inputs: Sequence[Tensor]) -> list[Tensor]:
    """The output and the gradients of a random projection of it."""
    leaves = [t.detach().requires_grad_() for t in inputs]
    out = operator(*leaves)
    generator = torch.Generator().manual_seed(7)
    grad = torch.randn(out.shape, generator=generator).to(out.dtype)
    return [out.detach(), *torch.autograd.grad(out, leaves, grad)]


def assert_equals_reference(
    operator: Callable[..., Tensor], inputs: Sequence[Tensor], *, rtol: float, atol: float
) -> None:
    """The output and the gradients of `with_gradients` are the reference's."""
    ours = with_gradients(operator, inputs)
    with use_reference():
        expected = with_gradients(operator, inputs)
    for got, want in zip(ours, expected, strict=True):
        torch.testing.assert_close(got, want, rtol=rtol, atol=atol)


CALIBRATIONS = Path(__file__).parent / "lens" / "files"


def changed(name: str, old: str, new: str) -> str:
    """The text of an example calibration with something replaced, which must be there."""
    text = CALIBRATIONS.joinpath(name).read_text()
    assert old in text
    return text.replace(old, new)


FIXTURES = Path(__file__).parent / "fixtures"


def fixture(name):
    """A fixture of the released DarSwin: all its tensors, the state dict, and the lenses."""
    tensors = load_file(FIXTURES / f"official_{name}.safetensors")
    state = {k.removeprefix("state."): v for k, v in tensors.items() if k.startswith("state.")}
    dist = tensors["dist"]
    if name == "poly":
        return tensors, state, OfficialPolynomial(dist, 32.0)
    xi, focal, fov = dist.unbind(1)
    return tensors, state, Spherical(xi, focal, fov / 2)
