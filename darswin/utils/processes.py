"""The processes of a run on one machine: if one of them dies, the others die too."""

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

_FIRST = "DARSWIN_FIRST_PROCESS"  # the environment variable with its process number
_OWN_WORDS = 5  # seconds in which the first process may tell its own error, often the same one
_PR_SET_PDEATHSIG = 1  # option of Linux's prctl: the signal for a process whose parent dies


@contextmanager
def die_with_first_process() -> Iterator[None]:
    """A context in which Lightning's other processes of a run die together with the first one.

    Otherwise they would wait for the first one for minutes. Processes that torchrun, SLURM or a
    user starts have other parents, and are not affected. SystemExit: the first one is dead already.
    """
    first = os.environ.get(_FIRST)
    if first is not None and os.environ.get("LOCAL_RANK", "0") != "0":
        die_with_parent(int(first))
        yield
        return
    os.environ[_FIRST] = str(os.getpid())
    try:
        yield
    finally:
        os.environ.pop(_FIRST, None)


def die_with_parent(parent: int) -> None:
    """Lets this process die together with its parent, even by a kill; SystemExit: it is dead. Only
    Linux can do this; elsewhere the process lives on."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        raise SystemExit(1)


def end_with_failed_process(others: Sequence[subprocess.Popen], hint: str) -> None:
    """Starts a thread of the first process. Once one of the `others` has failed, it prints which
    one, and `hint`, and ends the first process with exit code 1.

    Otherwise the first process would fail in the network library, with a traceback, or wait there
    for minutes.
    """

    def watch() -> None:
        while set(codes := [other.poll() for other in others]) != {0}:
            for place, (other, code) in enumerate(zip(others, codes, strict=True), 2):
                if not code:
                    continue
                if code > 0:
                    time.sleep(_OWN_WORDS)
                    how = f"ended with exit code {code}"
                else:
                    how = f"was ended by {signal.Signals(-code).name}"
                sys.stdout.flush()
                number = f"process {place} of {len(others) + 1} (number {other.pid})"
                sys.stderr.write(f"darswin: {number} {how}{hint}\n")
                sys.stderr.flush()
                os._exit(1)
            time.sleep(0.05)

    threading.Thread(target=watch, daemon=True).start()
