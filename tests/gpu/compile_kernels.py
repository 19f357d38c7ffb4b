"""Compiles the kernels for GPUs, without one, as the launchers ask for them.

Prints what each takes, and fails where a kernel has too few registers for its numbers, or more
shared memory than a GPU has. `make test-triton` runs it; triton must be there, and not interpret.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

from darswin.ops.triton import launcher

# Bytes of shared memory that a program may have, by compute capability.
SHARED_MEMORY = {80: 163 * 1024, 90: 227 * 1024}
CUOBJDUMP = Path(triton.__file__).parent / "backends/nvidia/bin/cuobjdump"


class Use(NamedTuple):
    """What a kernel takes: 32-bit registers a thread, bytes of memory of a thread's own, to which
    the compiler resorts for want of registers, bytes of shared memory a program, and threads."""

    kernel: str
    registers: int
    stack: int
    shared: int
    threads: int


class _NoDevice:
    """In the place of Triton's driver: a GPU of some capability, which is only compiled for."""

    def __init__(self, capability: int):
        self.target = GPUTarget("cuda", capability, 32)

    def get_current_target(self) -> GPUTarget:
        return self.target

    def get_current_device(self) -> int:
        return self.target.arch

    def get_current_stream(self, device: int) -> int:
        return 0


def compiled(capability: int, call: Callable[[], object]) -> Iterator[Use]:
    """The kernels that a call launches, compiled instead. Its tensors are on the device "meta"."""
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
        yield Use(
            kernel.metadata.name.strip("_"), int(use["REG"]), int(use["STACK"]) + int(use["LOCAL"]),
            kernel.metadata.shared, 32 * kernel.metadata.num_warps,
        )  # fmt: skip


# ------------------------------------------------------------------------- what the models ask for

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
# (R, A), heads and window of the stages of DarSwin-A and -RA, and windows of Swin.
ATTENTION = {
    "A, stages 1, 2: 1×16": ((16, 64), 3, (1, 16)),
    "A, stage 3; RA, 1 to 3: 4×4": ((16, 64), 3, (4, 4)),
    "A, stage 4: 16×1": ((16, 1), 24, (16, 1)),
    "RA, stage 4: 2×8": ((2, 8), 24, (2, 8)),
    "Swin: 7×7": ((56, 56), 3, (7, 7)),
    "Swin: 8×8": ((64, 64), 3, (8, 8)),
}  # the head dim is 32


def attend(case: str, dtype: torch.dtype) -> None:
    """A forward and a backward of attention."""
    size, heads, window = ATTENTION[case]
    qkv = torch.empty(32, *size, 3, heads, 32, dtype=dtype, device="meta")
    bias = torch.empty(32, heads, 2 * window[0] - 1, 2 * window[1] - 1, device="meta")
    call = (qkv, bias, window, (0, 0), (0, 1), 0.2)
    out = launcher("window_attention")(*call)
    launcher("window_attention_backward")(*call, out)


CALLS: dict[str, Callable[[], object]] = {
    f"{case}, {name}": lambda case=case, dtype=dtype: attend(case, dtype)
    for case in ATTENTION
    for name, dtype in DTYPES.items()
}


def main() -> None:
    """Prints the table; what breaks a limit is the exit status."""
    broken = []
    print(
        "| call | kernel | threads | registers, sm_80 | sm_90 | shared memory (kB), sm_80 | sm_90 |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, call in CALLS.items():
        columns = [list(compiled(capability, call)) for capability in SHARED_MEMORY]
        for uses in zip(*columns, strict=True):
            registers = " | ".join(str(use.registers) for use in uses)
            shared = " | ".join(f"{use.shared / 1024:.0f}" for use in uses)
            print(f"| {name} | {uses[0].kernel} | {uses[0].threads} | {registers} | {shared} |")
            for use, (capability, most) in zip(uses, SHARED_MEMORY.items(), strict=True):
                if use.stack or use.shared > most:
                    broken.append(f"{name}: {use} on sm_{capability}")
    sys.exit("\n".join(broken) or 0)


if __name__ == "__main__":
    main()
