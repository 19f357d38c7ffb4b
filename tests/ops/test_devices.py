"""What devices other than the CPU run, on the CPU: the reference's values and gradients. Random
arguments are in test_properties.py, launches in test_launches.py."""

import math
import subprocess
import sys
from unittest import mock

import pytest
import torch
from helpers import as_on_devices, assert_accurate, with_gradients
from torch._subclasses import FakeTensorMode

from darswin.ops import (
    _devices,
    polar_embed,
    polar_sample,
    reference,
    triton,
    use_reference,
    window_attention,
)
from darswin.ops._devices import philox

f64 = torch.float64


def make_lens(batch, size, rows, columns, dtype=torch.float32):
    """Radii, azimuths and center: points inside, on the border and outside of images (H, W)."""
    radii = torch.rand(batch, rows, dtype=dtype).sort(1).values * max(size) * 0.6
    azimuths = (torch.arange(columns, dtype=dtype) + 0.37) * (2 * math.pi / columns)
    center = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=dtype)
    return radii, azimuths, center + torch.rand(batch, 2, dtype=dtype)


def with_reference(run, inputs):
    with use_reference():
        return with_gradients(run, inputs)


@pytest.mark.parametrize("seed", [0, -1, 5, 2**62 + 3, -(2**63)])
def test_the_same_random_words_as_the_reference(seed):
    counters = torch.cat(
        (torch.arange(50).expand(2, -1), torch.randint(-(2**63), 2**63 - 1, (2, 50))), 1
    )
    words = philox(torch.tensor(seed), counters) & 0xFFFFFFFF
    expected = reference.philox(torch.tensor(seed), *counters)
    assert torch.equal(words, torch.stack(expected, -1))


@pytest.mark.parametrize("jitter", [0.0, 1.0])
@pytest.mark.parametrize("size", [(64, 64), (333, 517), (3, 41)])
def test_accuracy_of_samples(size, jitter):
    azimuths = make_lens(2, size, 1, 96)[1]

    def make():
        radii, _, center = make_lens(2, size, 40, 96)
        return torch.randn(2, 3, *size), radii, center

    def smooth(image, radii, center):
        """Gradients of the lens jump at the pixels' centres; jitter may bring any point there."""
        r, a = radii.double()[:, :, None], azimuths.double()
        xy = torch.stack((r * torch.cos(a), r * torch.sin(a)), -1) + center.double()[:, None, None]
        away = ((xy - xy.round()).abs() > 1e-2).all(-1)[:, None].double()
        return away if jitter == 0 else torch.zeros_like(away)

    def run(image, radii, center):
        grid = azimuths.to(radii.dtype), center
        return polar_sample(
            image, radii, *grid, samples=(4, 4), jitter=jitter, seed=3, layout="image"
        )

    # `F.grid_sample` takes places in units of the image, and so rounds them once more.
    with as_on_devices():
        assert_accurate(run, make, smooth, times=3.0)


@pytest.mark.parametrize(
    ("map_size", "window", "shift", "periodic"),
    [
        ((3, 64), (1, 16), (0, 4), (False, True)),
        ((16, 4), (4, 4), (2, 0), (False, True)),
        ((8, 8), (4, 4), (2, 2), (False, False)),
    ],
)
@pytest.mark.parametrize("rows", [1, 2])
def test_accuracy_rule_of_attention(map_size, window, shift, periodic, rows):
    def make():
        table = (rows, 2, 2 * window[0] - 1, 2 * window[1] - 1)
        return torch.randn(2, *map_size, 3, 2, 32), torch.randn(table)

    with as_on_devices():
        assert_accurate(
            lambda qkv, bias: window_attention(
                qkv, bias, window=window, shift=shift, periodic=periodic
            ),
            make,
        )


@pytest.mark.parametrize("channels", [1, 3])
def test_camera_frames_and_bfloat16(channels):
    radii, azimuths, center = make_lens(2, (20, 24), 8, 16)
    weight = torch.randn(5, 16 * channels)
    frames = torch.randint(256, (2, channels, 20, 24), dtype=torch.uint8)
    for image in (frames, torch.randn(2, channels, 20, 24).bfloat16()):

        def run(radii, center, weight, image=image):
            grid = (image, radii, azimuths, center)
            norm = dict(mean=[0.4, 0.5, 0.6][:channels], std=[0.2, 0.3, 0.2][:channels])
            tokens = polar_embed(*grid, weight, samples=(4, 4), **norm)
            return tokens.sum() + polar_sample(*grid, samples=(2, 2), **norm).float()

        expected = with_reference(run, (radii, center, weight))
        with as_on_devices():
            ours = with_gradients(run, (radii, center, weight))
        for got, want in zip(ours, expected, strict=True):
            assert got.dtype == want.dtype
            torch.testing.assert_close(got, want, rtol=2e-2, atol=1e-2 * want.abs().max().item())
    with use_reference():
        expected = polar_sample(frames, radii, azimuths, center, samples=(2, 2), mean=0.5, std=0.2)
    with as_on_devices():
        ours = polar_sample(frames, radii, azimuths, center, samples=(2, 2), mean=0.5, std=0.2)
    torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


def test_attention_in_bfloat16_is_rounded_once():
    qkv = torch.randn(2, 4, 8, 3, 2, 8).bfloat16()
    bias = torch.randn(1, 2, 3, 7)

    def run(qkv, bias):
        return window_attention(qkv, bias, window=(2, 4), shift=(1, 2))

    expected = with_reference(run, (qkv, bias))
    with as_on_devices():
        ours = with_gradients(run, (qkv, bias))
    for got, want in zip(ours, expected, strict=True):
        assert got.dtype == want.dtype
        torch.testing.assert_close(got, want, rtol=2**-7, atol=1e-4)


def test_a_pixel_beside_the_last_point_that_touches_nothing_does_not_count():
    # At x = -1 and x = W the pixel's weight would be 0, and NaN times 0 is NaN.
    image = torch.full((1, 1, 5, 5), math.nan)
    radii, azimuths, center = (
        torch.tensor([[3.0, 2.0]]),
        torch.tensor([0.0]),
        torch.full((1, 2), 2.0),
    )
    for turn in (0.0, math.pi):
        with as_on_devices():
            out = polar_sample(image, radii, azimuths + turn, center, samples=(1, 1))
        assert out[0, 0, 0, 0] == 0 and out[0, 1].isnan().all()


def test_they_have_no_derivatives_but_those_of_backward():
    grid = make_lens(1, (8, 8), 4, 8)
    image, qkv, bias = (
        torch.randn(1, 3, 8, 8),
        torch.randn(1, 2, 4, 3, 1, 4),
        torch.randn(1, 1, 1, 7),
    )
    calls = (
        (lambda x: polar_sample(x, *grid, samples=(2, 2)), image),
        (lambda x: polar_embed(x, *grid, torch.ones(5, 12), samples=(2, 2)), image),
        (lambda x: window_attention(x, bias, window=(1, 4)), qkv),
    )
    with as_on_devices():
        for run, x in calls:
            with pytest.raises(NotImplementedError, match="use_reference"):
                torch.func.jvp(run, (x,), (torch.ones_like(x),))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("jitter", [0.0, 1.0])
@pytest.mark.parametrize("rows", [1, 6])
@pytest.mark.parametrize("spoiled", ["radii", "azimuths", "center", "affine", "offsets"])
def test_points_at_nan_or_infinity_sample_nothing(spoiled, rows, jitter, bad):
    radii, azimuths, center = make_lens(2, (20, 24), rows, 8, f64)
    given = dict(
        image=torch.randn(2, 3, 20, 24, dtype=f64), radii=radii * 0.5, center=center,
        affine=torch.eye(2, dtype=f64) + 0.1 * torch.randn(2, 2, 2, dtype=f64),
        offsets=torch.randn(2, 2, rows, 8, dtype=f64),
    )  # fmt: skip
    (azimuths if spoiled == "azimuths" else given[spoiled]).view(-1)[0] = bad
    circular = [name for name in given if name not in ("affine", "offsets")]
    for names in (circular, list(given)) if spoiled in (*circular, "azimuths") else (list(given),):

        def run(*tensors, names=names):
            lens = dict(zip(names, tensors, strict=True))
            return polar_sample(
                azimuths=azimuths, **lens, samples=(1, 1), jitter=jitter, seed=4, layout="image"
            )

        tensors = [given[name] for name in names]
        expected = with_reference(run, tensors)
        with as_on_devices():
            ours = with_gradients(run, tensors)
        for got, want in zip(ours, expected, strict=True):
            assert got.isfinite().all()
            torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-9)
        assert (ours[0][0, :, 0, 0] == 0).all() and ours[0][1, :, 0, 1].all()


def on_kernels(run, operator="window_attention", installed=True, capability=(8, 0)):
    """Whether a call on a CUDA device runs a kernel, with fake tensors and a fake twin."""
    with (
        mock.patch.object(triton, "INSTALLED", installed),
        mock.patch.object(torch.cuda, "get_device_capability", return_value=capability),
        mock.patch.object(_devices, operator) as twin,
        FakeTensorMode(),
    ):
        run()
    return not twin.called


def attend(window=(1, 16), head_dim=32, dtype=torch.float32):
    qkv = torch.empty(2, window[0], window[1], 3, 2, head_dim, device="cuda", dtype=dtype)
    table = (1, 2, 2 * window[0] - 1, 2 * window[1] - 1)
    bias = torch.empty(table, device="cuda", dtype=f64 if dtype == f64 else torch.float32)
    window_attention(qkv, bias, window=window)


def sample(operator, dtype=torch.float32, channels=3, size=8):
    real = f64 if dtype == f64 else torch.float32
    lens = (torch.empty(shape, device="cuda", dtype=real) for shape in ((1, 4), (8,), (1, 2)))
    image = torch.empty(2, channels, size, size, device="cuda", dtype=dtype)
    if operator == "polar_sample":
        polar_sample(image, *lens, samples=(2, 2), jitter=1.0, channels_last=False)
    else:
        weight = torch.empty(5, 4 * channels, device="cuda", dtype=real)
        polar_embed(image, *lens, weight, samples=(2, 2), channels_last=False)


@pytest.mark.parametrize("operator", ["polar_sample", "polar_embed"])
def test_a_cuda_device_samples_by_kernels_and_by_torch_what_they_do_not_take(operator):
    def kernels(installed=True, **options):
        return on_kernels(lambda: sample(operator, **options), operator, installed)

    for dtype in (torch.float32, torch.bfloat16, torch.uint8):
        assert kernels(dtype=dtype)
    assert kernels(channels=300) and kernels(dtype=torch.uint8, channels=16)
    assert not kernels(dtype=torch.uint8, channels=17)
    assert not kernels(dtype=f64)
    assert not kernels(size=50_000)
    assert not kernels(installed=False)


def test_a_cuda_device_runs_the_kernels_and_torch_what_they_do_not_take():
    for dtype in (torch.float32, torch.bfloat16, torch.float16):
        assert on_kernels(lambda dtype=dtype: attend(dtype=dtype))
    assert on_kernels(lambda: attend((8, 8), head_dim=32))
    assert on_kernels(lambda: attend((1, 1), head_dim=1))
    assert not on_kernels(lambda: attend((5, 13), head_dim=16))
    assert not on_kernels(lambda: attend((8, 8), head_dim=33))
    assert not on_kernels(lambda: attend((1, 1), head_dim=129))
    assert not on_kernels(lambda: attend(dtype=f64))
    assert not on_kernels(attend, capability=(7, 5))
    with mock.patch.object(torch.compiler, "is_exporting", return_value=True):
        assert not on_kernels(attend)  # what is exported runs without this package


def test_without_triton_a_cuda_device_runs_torch():
    assert not on_kernels(attend, installed=False)
    with pytest.raises(TypeError, match=r"got torch.float16"):
        on_kernels(lambda: attend(dtype=torch.float16), installed=False)


def test_the_kernels_are_imported_by_the_first_call_alone():
    code = (
        "import sys, torch, darswin\n"
        "from darswin.ops import triton\n"
        "assert not any(name.startswith('darswin.ops.triton.') for name in sys.modules)\n"
        "for name in triton.LAUNCHERS:\n"
        "    there = torch._C._dispatch_has_kernel_for_dispatch_key(f'darswin::{name}', 'CUDA')\n"
        "    assert there == triton.INSTALLED\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
