"""The first answer of a program: how long it takes from its first import, and its memory then."""

import statistics
import subprocess
import sys
from dataclasses import dataclass

_PROGRAM = """
import time
start = time.perf_counter()
{code}
seconds = time.perf_counter() - start
with open("/proc/self/status") as status:
    (resident,) = (line.split()[1] for line in status if line.startswith("VmRSS:"))
print(seconds, resident)
"""


@dataclass
class Start:
    """The median of a few processes."""

    subject: str  # such as a model
    name: str  # of what runs it
    seconds: float  # from the first import to the first answer
    resident: int  # bytes, after it


def measure(subject: str, name: str, code: str, processes: int = 5) -> Start:
    """Runs the lines of `code`, which import, load and answer, in processes of their own."""
    command = [sys.executable, "-c", _PROGRAM.format(code=code)]
    found = []
    for _ in range(processes):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"the start of {name} cannot be measured: {done.stderr.strip()}")
        found.append(done.stdout.splitlines()[-1].split())
    seconds, kilobytes = (
        statistics.median(map(float, column)) for column in zip(*found, strict=True)
    )
    return Start(subject, name, seconds, int(1024 * kilobytes))
