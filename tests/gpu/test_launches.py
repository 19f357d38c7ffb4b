"""The number of kernels that the operators launch, counted on "meta", where no kernel runs."""

from unittest import mock

import pytest
import torch
from launches import Launches

from darswin.ops import _sampling, triton

pytestmark = pytest.mark.skipif(not triton.INSTALLED, reason="triton is not installed")


def meta(*shape, dtype=torch.float32):
    return torch.empty(shape, device="meta", dtype=dtype)


def sampling(dtype=torch.float32, **options):
    """The arguments of darswin_a_small's sampling, for 64×64 px and S = 10."""
    given = dict(
        image=meta(2, 3, 64, 64, dtype=dtype), radii=meta(2, 160), azimuths=meta(640),
        center=meta(2, 2), affine=None, offsets=None, jitter=0.0, seed=0, samples=(10, 10),
        mean=0.5, std=0.5, channels_last=False,
    )  # fmt: skip
    return _sampling.checked_sampling(**given | options)


GENERAL = dict(affine=meta(2, 2, 2), offsets=meta(2, 2, 160, 640), jitter=1.0, seed=5)
# A shifted stage 3 of darswin_a_small: qkv, bias and settings.
STAGE = meta(2, 16, 4, 3, 3, 32), meta(2, 3, 7, 7), (4, 4), (2, 0), (False, True), 0.2
MAP = meta(2, 64, 256, 16), meta(1, 64), meta(1, 2), None, None, meta(1), (64, 64)
SAMPLES = meta(2, 16, 64, 300)
LAUNCHES = {
    **{f"samples, {name}, tokens {tokens}": ("polar_sample", (*case, tokens), ["_forward"])
       for name, case in dict(plain=sampling(), jitter=sampling(jitter=1.0),
                              general=sampling(**GENERAL), frames=sampling(torch.uint8)).items()
       for tokens in (False, True)},
    "an image's gradient": (
        "polar_sample_backward", (*sampling(), True, SAMPLES, True, False, False),
        ["_backward", "_finish", "aten::linalg_vector_norm", "aten::zeros"],
    ),
    "attention": ("window_attention", STAGE, ["_forward"]),
    "attention, a strided bias": (
        "window_attention", (STAGE[0], meta(2, 2, 3, 7, 7)[:, 0], *STAGE[2:]),
        ["_forward", "aten::clone"],
    ),
    "attention's gradient": ("window_attention_backward", (*STAGE, meta(2, 16, 4, 96)),
                             ["_backward", "_fold", "aten::sum.dim_IntList"]),
    "map to image": ("polar_to_image", (*MAP, True, None), ["_forward"]),
}  # fmt: skip


@pytest.mark.parametrize("name", LAUNCHES)
def test_launches(name):
    from triton.runtime.jit import KernelInterface

    operator, arguments, expected = LAUNCHES[name]
    launch, kernels = triton.launcher(operator), []

    def counting(kernel, grid):
        return lambda *arguments, **options: kernels.append(kernel.fn.__name__)

    with mock.patch.object(KernelInterface, "__getitem__", counting), Launches() as counted:
        launch(*arguments)
    assert sorted([*counted.names.elements(), *kernels]) == expected
