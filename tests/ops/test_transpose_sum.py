import math

import pytest
import torch

from darswin.ops._inference import transpose_sum

# Less than a register, registers and rests of both sides, groups of rows and a rest, and what the
# models have.
SHAPES = [(1, 1), (3, 7), (16, 16), (37, 5), (5, 37), (67, 100), (200, 48), (1024, 96), (128, 768)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_transpose_and_sums(shape):
    x = torch.randn(shape) + 1
    transposed, sums = transpose_sum(x)
    assert torch.equal(transposed, x.t()) and transposed.is_contiguous()
    exact = x.double().sum(0)
    rounding = 4 * torch.finfo(torch.float32).eps * x.abs().sum(0).max()
    assert (sums - exact).abs().max() <= max(2 * (x.sum(0) - exact).abs().max(), rounding)


def test_values_that_are_not_finite_stay_in_their_columns():
    x = torch.ones(70, 40)
    x[3, 2], x[69, 39], x[68, 20] = math.nan, math.nan, math.inf
    transposed, sums = transpose_sum(x)
    torch.testing.assert_close(transposed, x.t(), rtol=0, atol=0, equal_nan=True)
    assert sums.isnan().nonzero().flatten().tolist() == [2, 39]
    assert sums[20] == math.inf and (sums == 70).sum() == 37


def test_same_bits_for_any_number_of_threads(threads):
    x = torch.randn(1000, 100)
    results = []
    for count in (1, 2, 5):
        threads(count)
        results.append(transpose_sum(x))
    for transposed, sums in results[1:]:
        assert torch.equal(transposed, results[0][0]) and torch.equal(sums, results[0][1])


@pytest.mark.parametrize("shape", [(0, 8), (8, 0), (0, 0)], ids=str)
def test_nothing(shape):
    transposed, sums = transpose_sum(torch.zeros(shape))
    assert transposed.shape == shape[::-1] and torch.equal(sums, torch.zeros(shape[1]))


def test_opcheck():
    torch.library.opcheck(torch.ops.darswin._transpose_sum.default, (torch.randn(20, 24),))


@pytest.mark.parametrize(
    "x", [torch.zeros(4, 6).t(), torch.zeros(4, 6).double(), torch.zeros(2, 4, 6), torch.zeros(4)]
)
def test_wrong_arguments(x):
    with pytest.raises(RuntimeError, match="transpose_sum"):
        transpose_sum(x)


@pytest.mark.parametrize("rows", [131_072, 1_000_000])
def test_sums_of_very_many_rows_are_as_accurate_as_torch(rows):
    x = torch.randn(rows, 5) + 1
    exact = x.double().sum(0)
    rounding = torch.finfo(torch.float32).eps * exact.abs().max()
    own = (x.sum(0) - exact).abs().max()
    assert (transpose_sum(x)[1] - exact).abs().max() <= max(2 * own, rounding)


def test_its_gradient_is_that_of_torch():
    x = torch.randn(20, 7)
    grads = torch.randn(7, 20), torch.randn(7)
    results = []
    for run in (transpose_sum, lambda x: (x.t(), x.sum(0))):
        leaf = x.clone().requires_grad_()
        results.append(torch.autograd.grad(run(leaf), leaf, grads)[0])
    torch.testing.assert_close(*results)
