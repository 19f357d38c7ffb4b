"""What a measurement ran on."""

import platform
import subprocess
from importlib.metadata import version
from pathlib import Path

import torch

from darswin import _C

THREADS = sorted({1, torch.get_num_threads()})


def machine() -> dict[str, str | int]:
    """CPU, tier and versions, and in a checkout the commit: the head of a record."""
    return dict(
        cpu=_cpu(),
        cores=torch.get_num_threads(),
        tier=_C.tier(),
        compiler=_C.build_info()["compiler"],
        python=platform.python_version(),
        torch=torch.__version__,
        darswin=version("darswin"),
        commit=_commit(),
    )


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = (line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())


def _commit() -> str:
    root = Path(__file__).parent.parent.parent
    if not (root / ".git").exists():
        return ""
    return subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=root, capture_output=True, text=True
    ).stdout.strip()
