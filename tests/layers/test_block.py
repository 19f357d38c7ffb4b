import pytest
import torch

from darswin.layers.transformer import DropPath, PatchMerging


def test_merging_joins_neighbours_radius_first():
    merging = PatchMerging(1, (2, 2))
    merging.norm = torch.nn.Identity()
    merging.reduction = torch.nn.Identity()
    x = torch.arange(8.0).reshape(1, 2, 4, 1)
    assert merging(x)[0, 0].tolist() == [[0, 4, 1, 5], [2, 6, 3, 7]]
    with pytest.raises(ValueError, match="must divide"):
        merging(torch.zeros(1, 3, 4, 1))


def test_drop_path_drops_whole_images_and_keeps_the_mean():
    drop = DropPath(0.25)
    out = drop(torch.ones(4000, 2, 3))
    kept = out[:, 0, 0] > 0
    assert (out[kept] == 1 / 0.75).all() and (out[~kept] == 0).all()
    assert abs(kept.float().mean() - 0.75) < 0.03
    assert torch.equal(drop.eval()(out), out)
    with pytest.raises(ValueError, match=r"drop path must be in \[0, 1\)"):
        DropPath(1.0)
