"""What every benchmark shares: timing, checking against peers, and a record of the machine.

The contract: `torch.utils.benchmark`, median and interquartile range; ours and every peer in the
same process and run, in turns; outputs checked equal before anything is timed; every result is
published, losses too. A peer may carry a bar: how many times as long as ours it must at least take.
"""

import json
import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch.utils.benchmark import Measurement, Timer

from darswin import _C
from darswin.bench.machine import machine

RESULTS = Path(__file__).parent / "results"
OURS = "darswin"
ROUNDS = 7  # candidates take turns, so that a clock that wanders wanders for all


@dataclass
class Result:
    """One timing. Times are seconds."""

    operator: str
    case: str
    mode: str  # "forward" or "forward+backward"
    threads: int
    name: str
    median: float
    iqr: float
    ratio: float  # the candidate's time over ours, as the median of the rounds has it
    bar: float | None = None  # the least that the ratio should be


def forward(run: Callable[..., torch.Tensor], inputs: list[torch.Tensor]):
    """A function that runs without recording gradients; returns the output."""

    def step() -> list[torch.Tensor]:
        with torch.no_grad():
            return [run(*inputs)]

    return step


def forward_backward(
    run: Callable[..., torch.Tensor],
    inputs: list[torch.Tensor],
    view: Callable[[torch.Tensor], torch.Tensor] = lambda result: result,
):
    """A function that runs, and backpropagates a fixed gradient; returns output and gradients.

    The gradient is the same for all candidates whose outputs are equal in `view`.
    """
    leaves = [t.detach().requires_grad_() for t in inputs]
    out = run(*leaves)
    viewed = view(out)
    grad = torch.randn(viewed.shape, generator=torch.Generator().manual_seed(0)).to(out.dtype)
    if viewed.shape != out.shape:  # back through the view
        (grad,) = torch.autograd.grad(viewed, out, grad)

    def step() -> list[torch.Tensor]:
        out = run(*leaves)
        return [out.detach(), *torch.autograd.grad(out, leaves, grad)]

    return step


def on_tier(tier: str, run: Callable[[], list[torch.Tensor]]):
    """`run`, with our operators on another instruction-set tier; torch keeps its own."""

    def step() -> list[torch.Tensor]:
        best = _C.tier()
        _C.set_tier(tier)
        try:
            return run()
        finally:
            _C.set_tier(best)

    return step


def compare(
    operator: str,
    case: str,
    candidates: dict[str, Callable[[], list[torch.Tensor]]],
    *,
    mode: str,
    threads: int,
    bars: dict[str, float] | None = None,
    view: Callable[[torch.Tensor], torch.Tensor] = lambda result: result,
    tolerance: float = 1e-4,
    min_run_time: float = 0.3,
) -> list[Result]:
    """Checks that all candidates agree with ours, then times them; `OURS` must be among them.

    What is compared is `view` of each result; a tolerance of infinity compares nothing.
    Ours is timed on every instruction-set tier of the machine: "darswin (avx2)" and so on.
    """
    bars = bars or {}
    ours = candidates[OURS]
    candidates = dict(candidates)
    for tier in _C.tiers():
        if tier != _C.tier():
            candidates[f"{OURS} ({tier})"] = on_tier(tier, ours)
    expected = [view(result) for result in candidates[OURS]()]
    for name, run in candidates.items():
        for got, want in zip(map(view, run()), expected, strict=True):
            if tolerance == math.inf:
                break
            torch.testing.assert_close(
                got, want, rtol=tolerance, atol=tolerance * want.abs().max().item(),
                msg=lambda text, name=name: f"{case}: {name} disagrees with ours: {text}",
            )  # fmt: skip
    timers = {
        name: Timer("run()", globals={"run": run}, num_threads=threads)
        for name, run in candidates.items()
    }
    part = min_run_time / ROUNDS
    rounds = [
        {name: timer.blocked_autorange(min_run_time=part) for name, timer in timers.items()}
        for _ in range(ROUNDS)
    ]
    results = []
    for name in candidates:
        whole = Measurement.merge([times[name] for times in rounds])[0]
        ratio = statistics.median(times[name].median / times[OURS].median for times in rounds)
        results.append(
            Result(
                operator, case, mode, threads, name, whole.median, whole.iqr, ratio, bars.get(name)
            )
        )
    return results


def table(results: list[Result]) -> str:
    """The results as a Markdown table, a row a case, a column a peer with its time over ours."""
    lines = []
    for operator in dict.fromkeys(r.operator for r in results):
        rows = [r for r in results if r.operator == operator]
        names = [n for n in dict.fromkeys(r.name for r in rows) if n != OURS]
        lines.append(f"| {operator} | threads | {OURS} (ms) | " + " | ".join(names) + " |")
        lines.append("|---|---|---|" + "---|" * len(names))
        for key in dict.fromkeys((r.case, r.mode, r.threads) for r in rows):
            found = {r.name: r for r in rows if (r.case, r.mode, r.threads) == key}
            ours = found[OURS]
            cells = [f"{found[n].ratio:.2f}×" if n in found else "" for n in names]
            lines.append(
                f"| {key[0]}, {key[1]} | {key[2]} | {1e3 * ours.median:.2f} ± "
                f"{1e3 * ours.iqr:.2f} | " + " | ".join(cells) + " |"
            )
        lines.append("")
    return "\n".join(lines)


def bar_report(results: list[Result], avx2_share: float) -> str:
    """Every ratio that has a bar, against it; on AVX2 the bar is `avx2_share` of it."""
    lines = []
    for r in results:
        if r.bar is None:
            continue
        same = [o for o in results if (o.operator, o.case, o.mode, o.threads)
                == (r.operator, r.case, r.mode, r.threads)]  # fmt: skip
        parts = [("", r.ratio, r.bar)]
        for o in same:
            if o.name == f"{OURS} (avx2)":
                parts.append(("avx2 ", r.median / o.median, r.bar * avx2_share))
        texts = [f"{tier}{ratio:.2f}x (bar {bar:.2f}){'' if ratio >= bar else ' MISSED'}"
                 for tier, ratio, bar in parts]  # fmt: skip
        case = f"{r.operator}, {r.case}, {r.mode}, {r.threads} threads, {r.name}"
        lines.append(f"{case}: {', '.join(texts)}")
    return "\n".join(lines)


def save(results: list[Result], suite: str) -> Path:
    """Writes results and machine to results/<suite>--<tier>.json."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{suite}--{_C.tier()}.json"
    content = dict(machine=machine(), results=[asdict(r) for r in results])
    path.write_text(json.dumps(content, indent=1) + "\n")
    return path


def load(path: Path) -> tuple[dict, list[Result]]:
    """What `save` wrote."""
    content = json.loads(path.read_text())
    return content["machine"], [Result(**r) for r in content["results"]]


def plot(results: list[Result], path: Path) -> None:
    """The peers' times over ours, a bar each, at one thread."""
    rows = [r for r in results if r.threads == 1 and not r.name.startswith(OURS)]
    names = list(dict.fromkeys(r.name for r in rows))
    keys = list(dict.fromkeys((r.operator, r.case, r.mode) for r in rows))
    figure, axes = plt.subplots(figsize=(9, 1.5 + 0.3 * len(keys)), layout="constrained")
    for index, name in enumerate(names):
        points = {(r.operator, r.case, r.mode): r.ratio for r in rows if r.name == name}
        places = [k for k, key in enumerate(keys) if key in points]
        axes.barh([p + 0.8 * index / len(names) for p in places],
                  [points[keys[p]] for p in places], 0.8 / len(names), label=name)  # fmt: skip
    axes.axvline(1, color="black", lw=1)
    axes.set_yticks([k + 0.4 for k in range(len(keys))], [", ".join(key) for key in keys])
    axes.tick_params(axis="y", labelsize=7)
    axes.invert_yaxis()
    axes.margins(y=0.005)
    axes.set_xlabel("time of the peer / time of darswin, 1 thread")
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def finish(results: list[Result], suite: str, avx2_share: float, keep: bool) -> None:
    """Prints tables and bars; with `keep`, writes results/<suite>--<tier>.json and .png."""
    print(table(results))
    print(bar_report(results, avx2_share))
    if keep:
        path = save(results, suite)
        plot(results, path.with_suffix(".png"))
        print(path.relative_to(path.parents[2]))
