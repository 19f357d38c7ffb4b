"""What every benchmark shares: timing, checking against peers, and a record of the machine.

The contract: `torch.utils.benchmark`, median and interquartile range; ours and every peer in the
same process and run; outputs checked equal before anything is timed; every result is published,
losses too.
"""

import json
import platform
import subprocess
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch.utils.benchmark import Timer

import darswin
from darswin import _C

RESULTS = Path(__file__).parent / "results"
OURS = "darswin"


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
    ratio: float  # the peer's time over ours


def machine() -> dict:
    """CPU, tier, versions and commit, for the head of a result file."""
    cpu = next(
        (line.split(":")[1].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
         if line.startswith("model name")), platform.processor(),
    )  # fmt: skip
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True
    ).stdout.strip()
    return dict(
        cpu=cpu,
        cores=torch.get_num_threads(),
        tier=_C.tier(),
        compiler=_C.build_info()["compiler"],
        python=platform.python_version(),
        torch=torch.__version__,
        darswin=darswin.__version__,
        commit=commit,
    )


def compare(
    operator: str,
    case: str,
    candidates: dict[str, Callable[[], list[torch.Tensor]]],
    *,
    mode: str,
    threads: int,
    tolerance: float = 1e-4,
    min_run_time: float = 0.3,
) -> list[Result]:
    """Checks that all candidates agree with ours, then times them; `OURS` must be among them."""
    expected = candidates[OURS]()
    for name, run in candidates.items():
        for got, want in zip(run(), expected, strict=True):
            torch.testing.assert_close(
                got, want, rtol=tolerance, atol=tolerance * want.abs().max().item(),
                msg=lambda text, name=name: f"{case}: {name} disagrees with ours: {text}",
            )  # fmt: skip
    times = {}
    for name, run in candidates.items():
        timer = Timer("run()", globals={"run": run}, num_threads=threads)
        times[name] = timer.blocked_autorange(min_run_time=min_run_time)
    return [
        Result(operator, case, mode, threads, name, t.median, t.iqr, t.median / times[OURS].median)
        for name, t in times.items()
    ]


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
