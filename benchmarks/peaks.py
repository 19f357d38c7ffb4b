"""What this machine can do at most: the rate of a matrix product and of a copy in memory.

The operators' GFLOP/s and GB/s are read against these.
"""

import itertools
import statistics
from collections.abc import Callable
from dataclasses import dataclass

import torch

from darswin.bench.machine import THREADS, num_threads
from darswin.bench.timing import in_turns


@dataclass
class Peaks:
    """Of `threads` threads together."""

    threads: int
    gflops: float  # of a product whose matrices lie in the second cache
    cached_gbytes: float  # a second, read and written, of a copy that lies in the caches
    memory_gbytes: float  # of one that does not

    def __str__(self) -> str:
        return (
            f"{self.threads} threads: {self.gflops:.0f} GFLOP/s of a float32 product, "
            f"{self.cached_gbytes:.0f} GB/s copied in the caches, "
            f"{self.memory_gbytes:.0f} GB/s in memory"
        )


def measure(threads: int) -> Peaks:
    """Measures them. The product is oneDNN's where torch has it, else that of torch's BLAS."""
    size = 384  # 0.6 MB a matrix
    a, b = torch.randn(size * threads, size), torch.randn(size, size)
    products: list[Callable[[], object]] = [lambda: torch.mm(a, b)]
    if torch.backends.mkldnn.is_available():
        products.append(lambda: torch.ops.mkldnn._linear_pointwise(a, b, None, "none", [], ""))
    with num_threads(threads):
        rate = max(2e-9 * a.shape[0] * size**2 / _seconds(product) for product in products)
        return Peaks(threads, rate, _copied(2**20), _copied(2**28))


def _copied(size: int) -> float:
    """GB/s of copying `size` bytes, read and written."""
    source, copy = torch.ones(size // 4), torch.ones(size // 4)
    return 2e-9 * size / _seconds(lambda: copy.copy_(source))


def _seconds(run: Callable[[], object]) -> float:
    run()
    return statistics.median(itertools.chain(*in_turns({"": run}, 0.3)[""]))


if __name__ == "__main__":
    for count in THREADS:
        print(measure(count))
