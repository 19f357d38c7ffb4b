import numpy as np
import pytest
import torch
from torch.utils.data import Dataset

from darswin.data.order import EveryNth, ResumableLoader, TrainingOrder
from darswin.data.samples import Draw


def batches(order):
    draws = list(order)
    return [draws[k : k + order.batch] for k in range(0, len(draws), order.batch)]


def test_an_epoch_has_each_image_once_and_the_next_is_another_shuffle():
    order = TrainingOrder(25, 6, rank=0, world=1)
    first = [d.picture for d in order]
    assert len(first) == len(order) == 24 and len(set(first)) == 24
    assert first == [d.picture for d in order]
    order.set_epoch(1)
    assert first != [d.picture for d in order] and {d.epoch for d in order} == {1}


@pytest.mark.parametrize("batch", [6, 5])
def test_partners_share_a_lens(batch):
    for one in batches(TrainingOrder(30, batch, rank=0, world=1)):
        assert [d.lens for d in one] == [d.lens for d in one[::-1]]
        assert len({d.lens for d in one}) == (batch + 1) // 2
    apart = TrainingOrder(30, batch, rank=0, world=1, pairs=False)
    assert all(d.lens == d.picture for d in apart)


@pytest.mark.parametrize("world", [2, 3])
def test_processes_together_see_the_batches_of_one(world):
    whole = batches(TrainingOrder(50, 4 * world, rank=0, world=1))
    parts = [batches(TrainingOrder(50, 4, rank=r, world=world)) for r in range(world)]
    for k, one in enumerate(whole):
        together = [d for part in parts for d in part[k]]
        assert sorted(together) == sorted(one)
        partner = {d.picture: p.picture for d, p in zip(one, one[::-1], strict=True)}
        for part in parts:
            for d, p in zip(part[k], part[k][::-1], strict=True):
                assert partner[d.picture] == p.picture  # as it would mix alone


def test_what_does_not_fit():
    with pytest.raises(ValueError, match="must be even"):
        TrainingOrder(30, 5, rank=0, world=2)
    with pytest.raises(ValueError, match="needs more images than 7"):
        TrainingOrder(7, 4, rank=0, world=2)


class Echo(Dataset):
    def __getitem__(self, draw: Draw):
        return torch.tensor(draw)


def test_a_loader_goes_on_where_it_was():
    def loader():
        return ResumableLoader(Echo(), TrainingOrder(40, 4, rank=0, world=1), num_workers=0)

    first = loader()
    first.sampler.set_epoch(3)
    every = list(first)
    assert len(every) == len(first) == 10 and first.state_dict() == dict(
        epoch=3, done=10, shuffle=[40, 4, 0]
    )
    taken = iter(first)
    for _ in range(4):
        next(taken)
    second = loader()
    second.load_state_dict(first.state_dict())
    second.sampler.set_epoch(3)
    rest = list(second)
    assert [b.tolist() for b in rest] == [b.tolist() for b in every[4:]]
    assert second.state_dict() == first.state_dict() | {"done": 10}
    second.sampler.set_epoch(4)
    assert len(list(second)) == 10  # the next epoch is whole


def test_another_shuffle_only_between_epochs():
    order = TrainingOrder(40, 8, rank=0, world=1)
    with pytest.raises(ValueError, match=r"\(40, 4, 0\); got \(40, 8, 0\)"):
        order.resume(0, 9, [40, 4, 0])
    order.resume(0, 10, [40, 4, 0])
    assert len(list(TrainingOrder(40, 4, rank=1, world=2))) == 20
    TrainingOrder(40, 4, rank=1, world=2).resume(0, 3, [40, 8, 0])  # the same global batch


def test_parts_of_a_test_set():
    parts = [list(EveryNth(10, r, 3)) for r in range(3)]
    assert sorted(k for part in parts for k in part) == list(range(10)) and [
        len(p) for p in parts
    ] == [4, 3, 3]


@pytest.mark.parametrize("batch", [6, 5])
def test_partners_are_of_one_camera_where_that_can_be(batch):
    cameras = np.array([0] * 31 + [1] * 17 + [2] * 4 + [3])
    order = TrainingOrder(53, batch, rank=0, world=1, cameras=cameras)
    for epoch in range(3):
        order.set_epoch(epoch)
        pictures = [d.picture for d in order]
        assert len(pictures) == len(set(pictures)) == len(order) == 53 // batch * batch
        pairs = {
            frozenset((d.picture, p.picture))
            for one in batches(order)
            for d, p in zip(one, one[::-1], strict=True)
        }
        mixed = [pair for pair in pairs if len({cameras[k] for k in pair}) > 1]
        assert len(mixed) <= 2  # of four cameras, each has at most one image left over
        for one in batches(order):
            assert [d.lens for d in one] == [d.lens for d in one[::-1]]
    whole = list(TrainingOrder(50, 10, rank=0, world=1, cameras=cameras[:50]))
    assert whole != list(TrainingOrder(50, 10, rank=0, world=1, seed=1, cameras=cameras[:50]))
    for plain in (np.zeros(50), None):
        same = TrainingOrder(50, 10, rank=0, world=1, cameras=plain)
        assert list(same) == list(TrainingOrder(50, 10, rank=0, world=1))
    apart = TrainingOrder(50, 10, rank=0, world=1, cameras=cameras[:50], pairs=False)
    assert list(apart) == list(TrainingOrder(50, 10, rank=0, world=1, pairs=False))


def test_cameras_go_on_where_they_were():
    cameras = np.arange(40) % 3
    order = TrainingOrder(40, 4, rank=0, world=1, cameras=cameras)
    whole = list(order)
    order.resume(0, 6, order.shuffle())
    assert list(order) == whole[24:]
