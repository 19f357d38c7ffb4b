"""The pool of threads: several callers at once, forks, errors, and helpers that sleep."""

import random
import re
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch
from helpers import output
from torch import Tensor

from darswin.ops import polar_sample, polar_to_image, window_attention

ROOT = Path(__file__).parents[2]


def with_gradients(run: Callable[..., Tensor], *inputs: Tensor) -> list[Tensor]:
    leaves = [t.detach().requires_grad_() for t in inputs]
    out = run(*leaves)
    return [out.detach(), *torch.autograd.grad(out.sum(), leaves)]


def calls(size: int) -> list[Callable[[], list[Tensor]]]:
    """Calls of each operator: with size 1 on one thread, with size 4 on several."""
    rings, sectors = 4 * size, 8 * size
    image = torch.rand(size, 3, 16 * size, 16 * size)
    radii, azimuths = torch.linspace(0, 8.0 * size, rings), torch.linspace(0, 6.2, sectors)
    center = torch.full((1, 2), 8.0 * size)
    tokens = torch.rand(size, rings, sectors, 8)
    qkv, bias = torch.rand(size, rings, sectors, 3, 2, 8), torch.rand(1, 2, 7, 15)
    out = (8 * size, 8 * size)
    rows, parameters = torch.rand(64 * size * size, 96), torch.rand(2, 96)
    return [
        lambda: with_gradients(
            lambda i, r: polar_sample(i, r, azimuths, center, samples=(2, 2)), image, radii[None]
        ),
        lambda: with_gradients(
            lambda x: polar_to_image(x, radii[None] + 1, center, out, layout="tokens"), tokens
        ),
        lambda: with_gradients(lambda q, b: window_attention(q, b, window=(4, 8)), qkv, bias),
        lambda: [torch.ops.darswin._norm(rows, parameters, 1e-5)],
    ]


@pytest.mark.slow
def test_ten_thousand_calls_of_several_threads_have_the_same_bits(threads):
    torch.manual_seed(0)
    runs = [run for size in (1, 2, 4) for run in calls(size)]
    threads(1)
    expected = [run() for run in runs]

    def caller(seed: int) -> int:
        chance = random.Random(seed)
        for _ in range(2500):
            torch.set_num_threads(chance.randint(1, 5))  # of this thread
            k = chance.randrange(len(runs))
            assert all(map(torch.equal, runs[k](), expected[k])), k
        return 2500

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(caller, range(4))) == 10_000


SAMPLE = """
import os, signal, threading, time
import torch
from darswin.ops import polar_sample
image, radii = torch.rand(4, 3, 64, 64), torch.linspace(0, 31, 64)[None]
arguments = (image, radii, torch.linspace(0, 6, 128), torch.full((1, 2), 31.5))
def sample(threads):
    torch.set_num_threads(threads)
    for _ in range(20):
        out = polar_sample(*arguments, samples=(4, 4))
    return out
expected = sample(1)
def check(threads):
    # Not by torch, whose own threads a fork lacks.
    assert (sample(threads).numpy() == expected.numpy()).all()
    assert threads == 1 or len(os.listdir("/proc/self/task")) > 1
"""

FORK = """
def forked(work):
    child = os.fork()
    if child == 0:
        signal.alarm(100)
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
check(3)
forked(lambda: check(3))
forked(lambda: forked(lambda: check(2)))  # a fork of a fork that had no threads of its own
forked(lambda: (check(4), forked(lambda: check(4))))
ended = threading.Event()
def call():
    while not ended.is_set():
        check(2)
caller = threading.Thread(target=call)
caller.start()
for _ in range(20):  # while another thread is in the middle of calls
    forked(lambda: check(3))
ended.set()
caller.join()
check(3)
"""


POOL = """
import multiprocessing
check(2)
with multiprocessing.get_context("fork").Pool(2) as pool:
    pool.map(check, [1, 2, 3] * 4)
"""


SLEEP = """
check(4)
def states():
    for task in os.listdir("/proc/self/task"):
        if int(task) != os.getpid():
            with open(f"/proc/self/task/{task}/stat") as file:
                yield file.read().rpartition(") ")[2][0]
assert len(list(states())) >= 3
while set(states()) != {"S"}:
    time.sleep(0.01)
for task in os.listdir("/proc/self/task"):  # to wake a thread changes its cores only for a moment
    assert os.sched_getaffinity(int(task)) == os.sched_getaffinity(0)
"""


unsanitized = pytest.mark.unsanitized


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="forks, and reads /proc")
@pytest.mark.parametrize(
    "code",
    [
        pytest.param(FORK, id="a fork has threads of its own", marks=unsanitized),
        pytest.param(POOL, id="forks of multiprocessing", marks=unsanitized),
        pytest.param(SLEEP, id="helpers without work sleep"),
    ],
)
def test_a_process_ends_well(code):
    output(sys.executable, "-c", SAMPLE + code, timeout=300)


@pytest.mark.slow
@pytest.mark.unsanitized  # a program cannot have two sanitizers
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_thread_sanitizer_finds_no_race_in_the_pool(tmp_path):
    program = tmp_path / "pool"
    sources = [ROOT / "tests" / "cpp" / "pool.cpp", ROOT / "csrc" / "core" / "parallel.cpp"]
    flags = ["-std=c++20", "-g", "-O1", "-fsanitize=thread", "-pthread", f"-I{ROOT / 'csrc'}"]
    output("g++", *flags, *sources, "-o", program)
    said = output(program, timeout=300)
    helped = re.search(r"10000 calls, in which helpers ran (\d+) ranges", said)
    assert helped is not None and int(helped[1]) > 0
