"""The machine of a measurement: CPU, instruction-set tiers, number of threads."""

import contextlib
import platform
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import torch

from darswin.ops import _module, cpu_capability

T = TypeVar("T")
# The packages whose speed is measured or compared with; OpenCV has two.
PACKAGES = (
    "torch", "numpy", "onnxruntime", "openvino", "opencv-python", "opencv-python-headless",
)  # fmt: skip
THREADS = sorted({1, torch.get_num_threads()})  # the numbers of threads to measure with


def machine() -> dict[str, str | int]:
    """The head of a record: CPU, tier, the versions of all peers and, in a checkout, the commit."""
    return dict(
        cpu=_cpu(),
        cores=max(THREADS),
        tier=cpu_capability(),
        compiler=_module.build_info()["compiler"],
        python=platform.python_version(),
        **_versions(),
        darswin=version("darswin"),
        commit=_commit(),
    )


def on_other_tiers(run: Callable[[], T]) -> dict[str, Callable[[], T]]:
    """Functions that call `run` on each other instruction-set tier of this machine, by its name."""
    others = (tier for tier in _module.tiers() if tier != cpu_capability())
    return {tier: partial(_on_tier, tier, run) for tier in others}


def _on_tier(tier: str, run: Callable[[], T]) -> T:
    best = cpu_capability()
    _module.set_tier(tier)
    try:
        return run()
    finally:
        _module.set_tier(best)


@contextlib.contextmanager
def num_threads(count: int) -> Iterator[None]:
    """A context in which torch, our operators and inductor use `count` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _cpu() -> str:
    # Family and model are added on x86, because the name may stay the same for years.
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    facts = {key.strip(): value.strip() for key, _, value in (s.partition(":") for s in lines)}
    name = facts.get("model name", platform.processor())
    if "cpu family" not in facts:
        return name
    return f"{name} (family {facts['cpu family']}, model {facts['model']})"


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _commit() -> str:
    root = Path(__file__).parent.parent.parent
    if not (root / ".git").exists():
        return ""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True).stdout

    # The records of a run, which are written one by one, are no change of the code.
    changes = git("status", "--porcelain", "-uno", "--", ".", ":!benchmarks/results")
    return git("describe", "--always").strip() + "-dirty" * bool(changes)
