"""The machine of a measurement: CPU, instruction-set tiers, number of threads."""

import contextlib
import platform
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from typing import TypeVar

import torch

from darswin.cli.info import commit, cpu
from darswin.ops import _module, cpu_capability

T = TypeVar("T")
# The packages whose speed is measured or compared with; OpenCV has two.
PACKAGES = (
    "torch", "numpy", "onnxruntime", "openvino", "opencv-python", "opencv-python-headless",
    "darswin",
)  # fmt: skip
THREADS = sorted({1, torch.get_num_threads()})  # the numbers of threads to measure with


def machine() -> dict[str, str | int]:
    """The head of a record: CPU, tier, the versions of all peers and, in a checkout, the commit."""
    return dict(
        cpu=cpu(),
        cores=max(THREADS),
        tier=cpu_capability(),
        compiler=_module.build_info()["compiler"],
        python=platform.python_version(),
        **_versions(),
        commit=commit(),
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


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
