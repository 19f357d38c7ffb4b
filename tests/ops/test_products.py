"""The products of 8 bits for CPUs that this machine does not have."""

import shutil
import subprocess
from pathlib import Path

import pytest

HERE = Path(__file__).parent
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64"
FLAGS = ("-std=c++20", "-O2", "-Wno-psabi", "-DTIER=neon", '-DTIER_HEADER="tiers/neon.h"')


@pytest.mark.slow
@pytest.mark.skipif(
    not (shutil.which(COMPILER) and shutil.which(EMULATOR)), reason="no emulated ARM CPU"
)
def test_sums_are_exact_on_arm(tmp_path):
    program = tmp_path / "products"
    subprocess.run([COMPILER, *FLAGS, HERE / "products.cpp", "-o", program], check=True)
    emulated = (EMULATOR, "-L", "/usr/aarch64-linux-gnu", "-cpu")
    for cpu, given in (("max", ["fours"]), ("cortex-a57", [])):  # with dot products, and without
        ran = subprocess.run([*emulated, cpu, program, *given], capture_output=True, text=True)
        assert ran.returncode == 0 and ": 0 wrong sums" in ran.stdout, ran
