"""Timing candidates in turns, so that changes of the clock rate affect all of them equally.

They are called in a loop, or at the pace of a camera: a call when a frame arrives, and then a wait.
"""

import math
import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import torch

OURS, FIXED_LENS, REFERENCE = "darswin", "darswin, fixed lens", "reference"
COMPILED, MATMULS = "compiled reference", "matrix products alone"
BY_TORCH, FORWARD = "torch's products", "optimized forward"  # of a training step
# A model with 8 bits is compared with others.
OURS_FLOAT32 = f"{OURS}, float32"
COMPILED_BFLOAT16 = f"{COMPILED}, bfloat16"
TURNS = 7  # at least; more if the calls of a candidate are short
LONGEST_TURN = 0.2  # seconds: long enough to fill the caches with the data of the candidate
PACE = 1 / 30  # seconds between the frames of a camera
PACED = "paced"  # the begin of the modes of frames at this pace
DEFAULT = 0  # the number of threads of a candidate that chooses it by itself
PACED_THREADS = (1, 2, DEFAULT)

Key = TypeVar("Key", bound=Hashable)


class Turn(NamedTuple):
    """A few calls of a candidate, one after the other."""

    seconds: list[float]  # of each call
    cpu: float  # seconds of all threads of the process for a call, and for the wait after it


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
        threads = threads_label(self.threads)
        return f"{self.subject}, {self.setting}, batch {self.batch}, {self.mode}, {threads}"

    @property
    def paced(self) -> bool:
        return self.mode.startswith(PACED)


def threads_label(threads: int) -> str:
    named = {1: "1 thread", DEFAULT: "default threads"}
    return named.get(threads, f"{threads} threads")


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
    cpu: float | None = None  # median over all turns of `Turn.cpu`; None in old records

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


def measure_paced(
    case: Case,
    candidates: Mapping[str, Callable[[int], Callable[[], object]]],
    seconds: float,
    *,
    targets: Mapping[str, float] | None = None,
) -> list[Timing]:
    """Times candidates at the pace of a camera, with all of `PACED_THREADS` in the same turns.

    Each candidate is a function that gets the number of threads, or `DEFAULT`, and returns what is
    called for a frame. The ratios are those to `OURS` on as many threads. `targets` are for one
    thread, and `case.threads` plays no role.
    """
    runs = {(name, n): run(n) for n in PACED_THREADS for name, run in candidates.items()}
    turns, found = in_turns(runs, seconds, pace=PACE), []
    for n in PACED_THREADS:
        here = replace(case, threads=n, mode=f"{PACED}, {case.mode}")
        those = {name: turns[name, n] for name in candidates}
        wanted = (targets or {}) if n == 1 else {}
        found += [summary(here, name, those, wanted.get(name)) for name in candidates]
    return found


def in_turns(
    candidates: Mapping[Key, Callable[[], object]],
    seconds: float,
    least: int = TURNS,
    pace: float = 0.0,
) -> dict[Key, list[Turn]]:
    """Calls each candidate for about `seconds`, at least `least` times, in as many turns.

    With a `pace`, calls begin at multiples of so many seconds, and who takes longer misses frames.
    A turn begins when the threads of the one before have stopped to look for work. Its first call,
    which fills caches, does not count.
    """
    calls, turns = {}, 1
    for name, run in candidates.items():
        once = _time(run)
        once = max(1, math.ceil(once / pace)) * pace if pace else once
        longest = seconds / TURNS if pace else min(LONGEST_TURN, seconds / TURNS)
        calls[name] = max(1, round(longest / once))
        turns = max(turns, round(seconds / (calls[name] * once)), math.ceil(least / calls[name]))
    found: dict[Key, list[Turn]] = {name: [] for name in candidates}
    for _ in range(turns):
        for name, run in candidates.items():
            if pace:
                _rest(pace)
            if pace or calls[name] > 1:
                _turn(run, 1, pace)
            found[name].append(_turn(run, calls[name], pace))
    return found


def fastest(candidates: Mapping[Key, Callable[[], object]], turns: int) -> Key:
    """The candidate with the shortest call in some turns, of which the first does not count: oneDNN
    prepares itself for the shape."""
    seconds = dict.fromkeys(candidates, math.inf)
    for turn in range(turns):
        for name, run in candidates.items():
            once = _time(run)
            if turn:
                seconds[name] = min(seconds[name], once)
    return min(seconds, key=seconds.__getitem__)


def _rest(seconds: float) -> None:
    """Waits until the process does nothing for so long, or for thirty times as long."""
    for _ in range(30):
        cpu = time.process_time()
        time.sleep(seconds)
        if time.process_time() - cpu < 0.05 * seconds:
            return


def _turn(run: Callable[[], object], calls: int, pace: float) -> Turn:
    seconds: list[float] = []
    start, cpu = time.perf_counter(), time.process_time()
    for _ in range(calls):
        seconds.append(_time(run))
        if pace:
            time.sleep(pace - (time.perf_counter() - start) % pace)
    return Turn(seconds, (time.process_time() - cpu) / calls)


def _time(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def summary(
    case: Case, name: str, turns: Mapping[str, list[Turn]], target: float | None = None
) -> Timing:
    calls = [seconds for turn in turns[name] for seconds in turn.seconds]
    values = torch.tensor(calls, dtype=torch.float64)
    low, median, high = values.quantile(values.new_tensor((0.25, 0.5, 0.75))).tolist()
    p99 = values.quantile(0.99, interpolation="higher").item()
    ours, theirs = ([statistics.median(turn.seconds) for turn in turns[n]] for n in (OURS, name))
    ratio = statistics.median(b / a for a, b in zip(ours, theirs, strict=True))
    return Timing(
        **vars(case), name=name, median=median, iqr=high - low, ratio=ratio, target=target,
        runs=len(values), p99=p99, cpu=statistics.median(turn.cpu for turn in turns[name]),
    )  # fmt: skip
