"""Timing candidates in turns, so that a change of the clock rate meets all of them alike."""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch

OURS, FIXED_LENS, REFERENCE = "darswin", "darswin, fixed lens", "reference"
COMPILED, MATMULS = "compiled reference", "matrix products alone"
TURNS = 7  # or more, for as long as a candidate's calls are short
LONGEST_TURN = 0.2  # seconds: long enough for the caches to hold what the candidate uses


class Case(NamedTuple):
    """What is timed, and how."""

    subject: str  # an operator or a model
    setting: str  # its sizes
    batch: int
    threads: int
    mode: str  # such as "forward" or "training, float32"


@dataclass
class Timing:
    """One candidate in one case. Times are seconds a call."""

    subject: str
    setting: str
    batch: int
    threads: int
    mode: str
    name: str
    median: float
    iqr: float
    ratio: float  # over our time in the same turn, the median of all turns
    target: float | None = None  # the least that the ratio should be
    runs: int | None = None  # None, as `p99`, where calls were not timed one by one
    p99: float | None = None  # below a hundred runs the longest

    @property
    def case(self) -> Case:
        return Case(self.subject, self.setting, self.batch, self.threads, self.mode)

    @property
    def missed(self) -> bool:
        """Whether there is a target that the ratio does not reach."""
        return self.target is not None and self.ratio < self.target

    def __str__(self) -> str:
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        where = f"{self.subject}, {self.setting}, batch {self.batch}, {self.mode}"
        return f"{where}, {threads}: {self.name}"


def measure(
    case: Case,
    candidates: Mapping[str, Callable[[], object]],
    seconds: float,
    *,
    least: int = TURNS,
    targets: Mapping[str, float] | None = None,
) -> list[Timing]:
    """Times candidates, `OURS` among them, as `in_turns` does.

    Args:
        targets: by candidate, how many times as long as ours it should at least take.
    """
    turns = in_turns(candidates, seconds, least)
    targets = targets or {}
    return [
        summary(case, name, found, turns[OURS], targets.get(name)) for name, found in turns.items()
    ]


def in_turns(
    candidates: Mapping[str, Callable[[], object]], seconds: float, least: int = TURNS
) -> dict[str, list[list[float]]]:
    """Calls each candidate, which has run before, for about `seconds`, at least `least` times.

    Returns:
        the seconds of each call of each candidate, turn by turn; all have as many turns.
    """
    calls, turns = {}, 1
    for name, run in candidates.items():
        once = _time(run)
        calls[name] = max(1, round(min(LONGEST_TURN, seconds / TURNS) / once))
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
    case: Case,
    name: str,
    turns: list[list[float]],
    ours: list[list[float]],
    target: float | None = None,
) -> Timing:
    """The timing of a candidate from what `in_turns` found of it and of `OURS`."""
    values = torch.tensor(list(itertools.chain(*turns)), dtype=torch.float64)
    low, median, high = values.quantile(values.new_tensor((0.25, 0.5, 0.75))).tolist()
    p99 = values.quantile(0.99, interpolation="higher").item()
    pairs = zip(turns, ours, strict=True)
    ratio = statistics.median(statistics.median(a) / statistics.median(b) for a, b in pairs)
    return Timing(*case, name, median, high - low, ratio, target, len(values), p99)
