import numpy as np
import pytest
import torch
from helpers import refused
from torch.utils.data import Dataset

from darswin.data.order import ResumableLoader, TrainingOrder
from darswin.data.samples import Draw

CAMERAS = np.array([0] * 31 + [1] * 17 + [2] * 4 + [3])


def order_of(count, batch, rank=0, world=1, **options):
    return TrainingOrder(count, batch, rank=rank, world=world, **options)


def batches(order):
    draws = list(order)
    return [draws[k : k + order.batch] for k in range(0, len(draws), order.batch)]


@pytest.mark.parametrize("cameras", [None, CAMERAS])
@pytest.mark.parametrize("batch", [6, 5])
def test_an_epoch(batch, cameras):
    """Each image once, the next epoch in another order; partners share lens and camera."""
    order = order_of(53, batch, cameras=cameras)
    seen = []
    for epoch in range(3):
        order.set_epoch(epoch)
        draws = list(order)
        assert draws == list(order) and {draw.epoch for draw in draws} == {epoch}
        seen.append([draw.picture for draw in draws])
        assert len(set(seen[-1])) == len(seen[-1]) == len(order) == 53 // batch * batch
        pairs = set()
        for one in batches(order):
            assert [d.lens for d in one] == [d.lens for d in one[::-1]]
            assert len({d.lens for d in one}) == (batch + 1) // 2
            pairs |= {
                frozenset((d.picture, p.picture)) for d, p in zip(one, one[::-1], strict=True)
            }
        mixed = [pair for pair in pairs if len({CAMERAS[k] for k in pair}) > 1]
        assert len(mixed) <= 2 or cameras is None  # each camera has at most one image left over
    assert seen[0] != seen[1] != seen[2]
    assert seen[0] != [draw.picture for draw in order_of(53, batch, seed=1, cameras=cameras)]
    apart = list(order_of(53, batch, pairs=False, cameras=cameras))
    assert all(draw.lens == draw.picture for draw in apart)
    assert apart == list(order_of(53, batch, pairs=False))
    assert list(order_of(53, batch, cameras=np.zeros(53))) == list(order_of(53, batch))


@pytest.mark.parametrize("world", [2, 3])
def test_processes_together_see_the_batches_of_one(world):
    whole = batches(order_of(50, 4 * world))
    parts = [batches(order_of(50, 4, rank, world)) for rank in range(world)]
    for k, one in enumerate(whole):
        together = [d for part in parts for d in part[k]]
        assert sorted(together) == sorted(one)
        partner = {d.picture: p.picture for d, p in zip(one, one[::-1], strict=True)}
        for part in parts:
            for d, p in zip(part[k], part[k][::-1], strict=True):
                assert partner[d.picture] == p.picture  # as it would mix alone


class Echo(Dataset):
    def __getitem__(self, draw: Draw):
        return torch.tensor(draw)


@pytest.mark.parametrize("cameras", [None, np.arange(40) % 3])
def test_a_loader_goes_on_where_it_was(cameras):
    def loader():
        return ResumableLoader(Echo(), order_of(40, 4, cameras=cameras), num_workers=0)

    first = loader()
    first.sampler.set_epoch(3)
    every = [batch.tolist() for batch in first]
    state = dict(epoch=3, done=10, shuffle=[40, 4, 0])
    assert len(every) == len(first) == 10 and first.state_dict() == state
    taken = iter(first)
    for _ in range(4):
        next(taken)
    assert first.state_dict() == state | {"done": 4}
    second = loader()
    second.load_state_dict(first.state_dict())
    second.sampler.set_epoch(3)
    assert [batch.tolist() for batch in second] == every[4:] and second.state_dict() == state
    second.sampler.set_epoch(4)
    assert len(list(second)) == 10  # the next epoch is whole


def test_what_does_not_match():
    refused("must be even", order_of, 30, 5, world=2)
    refused("7 pictures cannot fill a batch of 4 on each of 2 processes", order_of, 7, 4, world=2)
    order = order_of(40, 8)
    said = r"global batch.*\(40, 4, 0\), got \(40, 8, 0\)"
    refused(said, order.resume, 0, 9, [40, 4, 0])
    order.resume(0, 10, [40, 4, 0])  # another shuffle between two epochs
    order_of(40, 4, 1, 2).resume(0, 3, [40, 8, 0])  # the same global batch
    assert len(list(order_of(40, 4, 1, 2))) == 20
