"""The processes of a run on one machine: if the first one dies, the others die too."""

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_FIRST = "DARSWIN_FIRST_PROCESS"  # the environment variable with its process number
_PR_SET_PDEATHSIG = 1  # option of Linux's prctl: the signal for a process whose parent dies


@contextmanager
def die_with_first_process() -> Iterator[None]:
    """A context in which Lightning's other processes of a run die together with the first one.

    Otherwise they would wait for the first one for minutes. Processes that torchrun, SLURM or a
    user starts have other parents, and are not affected. SystemExit: the first one is dead already.
    """
    first = os.environ.get(_FIRST)
    if first is not None and os.environ.get("LOCAL_RANK", "0") != "0":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != int(first):
            raise SystemExit(1)
        yield
        return
    os.environ[_FIRST] = str(os.getpid())
    try:
        yield
    finally:
        os.environ.pop(_FIRST, None)
