import math
import subprocess
import sys

import pytest
import torch
import torch.nn.functional as F

from darswin.ops import _module, cpu_capability
from darswin.ops._inference import add_norm_

EPS = 1e-5
# Less than a register, registers and a rest, what the models have, and enough for many threads.
SHAPES = [(1, 1), (3, 7), (2, 5, 37), (4, 16, 96), (8, 16, 64, 96), (128, 768)]


def make_inputs(shape, dtype=torch.float32, mean=0.0):
    x, y = (torch.randn(shape).to(dtype) for _ in range(2))
    return x + mean, y, torch.randn(shape[-1]), torch.randn(shape[-1])


@pytest.mark.parametrize("mean", [0.0, 300.0])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_float32_is_as_accurate_as_torch(shape, mean):
    x, y, weight, bias = make_inputs(shape, mean=mean)
    total = x + y
    want = F.layer_norm(total.double(), shape[-1:], weight.double(), bias.double(), EPS)
    theirs = F.layer_norm(total, shape[-1:], weight, bias, EPS)
    got = add_norm_(x, y, weight, bias, EPS)
    assert got is y
    assert torch.equal(x, total)
    floor = 4 * torch.finfo(torch.float32).eps * want.abs().max()
    assert (got - want).abs().max() <= max(2 * (theirs - want).abs().max(), floor)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_bfloat16_rounds_the_sum_and_the_norm_once(shape):
    x, y, weight, bias = make_inputs(shape, torch.bfloat16)
    total = x + y
    want = F.layer_norm(total.float(), shape[-1:], weight, bias, EPS)
    got = add_norm_(x, y, weight, bias, EPS)
    assert torch.equal(x, total)
    torch.testing.assert_close(got.float(), want, rtol=2**-8, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_constant_rows_and_rows_that_are_not_finite(dtype):
    x, y, weight, bias = make_inputs((5, 40), dtype)
    x[1], y[1] = 2.5, -1.25
    x[2, 33], y[3, 2] = math.nan, math.inf
    clean = x.clone()[4:], y.clone()[4:]
    add_norm_(x, y, weight, bias, EPS)
    torch.testing.assert_close(y[1], bias.to(dtype))
    assert y[2].isnan().all() and y[3].isnan().all()
    assert x[2].isnan().sum() == 1 and x[3, 2] == math.inf
    assert torch.equal(y[4:], add_norm_(*clean, weight, bias, EPS))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_same_bits_for_any_number_of_threads(threads, dtype):
    x, y, weight, bias = make_inputs((333, 100), dtype)
    results = []
    for count in (1, 2, 5):
        threads(count)
        results.append(add_norm_(x.clone(), y.clone(), weight, bias, EPS))
    assert all(torch.equal(results[0], other) for other in results[1:])


@pytest.mark.parametrize("shape", [(0, 8), (3, 0, 8), (4, 0)], ids=str)
def test_nothing(shape):
    x, y, weight, bias = make_inputs(shape)
    assert add_norm_(x, y, weight, bias, EPS).shape == shape


def test_opcheck():
    torch.library.opcheck(torch.ops.darswin._add_norm_.default, (*make_inputs((4, 24)), EPS))


@pytest.mark.parametrize(
    "change",
    [
        dict(x=torch.zeros(6, 4, dtype=torch.float64)),
        dict(x=torch.zeros(4, 6).t()),
        dict(y=torch.zeros(6, 4, dtype=torch.bfloat16)),
        dict(y=torch.zeros(5, 4)),
        dict(y=torch.zeros(4, 6)),
        dict(y=torch.zeros(6, 8)[:, ::2]),
        dict(weight=torch.zeros(3)),
        dict(bias=torch.zeros(4, dtype=torch.bfloat16)),
        dict(bias=torch.zeros(1, 4)),
    ],
    ids=lambda change: "-".join(change),
)
def test_wrong_arguments(change):
    given = dict(zip(("x", "y", "weight", "bias"), make_inputs((6, 4)), strict=True)) | change
    with pytest.raises(RuntimeError, match="add_norm_"):
        add_norm_(**given, eps=EPS)


@pytest.mark.parametrize("width", [384, 768, 1500])
def test_a_large_mean_costs_no_digits_on_any_tier(width):
    x, y, weight, bias = make_inputs((64, width), mean=300.0)
    total = (x + y).double()
    want = F.layer_norm(total, (width,), weight.double(), bias.double(), EPS)
    own = F.layer_norm(x + y, (width,), weight, bias, EPS)
    before = cpu_capability()
    try:
        for tier in _module.tiers():
            _module.set_tier(tier)
            got = add_norm_(x.clone(), y.clone(), weight, bias, EPS)
            assert (got - want).abs().max() <= (own - want).abs().max()
    finally:
        _module.set_tier(before)


@pytest.mark.parametrize("index", range(4), ids=["x", "y", "weight", "bias"])
@pytest.mark.parametrize("raw", [False, True])
def test_what_requires_a_gradient_is_refused(index, raw):
    run = torch.ops.darswin._add_norm_ if raw else add_norm_
    inputs = list(make_inputs((4, 8)))
    inputs[index].requires_grad_()
    leaf = inputs[index]
    inputs[index] = leaf * 1  # not a leaf, so that torch itself would let it change
    kept = [t.detach().clone() for t in inputs]
    with pytest.raises(RuntimeError, match="add_norm_ has no gradient"):
        run(*inputs, EPS)
    assert all(torch.equal(a, b) for a, b in zip(inputs, kept, strict=True))
    with torch.no_grad():
        run(*inputs, EPS)


def test_autograd_notices_the_change():
    x, y, weight, bias = make_inputs((4, 8))
    other = torch.randn(4, 8, requires_grad=True)
    product = other * x  # keeps x for its gradient
    versions = x._version, y._version
    add_norm_(x, y, weight, bias, EPS)
    assert (x._version, y._version) == (versions[0] + 1, versions[1] + 1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        product.sum().backward()
    with torch.inference_mode():
        add_norm_(*make_inputs((4, 8)), EPS)  # tensors without a version


def test_memory_is_not_shared():
    x, y, weight, bias = make_inputs((4, 8))
    whole = torch.randn(7, 8)
    for arguments in (
        (x, x, weight, bias),
        (whole[:4], whole[3:], weight, bias),
        (x, y, x[0], bias),
        (x, y, weight, y[3]),
    ):
        with pytest.raises(RuntimeError, match="share no memory"):
            add_norm_(*arguments, EPS)
    add_norm_(whole[:3], whole[3:6], whole[6], bias, EPS)  # neighbours


def test_the_raw_operator_is_guarded_as_soon_as_it_is_registered():
    code = (
        "import torch, darswin.ops; y = torch.ones(2, 3); x = y.clone().requires_grad_() * 1;"
        "torch.ops.darswin._add_norm_(x, y, torch.ones(3), torch.ones(3), 1e-5)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode != 0 and "add_norm_ has no gradient" in done.stderr
