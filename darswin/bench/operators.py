"""Operators against their peers: called alike, checked to be equal, timed on every tier.

Ours and every peer run in the same process, in turns. Outputs are checked equal before anything is
timed. Every result is published, losses too.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from darswin.bench import plot, tables, targets
from darswin.bench.machine import THREADS, machine, num_threads, on_other_tiers
from darswin.bench.record import Record
from darswin.bench.timing import OURS, Case, Timing, measure

Step = Callable[[], list[Tensor]]
View = Callable[[Tensor], Tensor]


def forward(run: Callable[..., Tensor], inputs: Sequence[Tensor]) -> Step:
    """A function that runs without recording gradients; returns the output."""

    def step() -> list[Tensor]:
        with torch.no_grad():
            return [run(*inputs)]

    return step


def forward_backward(run: Callable[..., Tensor], inputs: Sequence[Tensor], view: View) -> Step:
    """A function that runs and backpropagates; returns output and gradients.

    The output's gradient is the same for all candidates whose outputs are equal in `view`.
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

    The tolerance is of each value and of the largest one; None lets them differ.
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
    """Checks that all candidates agree, then times them, as `case.mode` says with their gradients,
    and ours on every instruction-set tier: "darswin (avx2)" and so on."""
    if case.mode.startswith("forward+backward"):
        steps = {name: forward_backward(run, inputs, view) for name, run in candidates.items()}
    else:
        steps = {name: forward(run, inputs) for name, run in candidates.items()}
    for tier, step in on_other_tiers(steps[OURS]).items():
        steps[f"{OURS} ({tier})"] = step
    check(case, steps, tolerance, view)
    return measure(case, steps, seconds, targets=targets)


def run_suite(
    suite: str, jobs: Sequence[Callable[[], list[Timing]]], avx2_share: float, out: Path | None
) -> list[Timing]:
    """Runs jobs at one and at all threads, prints tables and targets, of which the AVX2 tier is to
    reach a share, and writes the record and its plot to the folder `out`."""
    head = machine()
    print(" ".join(f"{k}={v}" for k, v in head.items()))
    timings: list[Timing] = []
    for job in tqdm(jobs, unit="case"):
        for threads in THREADS:
            with num_threads(threads):
                timings += job()
    for subject in dict.fromkeys(t.subject for t in timings):
        print(tables.peers_table(timings, subject), end="\n\n")
    print(*targets.lines(timings, avx2_share), sep="\n")
    if out:
        Record(head, timings).publish(out, suite, plot.draw_peers)
    return timings
