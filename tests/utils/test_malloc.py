import platform
import sys

import pytest
from helpers import output

from darswin.utils import malloc

# 64 MB: more than glibc ever keeps unasked. Of smaller tensors it may keep all, as it happens.
LARGE = "torch.ones(16, 2**20)"
SMALL = "[torch.ones(2**18) for _ in range(300)]"

# The fewest page faults of making something again: while blocks still find their places, one of
# them may need pages that were never touched.
SCRIPT = """
import resource, torch
from darswin.utils import malloc
{call}
def make():
    made = {what}
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    make()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
make()
print(min(faults() for _ in range(8)))
"""


def faults(call: str, what: str) -> int:
    # A process of its own: what is told to malloc stays.
    return int(output(sys.executable, "-c", SCRIPT.format(call=call, what=what)))


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's malloc is what is told")
def test_kept_memory_needs_no_new_pages():
    assert faults("assert malloc.keep_freed_memory()", f"({LARGE}, {SMALL})") < 100
    assert faults("", LARGE) > 10_000


def test_other_c_libraries_are_left_alone(monkeypatch):
    monkeypatch.setattr(malloc.ctypes, "CDLL", lambda name: object())
    assert not malloc.keep_freed_memory()
    malloc.give_back_memory()
