"""The peak rates of this machine: of a matrix product and of a copy in memory.

The GFLOP/s and GB/s of the operators are compared with these.
"""

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch
from kit.machine import THREADS, num_threads
from kit.timing import in_turns


@dataclass
class Peaks:
    """The rates of `threads` threads together."""

    threads: int
    gflops: float  # of a product whose matrices fit the second-level cache
    cached_gbytes: float  # per second, read and written, of a copy in the caches
    memory_gbytes: float  # of a copy in memory

    def __str__(self) -> str:
        return (
            f"{self.threads} threads: {self.gflops:.0f} GFLOP/s of a float32 product, "
            f"{self.cached_gbytes:.0f} GB/s copied in the caches, "
            f"{self.memory_gbytes:.0f} GB/s in memory"
        )


def measure(threads: int) -> Peaks:
    """Measures the rates, with the faster of oneDNN's product and torch's own."""
    size = 384  # 0.6 MB per matrix
    a, b = torch.randn(size * threads, size), torch.randn(size, size)
    products: list[Callable[[], object]] = [lambda: torch.mm(a, b)]
    if torch.backends.mkldnn.is_available():
        products.append(lambda: torch.ops.mkldnn._linear_pointwise(a, b, None, "none", [], ""))
    with num_threads(threads):
        rate = max(2e-9 * a.shape[0] * size**2 / _seconds(product) for product in products)
        return Peaks(threads, rate, _copied(2**20), _copied(2**28))


def _copied(size: int) -> float:
    """The GB/s of copying `size` bytes, read and written."""
    source, copy = torch.ones(size // 4), torch.ones(size // 4)
    return 2e-9 * size / _seconds(lambda: copy.copy_(source))


def _seconds(run: Callable[[], object]) -> float:
    run()
    turns = in_turns({"": run}, 0.3)[""]
    return statistics.median(seconds for turn in turns for seconds in turn.seconds)


if __name__ == "__main__":
    for count in THREADS:
        print(measure(count))
