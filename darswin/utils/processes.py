"""The processes of one run on one machine: if the first one dies, the others die with it."""

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

_FIRST = "DARSWIN_FIRST_PROCESS"  # the variable that tells other processes its number
_PR_SET_PDEATHSIG = 1  # of Linux's prctl: the signal that a process gets when its parent dies


@contextmanager
def die_with_first_process() -> Iterator[None]:
    """Within it, the processes that Lightning starts for a run die as soon as the first one does.

    Without it they would wait for the first one for minutes. Processes that torchrun, SLURM or a
    user starts have other parents, and stay as they are. SystemExit: the first one has died before.
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
