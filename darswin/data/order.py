"""The order of training images, for any number of processes; a checkpoint can restore it."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from torch.utils.data import DataLoader, Dataset, Sampler

from darswin.data.samples import Draw
from darswin.utils.parameters import naming
from darswin.utils.words import counted


class TrainingOrder(Sampler[Draw]):
    """A new shuffle for each epoch, divided among the processes.

    The shuffle is cut into global batches of `batch × world` images, and the rest is dropped. In a
    global batch, the images i and -1-i are partners for mixing. A process gets whole pairs: the
    first image in the first half of its batch, the second image in the mirrored place. So its
    batch mixes with its own reverse, and any number of processes trains on the same mixtures.

    With `pairs`, partners share their lens, so that a mixture is an image through one lens. With
    `cameras`, the camera of each image, (count,), partners also share their camera, except for
    images that are left over. `batch` is the batch of one process; it must be even if `world` > 1.
    """

    def __init__(
        self, count: int, batch: int, *, rank: int, world: int, pairs: bool = True, seed: int = 0,
        cameras: np.ndarray | None = None,
    ):  # fmt: skip
        if world > 1 and batch % 2:
            raise ValueError(f"with several processes the batch of each must be even, got {batch}")
        if count < batch * world:
            text = f"{counted(count, 'picture')} cannot fill a batch of {batch}"
            text += f" on each of {world} processes" * (world > 1)
            raise naming(ValueError(f"{text}: choose a smaller `batch_size`"), "batch_size")
        self.count, self.batch, self.rank, self.world = count, batch, rank, world
        self.pairs, self.seed = pairs, seed
        several = cameras is not None and len(np.unique(cameras)) > 1
        self.cameras = cameras if pairs and several else None
        self.epoch = 0
        self._resume = (-1, 0)  # an epoch, and the number of its batches that are done

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def resume(self, epoch: int, done: int, shuffle: list[int]) -> None:
        """Skips the first `done` batches of an epoch; ValueError if they belong to another shuffle
        and the epoch is not complete."""
        count, size, _ = shuffle
        if shuffle != self.shuffle() and done < count // size:
            raise ValueError(
                "in the middle of an epoch, a resumed run must keep (pictures, global batch, "
                f"seed) = {tuple(shuffle)}, got {tuple(self.shuffle())}"
            )
        self._resume = (epoch, done)

    def shuffle(self) -> list[int]:
        return [self.count, self.batch * self.world, self.seed]

    def done(self) -> int:
        return self._resume[1] if self._resume[0] == self.epoch else 0

    def batches(self) -> int:
        return self.count // (self.batch * self.world)

    def __len__(self) -> int:
        return self.batches() * self.batch

    def __iter__(self) -> Iterator[Draw]:
        rng = np.random.default_rng((self.seed, self.epoch))
        order = rng.permutation(self.count)
        size = self.batch * self.world
        half = self.batch // 2
        front = np.arange(self.rank * half, self.rank * half + half)
        middle = np.arange(half, self.batch - half)  # of an odd batch
        place = np.concatenate((front, middle, size - 1 - front[::-1]))
        batches = order[: self.batches() * size].reshape(-1, size)
        if self.cameras is not None:
            batches = _paired(order, self.cameras, self.batches(), size, rng)
        for batch in batches[self.done() :]:
            for k in place:
                partner = min(k, size - 1 - k)
                yield Draw(self.epoch, int(batch[k]), int(batch[partner if self.pairs else k]))


def _paired(
    order: np.ndarray, cameras: np.ndarray, batches: int, size: int, rng: np.random.Generator
) -> np.ndarray:
    """A shuffle (batches, size) in which the images i and -1-i of a batch have the same camera.

    If a camera took an odd number of images, its last image has a partner from another camera.
    """
    alone = order[: batches * (size % 2)].reshape(batches, -1)  # in the middle of an odd batch
    order = order[alone.size :]
    order = order[np.argsort(cameras[order], kind="stable")]
    _, first, count = np.unique(cameras[order], return_index=True, return_counts=True)
    left_over = (first + count - 1)[count % 2 == 1]
    order = np.concatenate((np.delete(order, left_over), order[left_over]))
    pairs = order[: len(order) // 2 * 2].reshape(-1, 2)
    chosen = rng.permutation(pairs)[: batches * (size // 2)].reshape(batches, -1, 2)
    return np.concatenate((chosen[..., 0], alone, chosen[:, ::-1, 1]), 1)


class ResumableLoader(DataLoader):
    """A DataLoader over a `TrainingOrder` that can resume in the middle of an epoch."""

    def __init__(self, dataset: Dataset, order: TrainingOrder, **options: Any):
        super().__init__(dataset, order.batch, sampler=order, drop_last=True, **options)
        self._order, self._done = order, 0

    # torch declares the type of its private iterators.
    def __iter__(self) -> Iterator:  # type: ignore[override]
        self._done = self._order.done()
        for batch in super().__iter__():
            self._done += 1
            yield batch

    def state_dict(self) -> dict[str, Any]:
        order = self._order
        return {"epoch": order.epoch, "done": self._done, "shuffle": order.shuffle()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._order.resume(**state)
