import pytest
import torch

from darswin.layers.transformer import PatchMerging
from darswin.models.unet import PatchExpand, SkipJoin


@pytest.mark.parametrize("split", [(1, 4), (2, 2), (4, 1), (4, 4)])
def test_tokens_stand_where_merging_took_them_from(split):
    """Behind a merging of the same tokens that keeps them all, an expansion puts each back."""
    dim = 3
    joined = dim * split[0] * split[1]
    merging, expand = PatchMerging(dim, split), PatchExpand(joined, dim, split)
    merging.norm = expand.norm = torch.nn.Identity()
    merging.reduction = expand.expansion = torch.nn.Identity()
    x = torch.randn(2, 8, 16, dim)
    assert torch.equal(expand(merging(x)), x)


@pytest.mark.parametrize("split", [(1, 4), (2, 2), (4, 4)])
def test_a_turned_map_gives_a_turned_map(split):
    expand, x = PatchExpand(6, 4, split), torch.randn(2, 3, 8, 6)
    out = expand(x)
    assert out.shape == (2, 3 * split[0], 8 * split[1], 4)
    for turn in (1, 3):
        torch.testing.assert_close(expand(x.roll(turn, 2)), out.roll(turn * split[1], 2))


def test_each_token_alone_makes_its_part_and_is_normed():
    expand, x = PatchExpand(6, 4, (2, 4)), torch.randn(1, 2, 3, 6)
    out = expand(x)
    torch.testing.assert_close(out.mean(-1), torch.zeros(1, 4, 12), atol=1e-6, rtol=0)
    changed = x.clone()
    changed[0, 1, 2] += torch.randn(6)
    differs = (expand(changed) != out).any(-1)
    assert differs[0, 2:, 8:].all() and differs.sum() == 8


def test_joining():
    join = SkipJoin(4, (1, 4))
    x, skip = torch.randn(2, 3, 2, 8, requires_grad=True), torch.randn(2, 3, 8, 4)
    out = join(x, skip.requires_grad_())
    expected = join.expand(x) @ join.fuse.weight[:, :4].T + skip @ join.fuse.weight[:, 4:].T
    torch.testing.assert_close(out, expected + join.fuse.bias)
    out.square().sum().backward()
    assert x.grad.abs().sum() > 0 and skip.grad.abs().sum() > 0
