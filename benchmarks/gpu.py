"""Checks and times darswin on a GPU, in one process: `make gpu`.

Four parts, each with its share of the time: the operators against their reference in float64 on the
CPU, by the accuracy rule of the tests; training steps of each family of models against the CPU's;
the networks of the demo, trained there; and the speed and the memory of `darswin_a_small`, eager
and with `torch.compile`. On a GPU the operators run their reference, so the eager model is the
eager reference. A failure does not end the program, and what finds no time is told too.
"""

import argparse
import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from kit import candidates, other_device
from kit.machine import machine
from kit.memory import Memory
from kit.record import slug, write
from kit.tables import gpu_text
from kit.timing import COMPILED, OURS, Case, Timing, in_turns, summary
from torch import Tensor

from darswin import create_model, list_models
from darswin.models.base import Model
from darswin.models.pixel import PixelModel

ROOT = Path(__file__).parents[1]
SHARES = dict(operators=0.15, steps=0.1, digits=0.25, speed=0.5)  # of the time, by part
TOLERANCE = 1e-4  # of losses and gradients, relative to their norm
OWN_ERRORS = 4  # times the CPU's error in float32: the tolerance where that is larger
LEAST_ACCURACY = 92  # %, of the demo's DarSwin-A through each lens
TO_COMPILE = 60  # seconds, without which no model is compiled
DTYPES = dict(float32=torch.float32, bfloat16=torch.bfloat16)


class Check(NamedTuple):
    """A check or a measurement: `run` returns a sentence, or raises an error."""

    name: str
    run: Callable[[], str]
    seconds: float = 0.0  # that must be left


@dataclass
class Session:
    """A device, and what was found on it."""

    device: torch.device
    quick: bool
    checks: list[dict[str, str]] = field(default_factory=list)
    timings: list[Timing] = field(default_factory=list)
    memory: list[Memory] = field(default_factory=list)
    accuracy: dict[str, dict[str, float]] = field(default_factory=dict)  # %, by network and ξ

    def run(self, part: str, end: float) -> None:
        """Runs the checks of a part, and begins none at the `end`, in seconds of the clock."""
        checks: list[Check] = []
        begun = outcome(lambda: str(checks.extend(PARTS[part](self))))
        if begun["state"] != "passed":
            self._tell(part, "all", begun)
        for check in checks:
            if time.monotonic() + check.seconds >= end:
                self._tell(part, check.name, dict(state="not run", text="no time was left"))
            else:
                self._tell(part, check.name, outcome(check.run))

    def _tell(self, part: str, name: str, found: dict[str, str]) -> None:
        self.checks.append(dict(part=part, name=name) | found)
        print(f"{part}, {name}: {found['state']}, {found['text']}", flush=True)

    def wait(self) -> None:
        """Waits for the device."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def outcome(run: Callable[[], str]) -> dict[str, str]:
    """The state of a check, and a sentence."""
    try:
        return dict(state="passed", text=run())
    except ImportError as error:
        return dict(state="not run", text=f"a package is missing: {error}")
    except Exception as error:
        return dict(state="FAILED", text=f"{type(error).__name__}: {first_line(error)[:300]}")


def first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), "no message")


# -- the operators ---------------------------------------------------------------------------------


def operators(session: Session) -> Iterator[Check]:
    """Output and gradients of all named calls, in float32 and in bfloat16."""
    sys.path.append(str(ROOT / "tests" / "ops"))
    from cases import CASES, assert_accurate, assert_rounded_once, draws_for

    def accurate(key: tuple[str, str]) -> str:
        torch.manual_seed(0)
        share = assert_accurate(CASES[key], draws_for(key), session.device)
        return f"the largest error is {share:.0%} of the allowed one"

    def rounded(key: tuple[str, str]) -> str:
        torch.manual_seed(0)
        assert_rounded_once(CASES[key]().to(session.device), same_order=False)
        return "float32 rounded once"

    for key in list(CASES)[:: 14 if session.quick else 1]:
        yield Check(f"{': '.join(key)}, float32", partial(accurate, key))
        yield Check(f"{': '.join(key)}, bfloat16", partial(rounded, key))


# -- training steps --------------------------------------------------------------------------------


def training_step(
    model: Callable[..., Tensor], net: Model, size: int, batch: int, device: torch.device,
    dtype: torch.dtype,
) -> Callable[[], Tensor]:  # fmt: skip
    """A step of AdamW on images that are the same on every device; → the loss.

    The model is `net`, or its compiled form. bfloat16 means autocast.
    """
    exact = torch.float64 if dtype == torch.float64 else torch.float32
    net.to(device, exact).train()
    lens, draw = candidates.lens_of(size).to(device, exact), torch.Generator().manual_seed(1)
    images = torch.randn(batch, 3, size, size, generator=draw).to(device, exact)
    pixels = (size, size) if isinstance(net, PixelModel) else ()
    labels = torch.randint(net.num_classes, (batch, *pixels), generator=draw).to(device)
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-3)

    def step() -> Tensor:
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
            logits = model(images, lens)
        loss = F.cross_entropy(logits.to(exact), labels)
        loss.backward()
        optimizer.step()
        return loss.detach()

    return step


def two_steps(name: str, size: int, device: torch.device, dtype: torch.dtype) -> dict[str, Tensor]:
    """The losses of two training steps, and all gradients of the first one, on the CPU."""
    net = candidates.network(name, size)
    step = training_step(net, net, size, 4, device, dtype)
    torch.manual_seed(2)  # of jitter
    losses = [step()]
    gradients = torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])
    losses.append(step())
    return dict(losses=torch.stack(losses).cpu().double(), gradients=gradients.cpu().double())


def steps(session: Session) -> Iterator[Check]:
    """Two steps of a model of each family, on the device and on the CPU."""
    size, cpu = 32 if session.quick else 64, torch.device("cpu")

    def equal(name: str) -> str:
        """Up to the tolerance. The gradient of ReLU jumps, so that rounding makes larger errors in
        the convolutional U-Net, also on the CPU against itself in float64."""
        found = two_steps(name, size, session.device, torch.float32)
        exact, expected = (
            two_steps(name, size, cpu, dtype) for dtype in (torch.float64, torch.float32)
        )
        told = []
        for what, want in expected.items():
            error, own = (((x[what] - want).norm() / want.norm()).item() for x in (found, exact))
            allowed = max(TOLERANCE, OWN_ERRORS * own)
            told.append(f"{what} differ by {error:.1e} of their norm, allowed {allowed:.1e}")
            if not error <= allowed:
                raise AssertionError(told[-1])
        return ", ".join(told)

    def finite(name: str) -> str:
        found = two_steps(name, size, session.device, torch.bfloat16)
        if not all(values.isfinite().all() for values in found.values()):
            raise AssertionError("losses or gradients are not finite")
        first, second = found["losses"].tolist()
        return f"losses {first:.3f} and {second:.3f}"

    for name in (name for name in list_models() if name.endswith("_nano")):
        yield Check(f"{name}, float32", partial(equal, name))
        yield Check(f"{name}, bfloat16", partial(finite, name))


# -- the demo --------------------------------------------------------------------------------------


def demo(session: Session) -> Iterator[Check]:
    """The demo's three networks with one seed, trained and tested on the device."""
    sys.path.append(str(ROOT / "examples"))
    import digits

    scans, labels, seen, unseen = digits.split()
    names, epochs, sweep = list(digits.MODELS), 16, digits.XI
    if session.quick:
        names, epochs, sweep = names[:1], 1, sweep[::10]

    def trained(name: str) -> str:
        torch.manual_seed(0)
        kind, options = digits.MODELS[name]
        model = create_model(kind, num_classes=10, in_chans=1, **options).to(session.device)
        start = time.perf_counter()
        digits.train(model, scans[seen], labels[seen], epochs, 48, 0, name)
        seconds, row = time.perf_counter() - start, {}
        for xi in sweep:
            images, lenses = digits.through_lenses(scans[unseen], np.full(len(unseen), xi))
            row[f"{xi:.1f}"] = digits.accuracy(model, images, lenses, labels[unseen])
        session.accuracy[name] = row
        text = f"{min(row.values()):.1f} to {max(row.values()):.1f} % are right"
        if name == names[0] and not session.quick and min(row.values()) < LEAST_ACCURACY:
            raise AssertionError(f"{text}, not {LEAST_ACCURACY} %")
        return f"{text}, trained in {seconds:.0f} s"

    for name in names:
        yield Check(name, partial(trained, name))


# -- speed and memory ------------------------------------------------------------------------------


def speed(session: Session) -> Iterator[Check]:
    """Images per second and peak memory, of the eager model in all cases and then compiled."""
    name, sizes, batch = "darswin_a_small", (64, 224), 64
    dtypes = ("bfloat16", "float32")
    if session.quick:
        name, sizes, batch, dtypes = "darswin_a_nano", (32,), 2, dtypes[:1]
    cases = [
        Case(name, f"{size}×{size}", batch, torch.get_num_threads(), f"{mode}, {dtype}")
        for dtype in dtypes
        for size in sizes
        for mode in ("training", "inference")
    ]
    for compiled in (False, True):
        needed = TO_COMPILE if compiled and not session.quick else 0.0
        for case in cases:
            title = f"{name}, {case.setting}, {case.mode}, {COMPILED if compiled else 'eager'}"
            yield Check(title, partial(timed, session, case, compiled), needed)


def timed(session: Session, case: Case, compiled: bool) -> str:
    """Times the eager model, or a compiled one in turns with it, and measures the memory."""
    torch._dynamo.reset()
    runs = {OURS: run_of(session, case, compiled=False)}
    if compiled:
        runs[COMPILED] = run_of(session, case, compiled=True)
    name = [*runs][-1]
    for run in runs.values():  # graphs are compiled and kernels chosen in the first calls
        if not all(run().isfinite().all() for _ in range(3)):
            raise AssertionError("the results are not finite")
    found = summary(case, name, in_turns(runs, 0.1 if session.quick else 2.0))
    session.timings.append(found)
    text = f"{case.batch / found.median:.0f} images/s in batches of {case.batch}"
    if compiled:
        text += f", {1 / found.ratio:.2f} times as fast as the eager model beside it"
    if session.device.type != "cuda":
        return text
    run = runs.pop(name)
    runs.clear()  # the eager model takes memory too
    torch.cuda.reset_peak_memory_stats(session.device)
    between = torch.cuda.memory_allocated(session.device)
    run()
    peak = torch.cuda.max_memory_allocated(session.device)
    mode = f"{case.mode}, {case.setting}"
    session.memory.append(Memory(mode, case.batch, name, 0, between, peak))
    return f"{text}, {peak / 2**20:.0f} MB at the peak"


def run_of(session: Session, case: Case, compiled: bool) -> Callable[[], Tensor]:
    """A call that ends when the device has computed the loss or the logits."""
    size, (mode, dtype) = int(case.setting.partition("×")[0]), case.mode.split(", ")
    net, device = candidates.network(case.subject, size), session.device
    model: Callable[..., Tensor] = torch.compile(net, dynamic=False) if compiled else net
    if mode == "training":
        compute = training_step(model, net, size, case.batch, device, DTYPES[dtype])
    else:
        net.to(device).eval()
        lens, images = candidates.lens_of(size), torch.randn(case.batch, 3, size, size)
        autocast = partial(torch.autocast, device.type, torch.bfloat16, enabled=dtype == "bfloat16")
        compute = torch.no_grad()(autocast()(partial(model, images.to(device), lens.to(device))))

    def run() -> Tensor:
        result = compute()
        session.wait()
        return result

    return run


PARTS = dict(operators=operators, steps=steps, digits=demo, speed=speed)


def found_device(name: str) -> torch.device:
    """A device that computes; SystemExit with one sentence for another."""
    try:
        device = torch.device(name)
        torch.ones(3, device=device).sum().item()
        return device
    except Exception as error:
        reason = first_line(error).rstrip(".")
    raise SystemExit(f"torch {torch.__version__} cannot compute on {name!r}: {reason}")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda", help="of torch; 'other' is an imitation [cuda]")
    parser.add_argument("--minutes", type=float, default=7.0, help="after which nothing begins [7]")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], metavar="PART",
                        help=f"of {', '.join(PARTS)} [all]")  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="few calls and small models")
    parser.add_argument("--out", type=Path, default=Path(), help="the folder of the record [.]")
    args = parser.parse_args(argv)
    with contextlib.ExitStack() as stack:
        if args.device == other_device.NAME:
            stack.enter_context(other_device.OtherDevice())
        return check_all(found_device(args.device), args.parts, args.minutes, args.quick, args.out)


def check_all(
    device: torch.device, parts: list[str], minutes: float, quick: bool, out: Path
) -> int:
    """Runs parts, prints what they find and writes the record; 1 if a check failed."""
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    head = machine()
    head["device"] = head["cpu"] if device.type == "cpu" else str(device)
    if device.type == "cuda":
        facts = torch.cuda.get_device_properties(device)
        head |= dict(device=facts.name, memory=facts.total_memory, cuda=str(torch.version.cuda))
    print(" ".join(f"{k}={v}" for k, v in head.items()), flush=True)
    session, end = Session(device, quick), time.monotonic()
    for part in parts:  # what a part leaves of its share is the next one's
        end += 60 * minutes * SHARES[part] / sum(SHARES[of] for of in parts)
        session.run(part, end)
    record = dict(
        machine=head, quick=quick, checks=session.checks, accuracy=session.accuracy,
        timings=[asdict(t) for t in session.timings], memory=[asdict(m) for m in session.memory],
    )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"gpu--{slug(str(head['device']))}.json"
    write(path, **record)
    print("", gpu_text([record]), "", path, sep="\n")
    return int(any(row["state"] == "FAILED" for row in session.checks))


if __name__ == "__main__":
    sys.exit(main())
