"""How many kernels the operators launch with Triton: counted on "meta", where none runs."""

from unittest import mock

import pytest
import torch
from launches import Launches

from darswin.ops import _sampling, triton

pytestmark = pytest.mark.skipif(not triton.INSTALLED, reason="triton is not installed")


def meta(*shape, dtype=torch.float32):
    return torch.empty(shape, device="meta", dtype=dtype)


def launches(operator, *arguments):
    """The names of what the launcher of an operator launches: torch's operations and kernels."""
    from triton.runtime.jit import KernelInterface

    launch, kernels = triton.launcher(operator), []

    def counting(kernel, grid):
        return lambda *arguments, **options: kernels.append(kernel.fn.__name__)

    with mock.patch.object(KernelInterface, "__getitem__", counting), Launches() as counted:
        launch(*arguments)
    return [*counted.names.elements(), *kernels]


def sampling(dtype=torch.float32, **options):
    """The arguments of darswin_a_small's sampling: 64×64, S = 10."""
    given = dict(
        image=meta(2, 3, 64, 64, dtype=dtype), radii=meta(2, 160), azimuths=meta(640),
        center=meta(2, 2), affine=None, offsets=None, jitter=0.0, seed=0, samples=(10, 10),
        mean=0.5, std=0.5, channels_last=False,
    )  # fmt: skip
    return _sampling.checked_sampling(**given | options)


GENERAL = dict(affine=meta(2, 2, 2), offsets=meta(2, 2, 160, 640), jitter=1.0, seed=5)


@pytest.mark.parametrize("tokens", [False, True])
@pytest.mark.parametrize(
    "options",
    [dict(), dict(jitter=1.0), GENERAL, dict(dtype=torch.uint8)],
    ids=["plain", "jitter", "general", "frames"],
)
def test_sampling_is_one_launch(options, tokens):
    assert launches("polar_sample", *sampling(**options), tokens) == ["_forward"]


@pytest.mark.parametrize("bias", [None, meta(96)])
def test_embedding_is_two(bias):
    found = launches("polar_embed", *sampling(**GENERAL), meta(96, 300), bias)
    assert found == ["aten::mm" if bias is None else "aten::addmm", "_forward"]


def test_the_gradient_of_the_layer_is_three():
    # The samples, which are made again, a product and a sum.
    wanted = False, False, False, True
    grad = meta(2, 16, 64, 96)
    found = launches("polar_embed_backward", *sampling(), meta(96, 300), grad, *wanted)
    assert sorted(found) == ["_forward", "aten::mm", "aten::sum.dim_IntList"]


def test_the_gradient_of_an_image_is_four():
    wanted = True, False, False
    found = launches("polar_sample_backward", *sampling(), True, meta(2, 16, 64, 300), *wanted)
    assert sorted(found) == ["_backward", "_finish", "aten::linalg_vector_norm", "aten::zeros"]


def attention(*lead):
    """The arguments of attention: a shifted stage 3 of darswin_a_small, and its biases."""
    return meta(2, 16, 4, 3, 3, 32), meta(*lead, 3, 7, 7), (4, 4), (2, 0), (False, True), 0.2


def test_attention_is_one_launch_and_one_more_for_biases_that_are_strided():
    assert launches("window_attention", *attention(2)) == ["_forward"]
    qkv, bias, *others = attention(2, 2)
    assert launches("window_attention", qkv, bias[:, 0], *others) == ["aten::clone", "_forward"]


def test_the_gradient_of_attention_is_three():
    found = launches("window_attention_backward", *attention(2), meta(2, 16, 4, 96))
    assert sorted(found) == ["_backward", "_fold", "aten::sum.dim_IntList"]


def test_polar_to_image_is_one_launch():
    lens = meta(1, 64), meta(1, 2), None, None, meta(1)
    assert launches("polar_to_image", meta(2, 64, 256, 16), *lens, (64, 64), True) == ["_forward"]
