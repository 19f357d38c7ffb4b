"""Operators compared with their peers, on every instruction-set tier.

Ours and all peers run in the same process, in turns. Their outputs are compared before the timing.
All results are published, also those where a peer is faster.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TypeVar

import torch
from kit import targets
from kit.machine import THREADS, machine, num_threads, on_other_tiers
from kit.plot import Rows, draw_panels, in_lines
from kit.record import Record
from kit.start import Start
from kit.tables import (
    by_case,
    markdown,
    milliseconds,
    paced_table,
    pivot,
    ratios,
    starts_table,
)
from kit.timing import DEFAULT, MATMULS, OURS, REFERENCE, Case, Timing, measure
from torch import Tensor
from tqdm import tqdm

from darswin import list_models

Step = Callable[[], list[Tensor]]
View = Callable[[Tensor], Tensor]
T = TypeVar("T")


def forward(run: Callable[..., Tensor], inputs: Sequence[Tensor]) -> Step:
    """A function that runs without recording gradients, and returns the output."""

    def step() -> list[Tensor]:
        with torch.no_grad():
            return [run(*inputs)]

    return step


def forward_backward(run: Callable[..., Tensor], inputs: Sequence[Tensor], view: View) -> Step:
    """A function that runs and backpropagates, and returns output and gradients.

    Candidates whose outputs are equal in `view` get the same gradient of the output.
    """
    leaves = [t.detach().requires_grad_() for t in inputs]
    out = run(*leaves)
    viewed = view(out)
    grad = torch.randn(viewed.shape, generator=torch.Generator().manual_seed(0)).to(out.dtype)
    if viewed.shape != out.shape:  # back through the view
        (grad,) = torch.autograd.grad(viewed, out, grad)

    def step() -> list[Tensor]:
        out = run(*leaves)
        return [out.detach(), *torch.autograd.grad(out, leaves, grad)]

    return step


def check(
    case: Case,
    steps: Mapping[str, Step],
    tolerance: float | None,
    view: View = lambda result: result,
) -> None:
    """Calls all candidates; AssertionError unless they agree with `OURS` in `view`.

    The tolerance is relative to each value and to the largest one; None allows any difference.
    """
    expected = [view(result) for result in steps[OURS]()]
    for name, step in steps.items():
        results = step()
        if tolerance is None:
            continue
        for got, want in zip(map(view, results), expected, strict=True):
            largest = want.abs().max().item()
            try:
                torch.testing.assert_close(got, want, rtol=tolerance, atol=tolerance * largest)
            except AssertionError as error:
                message = f"{name} disagrees with ours in {case.label}: {error}"
                raise AssertionError(message) from None


def compare(
    case: Case,
    candidates: Mapping[str, Callable[..., Tensor]],
    inputs: Sequence[Tensor],
    seconds: float,
    *,
    targets: Mapping[str, float] | None = None,
    tolerance: float | None = 1e-4,
    view: View = lambda result: result,
) -> list[Timing]:
    """Checks that all candidates agree, then times them, with gradients if `case.mode` names them.
    Ours is timed on every instruction-set tier: "darswin (avx2)" and so on."""
    if case.mode.startswith("forward+backward"):
        steps = {name: forward_backward(run, inputs, view) for name, run in candidates.items()}
    else:
        steps = {name: forward(run, inputs) for name, run in candidates.items()}
    for tier, step in on_other_tiers(steps[OURS]).items():
        steps[f"{OURS} ({tier})"] = step
    check(case, steps, tolerance, view)
    return measure(case, steps, seconds, targets=targets)


def on_torch_threads(run: Callable[[], T]) -> Callable[[int], Callable[[], T]]:
    """A function for each number of threads, `DEFAULT` included, that calls `run` on so many of
    torch's."""

    def on(threads: int) -> Callable[[], T]:
        def step() -> T:
            if torch.get_num_threads() != (count := threads or max(THREADS)):
                torch.set_num_threads(count)  # only before the first frame of a turn
            return run()

        return step

    return on


def run_suite(
    suite: str,
    jobs: Sequence[Callable[[], list[Timing]]],
    avx2_share: float,
    out: Path | None,
    paced: Sequence[Callable[[], list[Timing]]] = (),
    starts: Sequence[Callable[[], list[Start]]] = (),
) -> list[Timing]:
    """Runs jobs at one and at all threads, and those at the pace of a camera, which choose their
    threads themselves; prints tables and targets, and writes the record and its plot to the folder
    `out`. On the AVX2 tier, the targets are `avx2_share` of the others."""
    head = machine()
    print(" ".join(f"{k}={v}" for k, v in head.items()))
    timings: list[Timing] = []
    for job in tqdm(jobs, unit="case"):
        for threads in THREADS:
            with num_threads(threads):
                timings += job()
    for job in tqdm(paced, unit="case", desc="at a camera's pace", disable=not paced):
        with num_threads(max(THREADS)):
            timings += job()
    started = [start for job in starts for start in job()]
    for subject in dict.fromkeys(t.subject for t in timings):
        print(peers_table(timings, subject), end="\n\n")
    if paced:
        print(paced_table(timings), end="\n\n")
    if starts:
        print(starts_table(started), end="\n\n")
    print(*targets.lines(timings, avx2_share), sep="\n")
    print(*targets.paced_lines(timings), *targets.start_lines(started), sep="\n")
    if out:
        Record(head, timings, starts=started).publish(out, suite, draw_peers)
    return timings


def draw_peers(record: Record, path: Path) -> None:
    """Draws the peers' times over ours at one thread: a panel for each operator and mode, with a
    row for each case; of several models, a panel for each mode, with a row for each model."""
    found: dict[str, dict[str, Rows]] = {}
    of_models = {t.subject for t in record.timings} <= {*list_models()}
    for t in record.timings:
        if t.threads == 1 and not t.name.startswith(OURS):
            group, title, row = (
                (t.mode, fill(t.mode, 40), t.subject)
                if of_models
                else (t.subject.partition(",")[0], f"{t.subject}\n{fill(t.mode, 20)}", t.setting)
            )
            rows = found.setdefault(group, {}).setdefault(title, {})
            rows.setdefault(f"{row}, batch {t.batch}", {})[t.name] = t.ratio
    lines = [line for panels in found.values() for line in in_lines(panels)]
    names = dict.fromkeys(t.name for t in record.timings if not t.name.startswith(OURS))
    unit = "time of the peer / time of darswin, 1 thread"
    draw_panels(lines, list(names), unit, path, is_ratio=True)


def peers_table(timings: Sequence[Timing], subject: str, peers: Sequence[str] = ()) -> str:
    """The peers' times over ours: a row for each case of an operator, a column for each peer."""
    chosen = [t for t in timings if t.subject == subject]
    peers = peers or [name for name in dict.fromkeys(t.name for t in chosen) if name != OURS]
    rows = []
    for (setting, batch, mode), found in by_case(chosen).items():
        if not found.keys().isdisjoint(peers):
            over = [ratios(found.get(peer, ())) for peer in peers]
            rows.append([f"{setting}, batch {batch}, {mode}", milliseconds(found[OURS]), *over])
    return markdown([f"`{subject}`", "ours (ms)", *peers], rows)


def frames_table(timings: Sequence[Timing], peers: Sequence[str]) -> str:
    """A row a model and batch in float32, in a loop; a column a peer with its time over ours."""
    in_float32, rows = [t for t in timings if t.mode.startswith("forward, float32")], []
    for subject in dict.fromkeys(t.subject for t in timings):
        chosen = [t for t in in_float32 if t.subject == subject]
        for (setting, batch, _), found in by_case(chosen).items():
            over = [ratios(found.get(peer, ()), 2) for peer in peers]
            rows.append(
                [f"`{subject}`, {setting}, batch {batch}", milliseconds(found[OURS]), *over]
            )
    return markdown(["", "ours (ms)", *peers], rows)


def single_frames(timings: Sequence[Timing]) -> list[Timing]:
    """One frame of one camera: at its pace, or in a loop in a record that has only that."""
    chosen = [t for t in timings if t.batch == 1 and t.mode.endswith("fixed lens")]
    return [t for t in chosen if t.paced] or chosen


def latency_table(timings: Sequence[Timing], peers: Sequence[str]) -> str:
    """The milliseconds of one frame: a row for each model and dtype, a column for each runtime."""
    frames, rows = [t for t in single_frames(timings) if t.threads != DEFAULT], []
    for subject in dict.fromkeys(t.subject for t in frames):
        chosen = [t for t in frames if t.subject == subject]
        for (setting, _, mode), found in by_case(chosen).items():
            _, dtype, _ = mode.split(", ")
            times = [milliseconds(found.get(name, ())) for name in (OURS, *peers)]
            rows.append([f"`{subject}`, {setting}, {dtype}", *times])
    return markdown(["", "`optimize`", *peers], rows)


def camera_table(timings: Sequence[Timing], peers: Sequence[str]) -> str:
    """The ms of one frame in float32 with default threads, or with all in a record of loops alone:
    a row for each runtime, a column for each model."""
    frames = [t for t in single_frames(timings) if "float32" in t.mode]
    paced = any(t.paced for t in frames)
    threads = DEFAULT if paced else max(t.threads for t in frames)
    return pivot(
        f"a frame {'every 33 ms' if paced else 'in a loop'}: p50 (p99)",
        (
            (t.name, f"`{t.subject}`", f"{1e3 * t.median:.2f} ({1e3 * (t.p99 or 0):.2f})")
            for t in frames
            if t.threads == threads and t.name in (OURS, *peers)
        ),
    )


def best_table(
    records: Mapping[str, Sequence[Timing]], rows: Iterable[tuple[str, str, str, int]]
) -> str:
    """Our time and the ratio of the fastest peer at all threads: a row for each (subject, mode,
    setting, batch), two columns for each CPU."""
    lines = [[f"`{name}`, {mode}, {setting}, batch {batch}"] for name, mode, setting, batch in rows]
    heads = [""]
    for cpu, timings in records.items():
        heads += [f"{cpu}: ours (ms)", "best peer"]
        for line, case in zip(lines, rows, strict=True):
            line += _best(timings, case)
    return markdown(heads, lines)


def _best(timings: Sequence[Timing], case: tuple[str, str, str, int]) -> list[str]:
    parts = (MATMULS, "F.linear alone")  # they do less work than ours: bounds, not peers
    chosen = [t for t in timings if (t.subject, t.mode, t.setting, t.batch) == case]
    if not chosen:
        return ["", ""]
    chosen = [t for t in chosen if t.threads == max(t.threads for t in chosen)]
    (ours,) = (t for t in chosen if t.name == OURS)
    peers = [t for t in chosen if t.name not in parts and not t.name.startswith(OURS)]
    best = min(peers, key=lambda t: t.ratio)
    time = f"{1e3 * ours.median:.2f}" if ours.median < 0.01 else f"{1e3 * ours.median:.0f}"
    return [time, f"{best.ratio:.1f}×"]


def missed_table(timings: Iterable[Timing]) -> str:
    """The ratios that are below their target."""
    missed = [t for t in timings if t.missed]
    rows = [[f"{t.label}: {t.name}", f"{t.ratio:.2f}", f"{t.target:.2f}"] for t in missed]
    return markdown(["", "ratio", "target"], rows)


def training_table(models: Mapping[str, Mapping]) -> str:
    """Images per second in training and testing, and ratios over the reference and over bare steps
    of training: a row per model."""
    rows = []
    for name, modes in models.items():
        cells = [f"`{name}`"]
        for mode in ("train", "test"):
            ours, theirs = modes[mode][OURS], modes[mode][REFERENCE]
            rate = ours["images_per_second"]
            cells += [f"{rate:.0f}", f"{rate / theirs['images_per_second']:.2f}×"]
            if mode == "train":
                share = rate / ours["bare_images_per_second"]
                cells += [f"{ours['outside']:.1%}", f"{share:.2f}"]
        rows.append(cells)
    heads = [
        "model", "training (images/s)", "over the reference", "outside the model",
        "over bare steps", "testing (images/s)", "over the reference",
    ]  # fmt: skip
    return markdown(heads, rows)
