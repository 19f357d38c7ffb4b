"""Small tests for past bugs: out-of-bounds reads and writes, crashes and hangs."""

import sys

import pytest
import torch
from helpers import output

# -- memory ----------------------------------------------------------------------------------------


LACKING_MEMORY = """
import resource, torch
from darswin.utils.malloc import give_back_memory
from darswin.ops import polar_sample
torch.set_num_threads(2)
image = torch.rand(2, 1, 9, 9)
radii, azimuths = torch.linspace(0, 4, 1000)[None], torch.linspace(0, 6, 4000)
center = torch.full((1, 2), 4.0)

def large():  # 16 MB, and 64 MB of working memory for each thread
    return polar_sample(image.bfloat16(), radii, azimuths, center, samples=(1000, 1))

def small():
    return polar_sample(image, radii[:, ::100], azimuths[:40], center, samples=(2, 2))

def size(name):
    give_back_memory()  # what glibc keeps of freed memory
    (line,) = [l for l in open("/proc/self/status") if l.startswith(name)]
    return int(line.split()[1]) * 1024

first = small().clone()
resource.setrlimit(resource.RLIMIT_AS, (size("VmSize") + 60 * 2**20, resource.RLIM_INFINITY))
for _ in range(3):
    try:
        large()
    except (MemoryError, RuntimeError) as error:
        print(type(error).__name__)
    assert torch.equal(small(), first)
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
image = torch.ones(1, 1, 6000, 6000, dtype=torch.bfloat16)
before = size("VmSize")
polar_sample(image, radii[:, ::100], azimuths[:40], center[:1], samples=(2, 2))
print((size("VmSize") - before) // 2**20)
before = size("VmRSS")
assert large().isfinite().all()
frames = torch.ones(2, 1, 4000, 4000, dtype=torch.bfloat16, requires_grad=True)
out = polar_sample(frames, radii, azimuths[:40], center, samples=(1, 1))
(grad,) = torch.autograd.grad(out.float().sum(), frames)  # whose sums take 256 MB
assert grad.count_nonzero() > 0
del out, grad, frames
print((size("VmRSS") - before) // 2**20)
"""


@pytest.mark.slow
@pytest.mark.unsanitized
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory and reads /proc")
def test_out_of_memory_is_an_error_and_large_working_memory_is_given_back():
    # A process of its own, which may crash.
    *errors, sampled, kept = output(sys.executable, "-c", LACKING_MEMORY, timeout=120).split()
    assert len(errors) == 3 and set(errors) <= {"MemoryError", "RuntimeError"}
    assert int(sampled) < 300  # MB of addresses; the sums of a gradient would take 576 MB
    assert int(kept) < 80  # MB for two threads, which once kept 512 MB


# -- sizes that are too large ----------------------------------------------------------------------

SAMPLE = torch.ops.darswin.polar_sample


def plain(samples):
    """The remaining arguments of a raw polar_sample call, without jitter."""
    return (None, None, samples, [], [], False, True)


@pytest.mark.parametrize(
    ("shape", "samples"),
    [((2, 3, 5, 7), (2**62, 2**62)), ((2**53, 0, 5, 7), (1, 1)), ((2, 2**53, 5, 0), (1, 1))],
    ids=str,
)
def test_sizes_that_no_number_holds_are_refused(shape, samples):
    image = torch.ones(1, 1, 1, 1).expand(shape)
    lens = (torch.rand(1, 1024), torch.rand(1024), torch.rand(1, 2), None, None)
    if samples[0] > 1:
        lens = (torch.rand(1, 0), torch.rand(0), torch.rand(1, 2), None, None)
    with pytest.raises(RuntimeError, match="too large"):
        SAMPLE(image, *lens, *plain(samples))


def test_gradients_of_nothing_take_no_time_and_no_memory():
    # There are no points, so the huge number of images that share a lens must not matter.
    many = torch.ones(1, 1, 1, 1).expand(2**40, 1, 4, 4)
    grads = torch.ops.darswin.polar_sample_backward(
        many, torch.ones(1, 4), torch.zeros(0), torch.ones(1, 2), None, None, *plain((2, 1)),
        torch.zeros(1, 2, 0, 2).expand(2**40, 2, 0, 2), False, True, False,
    )  # fmt: skip
    assert torch.equal(grads[1], torch.zeros(1, 4))
    assert torch.equal(grads[2], torch.zeros(1, 2))


def test_any_stride_of_a_single_row_is_as_good():
    image = torch.rand(1, 1, 1, 9)
    odd = image.as_strided(image.shape, (2**62, 2**62, 2**62, 1))
    lens = (torch.rand(1, 4) * 4, torch.rand(8), torch.tensor([[4.0, 0.0]]), None, None)
    assert torch.equal(SAMPLE(odd, *lens, *plain((1, 1))), SAMPLE(image, *lens, *plain((1, 1))))
