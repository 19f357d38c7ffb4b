"""Named calls of the operators, at sizes for which the kernels take different paths, and functions
that compare results. strategies.py draws random calls."""

import functools
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from darswin.ops import (
    polar_sample,
    polar_to_image,
    polar_to_image_plan,
    reference,
    use_reference,
    window_attention,
)

f32, f64, bf16 = torch.float32, torch.float64, torch.bfloat16
# Numbers of threads that must give the same bits; the sanitizers run more of them.
THREADS = [int(count) for count in os.environ.get("DARSWIN_TEST_THREADS", "1,3").split(",")]


@dataclass
class Case:
    """One call: `run(**inputs)` is differentiable in every input."""

    run: Callable[..., Tensor]
    inputs: dict[str, Tensor]
    # float64 inputs → a factor for the gradient of the output: 0 where the gradient jumps.
    mask: Callable[..., Tensor] | None = None
    settings: dict = field(default_factory=dict)

    def __repr__(self):
        shapes = {name: (tuple(t.shape), t.stride()) for name, t in self.inputs.items()}
        dtype = next(iter(self.inputs.values())).dtype
        return f"{dtype} {shapes} {self.settings}"

    def replace(self, **inputs: Tensor) -> "Case":
        return Case(self.run, self.inputs | inputs, self.mask, self.settings)

    def to(self, to: torch.dtype | torch.device) -> "Case":
        return self.replace(**{name: t.to(to) for name, t in self.inputs.items()})

    def first_image(self) -> "Case":
        """The call for the first image of the batch alone."""
        layer = ("weight", "bias") if "weight" in self.inputs else ()
        return self.replace(**{name: t[:1] for name, t in self.inputs.items() if name not in layer})

    def smooth(self) -> Tensor:
        """The mask for the inputs of this call."""
        return self.mask(**{name: t.detach().cpu().double() for name, t in self.inputs.items()})


# -- comparing results -----------------------------------------------------------------------------


def results(
    case: Case,
    *,
    is_reference: bool = False,
    masked: bool = True,
    absolute: Sequence[str] = (),
    only: Sequence[str] = (),
) -> dict[str, Tensor]:
    """The output, a random gradient of it, and the gradients of all inputs or of those in `only`.

    The inputs in `absolute` are replaced by their absolute values, and then the gradient is too.
    Then no terms cancel, and each result bounds the numbers that are added up for it.
    """
    leaves = {
        name: (t.abs() if name in absolute else t.detach()) for name, t in case.inputs.items()
    }
    wanted = [leaves[name].requires_grad_() for name in only or leaves]
    with use_reference(is_reference):
        out = case.run(**leaves)
    grad = torch.randn(out.shape, generator=torch.Generator().manual_seed(7), dtype=f64)
    if masked and case.mask is not None:
        grad = grad * case.smooth()
    grad = (grad.abs() if absolute else grad).to(out)
    grads = torch.autograd.grad(out, wanted, grad, materialize_grads=True)
    return dict(out=out.detach(), grad=grad, **dict(zip(only or leaves, grads, strict=True)))


def assert_equal_results(ours: dict[str, Tensor], others: dict[str, Tensor], tolerance: float = 0):
    """Asserts that ours equal `others`, up to a tolerance relative to the largest value."""
    for name, want in others.items():
        size = want.nan_to_num(0, 0, 0).abs().max().item() if want.numel() else 0.0
        torch.testing.assert_close(
            ours[name], want, rtol=tolerance, atol=tolerance * (1 + size) if tolerance else 0,
            equal_nan=True, msg=lambda text, name=name: f"{name}: {text}",
        )  # fmt: skip


def assert_same_bits_on_any_number_of_threads(
    run: Callable[[], dict[str, Tensor]], counts: Sequence[int] = THREADS
) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(counts[0])
        alone = run()
        for count in counts[1:]:
            torch.set_num_threads(count)
            assert_equal_results(run(), alone)
    finally:
        torch.set_num_threads(before)


def assert_accurate(
    make: Callable[[], Case], draws: int = 3, device: torch.device | str = "cpu"
) -> float:
    """The accuracy rule: against the float64 reference, the error of the float32 operator on the
    device is at most twice the error of the float32 reference on the CPU, for the output and for
    each gradient. Returns the largest share of the allowed error.

    An error is the largest absolute difference over all draws of `make`, since a single small
    tensor has too few numbers to measure rounding. An error of up to four roundings of the largest
    value is always allowed, because the reference may be exact by chance.
    """
    errors: dict[str, list[float]] = {}
    for _ in range(draws):
        case = make()
        oracle = results(case.to(f64), is_reference=True)
        baseline = results(case, is_reference=True)
        ours = results(case.to(torch.device(device)))
        for name, exact in oracle.items():
            got = ours[name].cpu()
            assert got.dtype == f32 and got.shape == exact.shape
            assert torch.equal(got.isnan(), exact.isnan()), f"{name} is NaN elsewhere"
            if exact.numel() == 0:
                continue
            rounding = torch.finfo(f32).eps * exact.abs().max()
            row = [(got - exact).abs().max(), (baseline[name] - exact).abs().max(), rounding]
            before = errors.get(name, [0.0] * 3)
            errors[name] = [max(a, b.item()) for a, b in zip(before, row, strict=True)]
    worst = 0.0
    for name, (error, base, rounding) in errors.items():
        allowed = max(2 * base, 4 * rounding)
        assert error <= allowed, f"{name}: error {error:.3g}, allowed {allowed:.3g}"
        worst = max(worst, error / (allowed or 1))
    return worst


def assert_rounded_once(
    case: Case, same_order: bool = True
) -> tuple[Case, dict[str, Tensor], dict[str, Tensor]]:
    """Asserts that with the first input in bfloat16, the output is the float32 output rounded once,
    bit for bit if the order of sums is the same. Returns the bfloat16 call, its results and the
    float32 results."""
    first, values = next(iter(case.inputs.items()))
    narrow, wide = (case.replace(**{first: t}) for t in (values.to(bf16), values.to(bf16).float()))
    ours, expected = results(narrow), results(wide)
    assert ours["out"].dtype == ours[first].dtype == bf16
    torch.testing.assert_close(ours["out"].float(), expected["out"], rtol=2**-7, atol=1e-5)
    same = (ours["out"] == expected["out"].to(bf16)).float()
    assert same.numel() == 0 or (same.all() if same_order else same.mean() > 0.99)
    return narrow, ours, expected


def elsewhere(tensor: Tensor, kind: str) -> Tensor:
    """The same values with gaps in memory, or in another order."""
    if kind == "gaps":
        return torch.stack((tensor, tensor), -1)[..., 0]
    back = list(range(tensor.dim() - 1, -1, -1))
    return tensor.permute(back).contiguous().permute(back)


class Calls(TorchDispatchMode):
    """A context that notes the calls of the public operators and their backwards."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[torch._ops.OpOverload, list]] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.namespace == "darswin" and not func.name().startswith("darswin::_"):
            self.calls.append((func, list(args)))
        return func(*args, **(kwargs or {}))


def raw_calls(case: Case) -> list[tuple[torch._ops.OpOverload, list]]:
    """The compiled operator and its backward, each with its arguments in this case."""
    with Calls() as found, torch.enable_grad():
        results(case)
    return found.calls


# -- calls -----------------------------------------------------------------------------------------


def places(radii, azimuths, center, affine, offsets, batch, jitter, seed) -> tuple[Tensor, ...]:
    """x, y and radius of the points, (B, N_r, N_a) each, in float64."""
    radii, azimuths, center = radii.double(), azimuths.double(), center.double()
    r, a = radii[:, :, None], azimuths[None, None]
    if jitter > 0 and radii.shape[1] and len(azimuths):
        amount = torch.tensor(jitter, dtype=f64)
        r, a = reference._jittered(radii, azimuths, batch, amount, torch.tensor(seed))
    x, y = r * torch.cos(a), r * torch.sin(a)
    if affine is not None:
        (xx, xy), (yx, yy) = affine.double().permute(1, 2, 0)[..., None, None]
        x, y = xx * x + xy * y, yx * x + yy * y
    x, y = center[:, 0, None, None] + x, center[:, 1, None, None] + y
    if offsets is not None:
        x, y = x + offsets[:, 0].double(), y + offsets[:, 1].double()
    shape = (batch, radii.shape[1], len(azimuths))
    return x.expand(shape), y.expand(shape), r.expand(shape)


def to_tokens(planes: Tensor, samples: tuple[int, int]) -> Tensor:
    """(B, C, R·S_r, A·S_φ) → (B, R, A, S_r·S_φ·C), with torch only."""
    batch, channels, rows, columns = planes.shape
    rings, sectors = rows // samples[0], columns // samples[1]
    parts = planes.reshape(batch, channels, rings, samples[0], sectors, samples[1])
    return parts.permute(0, 2, 4, 3, 5, 1).reshape(
        batch, rings, sectors, samples[0] * samples[1] * channels
    )


def sampling_call(
    inputs: dict[str, Tensor], azimuths: Tensor, samples: tuple[int, int], layout: str = "tokens",
    jitter: float = 0.0, seed: int = 0, **others,
) -> Case:  # fmt: skip
    """A call of polar_sample."""
    options = dict(samples=samples, jitter=jitter, seed=seed, layout=layout)
    channels = inputs["image"].shape[1]
    settings = options | dict(azimuths=azimuths)

    def run(image, radii, center, **general):
        azimuths = settings["azimuths"].to(radii)
        return polar_sample(image, radii, azimuths, center, **general, **options, **others)

    def mask(image, radii, center, affine=None, offsets=None):
        """0 where gradients jump: at borders of pixels, and where jitter clamps the radius to 0."""
        grid = (radii, settings["azimuths"], center, affine, offsets)
        x, y, r = places(*grid, len(image), jitter, seed)
        smooth = ((x - x.round()).abs() > 1e-3) & ((y - y.round()).abs() > 1e-3)
        if jitter > 0:
            smooth &= r > 1e-3
        planes = smooth[:, None].expand(-1, channels, -1, -1).to(f64)
        return planes if layout == "image" else to_tokens(planes, samples)

    return Case(run, inputs, mask, settings)


def sampling(
    batch=2, channels=3, size=(17, 23), rows=6, columns=8, samples=(3, 4), shared=False,
    affine=False, offsets=False, far=1.0, dtype=f32, **options,
) -> Case:  # fmt: skip
    """polar_sample, with points inside, on the border and outside. The matrix more than doubles
    some lengths. Offsets are about `far` px, and one in ten is about the image's size times
    larger."""
    lenses, reach = 1 if shared else batch, max(size)
    center = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=dtype)
    inputs = dict(
        image=torch.randn(batch, channels, *size, dtype=dtype),
        radii=torch.rand(lenses, rows, dtype=dtype).sort(1).values * reach * 0.7,
        center=center + torch.rand(lenses, 2, dtype=dtype),
    )
    if affine:
        inputs["affine"] = torch.eye(2, dtype=dtype) + 0.5 * torch.randn(lenses, 2, 2, dtype=dtype)
    if offsets:
        moves = far * torch.randn(lenses, 2, rows, columns, dtype=dtype)
        jumps = torch.rand(lenses, 1, rows, columns) < 0.1
        inputs["offsets"] = torch.where(jumps, moves * reach, moves)
    azimuths = (torch.arange(columns, dtype=f64) + 0.37) * (2 * math.pi / max(columns, 1))
    return sampling_call(inputs, azimuths.to(dtype), samples, **options)


def attention_call(inputs: dict[str, Tensor], **options) -> Case:
    """A call of window_attention."""
    return Case(lambda qkv, bias: window_attention(qkv, bias, **options), inputs, None, options)


def attention(
    batch=2, rings=4, sectors=8, heads=2, head_dim=5, window=(2, 4), bias_rows=1, dtype=f32,
    **options,
) -> Case:  # fmt: skip
    table = (bias_rows, heads, 2 * window[0] - 1, 2 * window[1] - 1)
    inputs = dict(qkv=torch.randn(batch, rings, sectors, 3, heads, head_dim, dtype=dtype))
    inputs["bias"] = torch.randn(table, dtype=f32 if dtype == bf16 else dtype)
    return attention_call(inputs, window=window, **options)


def on_polar_plane(size, radii=None, center=None, affine=None, points=None):
    """Radius and azimuth of the pixels, (N, H, W) each, in float64."""
    if points is None:
        y, x = (torch.arange(n, dtype=f64) for n in size)
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
        points = pixels - center[:, None, None]
        if affine is not None:
            points = torch.linalg.solve(affine[:, None, None], points[..., None])[..., 0]
    x, y = points.unbind(-1)
    return torch.hypot(x, y), torch.atan2(y, x)


def map_call(
    inputs: dict[str, Tensor], size: tuple[int, int], layout="image", planned=False, **options
) -> Case:
    """A call of polar_to_image, with or without a plan."""
    sectors = inputs["x"].shape[2]

    def run(x, radii, center=None, **lens):
        lens |= options
        plan = polar_to_image_plan(x, radii, center, size, **lens) if planned else None
        return polar_to_image(x, radii, center, size, layout=layout, plan=plan, **lens)

    def mask(x, radii, **lens):
        """0 where gradients of the lens jump: at ring centres, middles of sectors and the pole."""
        r, azimuth = on_polar_plane(size, **lens)
        column = azimuth * (sectors / (2 * math.pi)) - 0.5
        columns = torch.stack((column, column + sectors / 2))
        smooth = ((columns - columns.round()).abs() > 1e-3).all(0) & (r > 0.5)
        smooth = smooth & ((r[..., None] - radii[:, None, None]).abs() > 1e-3).all(-1)
        smooth = smooth.expand(len(x), *smooth.shape[1:]).to(f64)
        return smooth[..., None] if layout == "tokens" else smooth[:, None]

    return Case(run, inputs, mask, dict(size=size, layout=layout, **options))


def polar_map(
    batch=2, rings=4, sectors=8, channels=3, size=(19, 23), lenses=1, general=None, reach=9.0,
    dtype=f32, **options,
) -> Case:  # fmt: skip
    """polar_to_image with a circular lens, with `affine`, or with `points`."""
    rising = (torch.rand(lenses, rings, dtype=f64) + 0.3).cumsum(1) * reach / rings
    inputs = dict(x=torch.randn(batch, rings, sectors, channels, dtype=dtype))
    inputs["radii"] = rising.to(f32 if dtype == bf16 else dtype)
    middle = torch.tensor([(size[1] - 1) / 2, (size[0] - 1) / 2], dtype=f64)
    if general == "points":
        inputs["points"] = reach / 2 * torch.randn(lenses, *size, 2, dtype=f64)
    else:
        inputs["center"] = middle + 0.3 + 0.1 * torch.rand(lenses, 2, dtype=f64)
    if general == "affine":
        skew = torch.randn(lenses, 2, 2, dtype=f64).clamp(-2, 2)
        inputs["affine"] = torch.eye(2, dtype=f64) + 0.15 * skew
    lens = {name: t.to(inputs["radii"].dtype) for name, t in inputs.items() if name != "x"}
    return map_call(inputs | lens, size, **options)


# -- named cases -----------------------------------------------------------------------------------

PACKED = dict(size=(31, 33), rows=40, columns=64)
# For many tokens per block, and for tokens of a single row.
FEW = dict(size=(40, 42), rows=8, batch=1)
SAMPLING = {
    "plain": dict(),
    "shared lens": dict(batch=5, shared=True, samples=(2, 2)),
    "64 images, one lens": dict(batch=64, rows=8, columns=16, shared=True, samples=(1, 1)),
    "one ring, one sector": dict(rows=4, columns=3, samples=(4, 3)),
    "one point": dict(rows=1, columns=1, samples=(1, 1)),
    "odd rows": dict(rows=3, columns=13, samples=(1, 13)),
    "one pixel": dict(size=(1, 1), samples=(3, 2)),
    "thin image": dict(size=(1, 37), channels=1, samples=(1, 8)),
    "many channels": dict(channels=33, batch=1, samples=(2, 4)),
    "empty batch": dict(batch=0, shared=True),
    "no lenses": dict(batch=0),
    "no points": dict(rows=0),
    "no channels": dict(channels=0),
    # Cases for which csrc/kernels takes different paths.
    "cells": PACKED | dict(samples=(10, 8)),
    "cells, one channel": PACKED | dict(columns=63, channels=1, samples=(8, 3)),
    "cells, two channels": PACKED | dict(channels=2, samples=(4, 4)),
    "cells, four channels": PACKED | dict(channels=4, batch=1, samples=(4, 4)),
    "packed, six channels": PACKED | dict(channels=6, samples=(4, 4)),
    "packed, 64 channels": dict(size=(16, 17), rows=20, columns=32, channels=64, batch=1,
                                samples=(4, 4)),
    "packed, large": dict(size=(200, 180), rows=80, columns=160, batch=1, samples=(8, 8)),
    "direct": dict(size=(200, 180), rows=8, columns=16, samples=(4, 4)),
    "direct, large": dict(size=(400, 390), rows=20, columns=16, batch=1, samples=(4, 4)),
    "direct, shared": dict(size=(90, 80), rows=8, columns=15, shared=True, samples=(4, 5)),
    "many tokens": dict(size=(31, 33), rows=80, columns=640, batch=1, samples=(10, 10)),
    "long rows": dict(size=(31, 33), rows=2, columns=3001, batch=1, samples=(1, 3001)),
    "two points a token": FEW | dict(columns=600, samples=(1, 2)),
    "five points a token": FEW | dict(columns=1500, samples=(1, 5), channels=1),
    "two radii a token": FEW | dict(columns=512, samples=(2, 1), channels=4),
    "long tokens": dict(size=(31, 33), rows=60, columns=120, batch=1, samples=(60, 60)),
}  # fmt: skip
SAMPLING_WITH = {
    "circular": dict(),
    "jitter": dict(jitter=0.8, seed=3, layout="image"),
    "affine": dict(affine=True, layout="image"),
    "offsets": dict(offsets=True, jitter=0.8, seed=3),
    "general": dict(affine=True, offsets=True, jitter=0.8, seed=-5),
}
ATTENTION = {
    "DarSwin-A stage 1": dict(rings=3, sectors=64, head_dim=32, window=(1, 16), shift=(0, 4)),
    "DarSwin-A stage 2": dict(rings=3, sectors=16, head_dim=32, window=(1, 16), shift=(0, 4),
                              periodic=(False, False)),
    "DarSwin-A stage 3": dict(rings=16, sectors=4, window=(4, 4), bias_rows=2, shift=(2, 0)),
    "DarSwin-A stage 4": dict(rings=16, sectors=1, window=(16, 1), bias_rows=2, shift=(4, 0)),
    "DarSwin-RA": dict(rings=8, sectors=32, window=(4, 4), shift=(2, 2)),
    "Swin": dict(rings=8, sectors=8, window=(4, 4), shift=(2, 2), periodic=(False, False)),
    "both axes periodic": dict(shift=(3, 7), periodic=(True, True)),
    "radius periodic": dict(shift=(1, 3), periodic=(True, False)),
    "head dim 1": dict(head_dim=1, heads=3, window=(4, 2), scale=0.7),
    "head dim 33": dict(head_dim=33, shift=(1, 1)),
    "odd windows": dict(rings=9, sectors=35, window=(3, 7), bias_rows=2, shift=(2, 5)),
    "one token a window": dict(window=(1, 1), shift=(1, 1)),
    "one token": dict(rings=1, sectors=1, window=(1, 1)),
    "one window of 1024": dict(batch=1, rings=16, sectors=64, heads=1, window=(16, 64),
                               shift=(3, 0)),
    "windows without tables of pairs": dict(rings=16, sectors=18, head_dim=24, window=(8, 9),
                                            bias_rows=2, shift=(3, 4), periodic=(False, False)),
    "several chunks of windows": dict(batch=3, rings=16, sectors=32, heads=3, head_dim=8,
                                      shift=(1, 2)),
    "65 tokens": dict(batch=1, rings=1, sectors=65, heads=1, head_dim=32, window=(1, 65)),
    "empty batch": dict(batch=0),
    "no heads": dict(heads=0),
}  # fmt: skip
MAPS = {
    "small": dict(),
    "tokens": dict(channels=33, layout="tokens"),
    "a lens an image": dict(lenses=2, channels=17, r_max=8.7),
    "affine": dict(lenses=2, general="affine"),
    "points": dict(general="points", layout="tokens"),
    "one ring": dict(rings=1, sectors=16, r_max=7.3),
    "one sector": dict(sectors=1, channels=16, layout="tokens"),
    "odd sectors": dict(sectors=7, channels=40),
    "one channel": dict(channels=1, sectors=64, rings=16),
    "wide": dict(channels=20, size=(5, 150)),
    "one pixel": dict(size=(1, 1)),
    "empty batch": dict(batch=0),
    "no channels": dict(channels=0),
    "no pixels": dict(size=(0, 4)),
}

# (operator, name) → a function that makes the case in a dtype.
CASES: dict[tuple[str, str], Callable[..., Case]] = {}
for name, sizes in SAMPLING.items():
    for variant, more in SAMPLING_WITH.items():
        CASES["polar_sample", f"{name}, {variant}"] = functools.partial(sampling, **sizes, **more)
for name, sizes in ATTENTION.items():
    CASES["window_attention", name] = functools.partial(attention, **sizes)
for name, sizes in MAPS.items():
    CASES["polar_to_image", name] = functools.partial(polar_map, **sizes)


def draws_for(case: tuple[str, str]) -> int:
    """How many draws measure the rounding of a named case: more if it has few numbers. For 900 sums
    of 576 products, the largest error in three draws varies by a third."""
    return 30 if case[1].startswith("deep") else 10 if "general" in case[1] else 3


# A small case of each operator with all its inputs, and one without the optional inputs.
GRID = dict(size=(7, 8), rows=4, columns=6, samples=(2, 3))
MAP = dict(rings=3, sectors=5, channels=2, size=(5, 4), reach=3.0)
WINDOWS = dict(rings=4, sectors=4, head_dim=3, shift=(1, 2))
SMALL = {
    name: functools.partial(make, **sizes, **options)
    for name, make, sizes, options in (
        ("polar_sample", sampling, GRID, dict(affine=True, offsets=True, jitter=0.6, seed=11)),
        ("polar_sample, circular", sampling, GRID, dict(layout="image")),
        ("window_attention", attention, WINDOWS, dict()),
        ("window_attention, a bias an image", attention, WINDOWS,
         dict(periodic=(False, False), bias_rows=2, scale=0.7)),
        ("polar_to_image", polar_map, MAP,
         dict(lenses=2, general="affine", r_max=40.0, planned=True)),
        ("polar_to_image, circular", polar_map, MAP, dict(layout="tokens")),
        ("polar_to_image, points", polar_map, MAP,
         dict(lenses=2, general="points", planned=True)),
    )
}  # fmt: skip
