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


def end_with_killed_process(others: Sequence[subprocess.Popen], hint: str) -> None:
    """Starts a thread of the first process. Once a signal has ended one of the `others`, it prints
    which one, and `hint`, and ends the first process with exit code 1.

    Otherwise the first process would fail in the network library, with a traceback.
    """

    def watch() -> None:
        alive = True
        while alive:
            alive = any(other.poll() is None for other in others)
            for place, other in enumerate(others, 2):
                if (code := other.poll()) is not None and code < 0:
                    name = signal.Signals(-code).name
                    sys.stdout.flush()
                    sys.stderr.write(
                        f"darswin: process {place} of {len(others) + 1} (number {other.pid}) was "
                        f"ended by {name}{hint}\n"
                    )
                    sys.stderr.flush()
                    os._exit(1)
            time.sleep(0.05)

    threading.Thread(target=watch, daemon=True).start()
