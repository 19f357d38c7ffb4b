"""Compiles the GPU kernels of the launchers on a machine without a GPU.

It prints the resources of each kernel. It fails if a kernel spills registers to the stack or needs
more shared memory than a GPU has. `make test-triton` runs it. It needs triton with the interpreter
turned off.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

from darswin.ops._sampling import checked_sampling
from darswin.ops.triton import launcher

# Bytes of shared memory that a program may have, by compute capability.
SHARED_MEMORY = {80: 163 * 1024, 90: 227 * 1024}
CUOBJDUMP = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"


class _NoDevice:
    """Replaces Triton's driver by a GPU of the given capability that can only be compiled for."""

    def __init__(self, capability: int):
        self.target = GPUTarget("cuda", capability, 32)

    def get_current_target(self) -> GPUTarget:
        return self.target

    def get_current_device(self) -> int:
        return self.target.arch

    def get_current_stream(self, device: int) -> int:
        return 0


def compiled(capability: int, call: Callable[[], object]) -> Iterator[dict[str, Any]]:
    """Compiles each kernel that a call would launch, with the call's tensors on the device "meta".
    Yields the kernel's name, its threads, registers per thread, stack for spilled registers in
    bytes, and shared memory per program in bytes."""
    kernels, run = [], JITFunction.run

    def compile_only(self, *arguments, grid, warmup, **options):
        kernels.append(run(self, *arguments, grid=grid, warmup=True, **options))

    driver.set_active(_NoDevice(capability))
    with mock.patch.object(JITFunction, "run", compile_only):
        call()
    for kernel in kernels:
        with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
            file.write(kernel.asm["cubin"])
            file.flush()
            command = [CUOBJDUMP, "--dump-resource-usage", file.name]
            said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        use = dict(re.findall(r"(REG|STACK|LOCAL):(\d+)", said))
        yield dict(
            kernel=kernel.metadata.name.strip("_"), threads=32 * kernel.metadata.num_warps,
            registers=int(use["REG"]), stack=int(use["STACK"]) + int(use["LOCAL"]),
            shared=kernel.metadata.shared,
        )  # fmt: skip


# -- calls of the models ---------------------------------------------------------------------------

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
# (R, A), heads and window of the stages of DarSwin-A, DarSwin-RA and Swin.
ATTENTION = {
    "A, stages 1, 2: 1×16": ((16, 64), 3, (1, 16)),
    "A, stage 3; RA, 1 to 3: 4×4": ((16, 64), 3, (4, 4)),
    "A, stage 4: 16×1": ((16, 1), 24, (16, 1)),
    "RA, stage 4: 2×8": ((2, 8), 24, (2, 8)),
    "Swin: 7×7": ((56, 56), 3, (7, 7)),
    "Swin: 8×8": ((64, 64), 3, (8, 8)),
}  # the head dim is 32


# (R, A) and samples of the presets' patches, which have three channels.
PATCHES = {
    "small, tiny: 10×10": ((16, 64), (10, 10)),
    "micro: 6×6": ((16, 64), (6, 6)),
    "nano: 4×4": ((8, 32), (4, 4)),
    "U-Net, nano: 4×4": ((16, 64), (4, 4)),
}


def meta(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.empty(shape, dtype=dtype, device="meta")


# Each of these functions calls a forward and a backward.


def attend(case: str, dtype: torch.dtype) -> None:
    size, heads, window = ATTENTION[case]
    qkv = meta(32, *size, 3, heads, 32, dtype=dtype)
    bias = meta(32, heads, 2 * window[0] - 1, 2 * window[1] - 1)
    call = (qkv, bias, window, (0, 0), (0, 1), 0.2)
    out = launcher("window_attention")(*call)
    launcher("window_attention_backward")(*call, out)


def sample(
    case: str, dtype: torch.dtype, jitter: float = 0, general: bool = False, tokens: bool = True,
    channels: int = 3, size: int = 64,
) -> None:  # fmt: skip
    (rings, sectors), (along, around) = PATCHES[case]
    rows, columns = rings * along, sectors * around
    sampling = checked_sampling(
        meta(32, channels, size, size, dtype=dtype), meta(32, rows), meta(columns), meta(32, 2),
        meta(32, 2, 2) if general else None, meta(32, 2, rows, columns) if general else None,
        jitter, 5, (along, around), 0.5, 0.5, False,
    )  # fmt: skip
    out = launcher("polar_sample")(*sampling, tokens)
    wanted = dtype != torch.uint8, True, general
    launcher("polar_sample_backward")(*sampling, tokens, out, *wanted)


def bring_back(
    channels: int, dtype: torch.dtype, lens: str = "circular", tokens: bool = True
) -> None:
    points = meta(32, 64, 64, 2) if lens == "points" else None
    affine = meta(32, 2, 2) if lens == "affine" else None
    center = None if lens == "points" else meta(32, 2)
    plane = center, affine, points, meta(32)
    call = (meta(32, 64, 256, channels, dtype=dtype), meta(32, 64), *plane, (64, 64), tokens, None)
    out = launcher("polar_to_image")(*call)
    launcher("polar_to_image_backward")(*call, out, True, True)


SMALL, f32 = "small, tiny: 10×10", torch.float32
CALLS = {
    **{f"{case}, {name}": partial(sample, case, dtype)
       for case in PATCHES for name, dtype in DTYPES.items() if name != "float16"},
    f"{SMALL}, jitter": partial(sample, SMALL, f32, jitter=1.0),
    f"{SMALL}, jitter, any lens": partial(sample, SMALL, f32, 1.0, general=True),
    f"{SMALL}, uint8": partial(sample, SMALL, torch.uint8),
    f"{SMALL}, as an image": partial(sample, SMALL, f32, tokens=False),
    f"{SMALL}, one channel": partial(sample, SMALL, f32, channels=1),
    f"{SMALL}, 96 channels of one pixel": partial(sample, SMALL, f32, channels=96, size=1),
    **{f"map to image, {channels} channels, {name}": partial(bring_back, channels, dtype)
       for channels in (1, 10, 96) for name, dtype in DTYPES.items()},
    "map to image, affine": partial(bring_back, 10, f32, "affine"),
    "map to image, any lens": partial(bring_back, 10, f32, "points"),
    "map to image, planes": partial(bring_back, 96, f32, tokens=False),
    **{f"{case}, {name}": partial(attend, case, dtype)
       for case in ATTENTION for name, dtype in DTYPES.items()},
}  # fmt: skip


def main() -> None:
    """Prints the table, and exits with the kernels that break a limit."""
    broken = []
    print(
        "| call | kernel | threads | registers, sm_80 | sm_90 | shared memory (kB), sm_80 | sm_90 |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, call in CALLS.items():
        columns = [list(compiled(capability, call)) for capability in SHARED_MEMORY]
        for uses in zip(*columns, strict=True):
            kernel, threads = uses[0]["kernel"], uses[0]["threads"]
            registers = " | ".join(str(use["registers"]) for use in uses)
            shared = " | ".join(f"{use['shared'] / 1024:.0f}" for use in uses)
            print(f"| {name} | {kernel} | {threads} | {registers} | {shared} |")
            for use, (capability, most) in zip(uses, SHARED_MEMORY.items(), strict=True):
                if use["stack"] or use["shared"] > most:
                    broken.append(f"{name}: {use} on sm_{capability}")
    sys.exit("\n".join(broken) or 0)


if __name__ == "__main__":
    main()
