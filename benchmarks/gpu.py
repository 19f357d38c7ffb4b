"""The operators and darswin_a_small on a CUDA device, compared with code that users write instead.

`make bench-gpu`, or `python benchmarks/gpu.py [--batch 128]`. Times are medians by CUDA events, in
milliseconds. The second-level cache is flushed before each call. Outputs are compared before the
timing, and ratios are printed with their targets. Without a CUDA device, it ends with a message.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import attention
import sampling
import to_image
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.attention.flex_attention import flex_attention

from darswin.bench.candidates import lens_of, network
from darswin.bench.timing import OURS
from darswin.ops import polar_sample, polar_to_image, use_reference, window_attention

CASES = ("A stage 1", "A stage 3", "RA stage 1", "Swin 8x8")
Runs = dict[str, Callable[..., Tensor]]
Step = Callable[[], list[Tensor]]


class Peers(attention.Peers):
    """The peers on the CPU, on a device, and FlexAttention."""

    def __init__(self, case: str, batch: int, device: torch.device):
        super().__init__(case, batch, slices=True)
        self.hidden = None if self.hidden is None else self.hidden.to(device)

    def flex(self, qkv: Tensor, bias: Tensor) -> Tensor:
        q, k, v = (t.flatten(0, 2) for t in self.partition(qkv))
        mask = self.mask(bias, torch.float32).flatten(0, 2)
        windows = len(mask)

        def score(logit: Tensor, window: Tensor, head: Tensor, i: Tensor, j: Tensor) -> Tensor:
            return logit + mask[window % windows, head, i, j]

        return self.reverse(self.attend(q, k, v, score_mod=score))

    attend = staticmethod(flex_attention)


def attention_runs(case: str, batch: int, device: torch.device) -> tuple[Runs, tuple[int, ...]]:
    """The candidates, functions of (qkv, bias), and the shape of qkv."""
    (rings, sectors, heads), window, shift, periodic = attention.ATTENTION[case]
    peers = Peers(case, batch, device)

    def ours(qkv: Tensor, bias: Tensor) -> Tensor:
        return window_attention(qkv, bias, window=window, shift=shift, periodic=periodic)

    runs = {OURS: ours, "eager": peers.eager, "F.sdpa": peers.sdpa, "flex": peers.flex}
    return runs, (batch, rings, sectors, 3, heads, attention.HEAD_DIM)


def medians(runs: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Milliseconds per call, by candidate."""
    from triton.testing import do_bench

    return {name: do_bench(run, return_mode="median") for name, run in runs.items()}


def check(results: Mapping[str, list[Tensor]], tolerance: float) -> None:
    """AssertionError unless all candidates agree with ours."""
    for name, result in results.items():
        for got, want in zip(result, results[OURS], strict=True):
            size = want.abs().max().item()
            torch.testing.assert_close(
                got.float(), want.float(), rtol=tolerance, atol=tolerance * size, msg=name
            )


def report(label: str, times: Mapping[str, float], targets: Mapping[str, float]) -> None:
    """Prints our time in a case, and the ratios of the others. The target "best" is for the fastest
    of the peers without their own target."""
    ours = times[OURS]
    rest = {name: time / ours for name, time in times.items() if name != OURS}
    best = min((name for name in rest if name not in targets), key=rest.__getitem__, default="")
    words = []
    for name, ratio in rest.items():
        least = targets.get(name, targets.get("best") if name == best else None)
        missed = " MISSED" if least is not None and ratio < least else ""
        words.append(f"{name} {ratio:.2f}×" + (f" (target {least}×{missed})" if least else ""))
    print(f"{label}: {ours:.3f} ms; " + ", ".join(words), flush=True)


def with_gradients(run: Callable[..., Tensor], inputs: Sequence[Tensor]) -> Step:
    """A function that runs, backpropagates ones, and returns output and gradients."""
    leaves = [t.detach().requires_grad_() for t in inputs]
    ones = torch.ones_like(run(*leaves))

    def step() -> list[Tensor]:
        out = run(*leaves)
        return [out.detach(), *torch.autograd.grad(out, leaves, ones)]

    return step


def compare(
    label: str,
    runs: Runs,
    inputs: Sequence[Tensor],
    forward: Mapping[str, float],
    backward: Mapping[str, float],
) -> None:
    """Checks that candidates agree, times them forward, and forward and backward, and reports."""
    steps = {name: with_gradients(run, inputs) for name, run in runs.items()}
    check({name: step() for name, step in steps.items()}, 3e-2)
    with torch.no_grad():
        calls = {name: partial(run, *inputs) for name, run in runs.items()}
        report(f"{label}, forward", medians(calls), forward)
    report(f"{label}, forward+backward", medians(steps), backward)


def bench_attention(batch: int, device: torch.device) -> None:
    """Attention of some stages, and of Swin."""
    Peers.attend = staticmethod(torch.compile(flex_attention, dynamic=False))
    for case in CASES:
        for dtype in (torch.float32, torch.bfloat16):
            runs, shape = attention_runs(case, batch, device)
            window = attention.ATTENTION[case][1]
            table = (1, shape[4], 2 * window[0] - 1, 2 * window[1] - 1)
            inputs = torch.randn(shape, device=device).to(dtype), torch.randn(table, device=device)
            label = f"attention, {case}, batch {batch}, {str(dtype).removeprefix('torch.')}"
            compare(label, runs, inputs, {"eager": 4, "best": 2}, {"eager": 3})


def bench_sampling(batch: int, device: torch.device) -> None:
    """Sampling, compared with F.grid_sample on a prepared mesh and the permute to tokens."""
    for size in (64, 256):
        runs, images = sampling_runs(size, batch, device)
        peer, case = {"F.grid_sample + permute": 4}, f"{size}×{size}, batch {batch}"
        compare(f"polar_sample, {case}", runs, [images], peer, {})


def sampling_runs(size: int, batch: int, device: torch.device) -> tuple[Runs, Tensor]:
    """The candidates, functions of images, and the images."""
    images, grid, mesh, _ = sampling.sampling_case(size, batch)
    arguments = [t.to(device) for t in (grid.radii, grid.azimuths, grid.center)]
    mesh = mesh.to(device)

    def ours(image: Tensor) -> Tensor:
        return polar_sample(image, *arguments, samples=(10, 10))

    def peer(image: Tensor) -> Tensor:
        return sampling.to_tokens(F.grid_sample(image, mesh, align_corners=True))

    return {OURS: ours, "F.grid_sample + permute": peer}, images.to(device)


def bench_to_image(device: torch.device) -> None:
    """A map as an image, compared with a padded F.grid_sample on a prepared mesh."""
    for sizes in to_image.CASES:
        batch, rings, sectors, channels, size = sizes
        runs, maps = to_image_runs(sizes, device)
        case = f"{rings}×{sectors}×{channels} → {size}×{size}, batch {batch}"
        compare(f"polar_to_image, {case}", runs, [maps], {}, {})


def to_image_runs(
    sizes: tuple[int, int, int, int, int], device: torch.device
) -> tuple[Runs, Tensor]:
    """The candidates, functions of maps, and the maps."""
    maps, radii, center, places = (tensor.to(device) for tensor in to_image.inputs(*sizes))

    def ours(maps: Tensor) -> Tensor:
        return polar_to_image(maps, radii, center, (sizes[-1], sizes[-1]), layout="image")

    return {OURS: ours, to_image.PEER: partial(to_image.padded, places=places)}, maps


def bench_model(batch: int, device: torch.device) -> None:
    """darswin_a_small in bfloat16: inference, also as a CUDA graph, and a training step."""
    model, view = network("darswin_a_small", 64).to(device).eval(), lens_of(64).to(device)
    images = torch.randn(batch, 3, 64, 64, device=device)

    @torch.autocast("cuda", torch.bfloat16)
    def ours() -> Tensor:
        return model(images, view)

    def reference(run: Callable[[], Tensor] = ours) -> Tensor:
        with use_reference():
            return run()

    def step() -> Tensor:
        model.zero_grad()
        loss = ours().float().square().mean()
        loss.backward()
        return loss

    label = f"darswin_a_small, batch {batch}, bfloat16"
    with torch.no_grad():
        check({OURS: [ours()], "reference": [reference()]}, 5e-2)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            ours()
        report(label + ", inference", medians({OURS: ours, "reference": reference}),
               {"reference": 2})  # fmt: skip
        report(label + ", inference as a CUDA graph",
               medians({OURS: graph.replay, "reference": reference}), {"reference": 3})  # fmt: skip
    steps = {OURS: step, "reference": partial(reference, step)}
    report(label + ", training", medians(steps), {"reference": 1.5})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=128)
    batch = parser.parse_args().batch
    if not torch.cuda.is_available():
        print("no CUDA device: nothing is measured")
        return
    torch.manual_seed(0)
    device = torch.device("cuda")
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}")
    bench_attention(batch, device)
    bench_sampling(batch, device)
    bench_to_image(device)
    bench_model(batch, device)


if __name__ == "__main__":
    main()
