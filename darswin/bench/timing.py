"""Timing of what is to be compared: in turns, so that a clock that wanders wanders for all."""

import itertools
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

OURS, ONE_LENS, REFERENCE = "darswin", "darswin, one lens", "reference"
COMPILED, PRODUCTS = "compiled reference", "products alone"


@dataclass
class Timing:
    """Of one candidate in one case. Times are seconds a batch."""

    mode: str  # "inference" or "training"
    dtype: str
    batch: int
    threads: int
    name: str
    runs: int
    median: float
    iqr: float
    p99: float  # the largest, below a hundred runs
    ratio: float  # over our time in the same turn, the median of all turns

    @property
    def case(self) -> tuple[str, str, int, int]:
        return (self.mode, self.dtype, self.batch, self.threads)


def in_turns(
    candidates: dict[str, Callable[[], object]], seconds: float, least: int
) -> dict[str, list[list[float]]]:
    """Calls each candidate, which has run before, for about `seconds`, at least `least` times.

    Returns:
        the seconds of each call of each candidate, turn by turn; all have as many turns.
    """
    calls, turns = {}, 1
    for name, run in candidates.items():
        once = _time(run)
        calls[name] = max(1, round(0.2 / once))  # a turn: long enough for caches to be its own
        turns = max(turns, round(seconds / (calls[name] * once)), math.ceil(least / calls[name]))
    found: dict[str, list[list[float]]] = {name: [] for name in candidates}
    for _ in range(turns):
        for name, run in candidates.items():
            if calls[name] > 1:
                run()
            found[name].append([_time(run) for _ in range(calls[name])])
    return found


def _time(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def summary(
    case: tuple[str, str, int, int], name: str, turns: list[list[float]], ours: list[list[float]]
) -> Timing:
    """The timing of a candidate from what `in_turns` found of it and of `OURS`."""
    values = torch.tensor(list(itertools.chain(*turns)), dtype=torch.float64)
    low, median, high = values.quantile(values.new_tensor((0.25, 0.5, 0.75))).tolist()
    p99 = values.quantile(0.99, interpolation="higher").item()
    pairs = zip(turns, ours, strict=True)
    ratio = statistics.median(statistics.median(a) / statistics.median(b) for a, b in pairs)
    return Timing(*case, name, len(values), median, high - low, p99, ratio)
