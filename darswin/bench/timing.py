"""Timing candidates in turns, so that changes of the clock rate affect all of them equally."""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch

OURS, FIXED_LENS, REFERENCE = "darswin", "darswin, fixed lens", "reference"
COMPILED, MATMULS = "compiled reference", "matrix products alone"
# A model with 8 bits is compared with the same model in other types.
OURS_FLOAT32, OURS_BFLOAT16 = f"{OURS}, float32", f"{OURS}, bfloat16"
COMPILED_BFLOAT16 = f"{COMPILED}, bfloat16"
TURNS = 7  # at least; more if the calls of a candidate are short
LONGEST_TURN = 0.2  # seconds: long enough to fill the caches with the data of the candidate

Turns = dict[str, list[list[float]]]  # by candidate and turn, the seconds of each call


@dataclass
class Case:
    """The subject of a timing and its settings."""

    subject: str  # an operator or a model
    setting: str  # its sizes
    batch: int
    threads: int
    mode: str  # such as "forward" or "training, float32"

    @property
    def label(self) -> str:
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        return f"{self.subject}, {self.setting}, batch {self.batch}, {self.mode}, {threads}"


@dataclass
class Timing(Case):
    """One candidate in one case. Times are seconds per call."""

    name: str
    median: float
    iqr: float
    ratio: float  # median over all turns of the time over ours
    target: float | None = None  # the smallest acceptable ratio
    runs: int | None = None  # None, like `p99`, if calls were not timed one by one
    p99: float | None = None  # the longest time if there are less than a hundred runs

    @property
    def missed(self) -> bool:
        return self.target is not None and self.ratio < self.target


def measure(
    case: Case,
    candidates: Mapping[str, Callable[[], object]],
    seconds: float,
    *,
    least: int = TURNS,
    targets: Mapping[str, float] | None = None,
) -> list[Timing]:
    """Times candidates, including `OURS`; `targets` are the smallest acceptable ratios, by name."""
    turns = in_turns(candidates, seconds, least)
    return [summary(case, name, turns, (targets or {}).get(name)) for name in candidates]


def in_turns(
    candidates: Mapping[str, Callable[[], object]], seconds: float, least: int = TURNS
) -> Turns:
    """Calls each candidate for about `seconds`, at least `least` times, in as many turns."""
    calls, turns = {}, 1
    for name, run in candidates.items():
        once = _time(run)
        calls[name] = max(1, round(min(LONGEST_TURN, seconds / TURNS) / once))
        turns = max(turns, round(seconds / (calls[name] * once)), math.ceil(least / calls[name]))
    found: Turns = {name: [] for name in candidates}
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


def summary(case: Case, name: str, turns: Turns, target: float | None = None) -> Timing:
    values = torch.tensor(list(itertools.chain(*turns[name])), dtype=torch.float64)
    low, median, high = values.quantile(values.new_tensor((0.25, 0.5, 0.75))).tolist()
    p99 = values.quantile(0.99, interpolation="higher").item()
    pairs = zip(turns[name], turns[OURS], strict=True)
    ratio = statistics.median(statistics.median(a) / statistics.median(b) for a, b in pairs)
    return Timing(
        **vars(case), name=name, median=median, iqr=high - low, ratio=ratio, target=target,
        runs=len(values), p99=p99,
    )  # fmt: skip
