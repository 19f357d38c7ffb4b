"""Loads the operators of the compiled module `libdarswin.so` into torch and wraps its C functions.

The module does not use Python's C API, so that one file works with every Python version. Where it
cannot be loaded, `LACK` says why, and the operators run their PyTorch reference.
"""

import ctypes
import json
import multiprocessing
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from darswin.utils.elf import check_whole

FILE = Path(__file__).parent.parent / "libdarswin.so"
REFERENCE = "reference"  # the name of the only tier without the module


def load() -> ctypes.CDLL:
    """Loads `FILE`. The ImportError on failure explains the reason and how to rebuild."""
    checkout = FILE.parent.parent
    if not FILE.exists() and (checkout / "setup.py").exists():
        raise ImportError(
            f"Python imports darswin from its source code in {checkout}, which has no compiled "
            "module. Build it with `make build` or `pip install --no-build-isolation -e .`, or "
            "start Python in another folder to import an installed package."
        )
    if not FILE.exists():
        raise ImportError(
            f"the installed darswin has no compiled module, {FILE}: its wheel is the one for "
            "systems and processors without such a module"
        )
    try:
        check_whole(FILE)
        torch.ops.load_library(FILE)
    except (OSError, ImportError) as error:
        reason = error.__cause__ or error  # torch's own error only names the file
        raise ImportError(
            f"cannot load the compiled module of darswin, {FILE}: {reason}. It is built on "
            f"libtorch's stable ABI for torch>=2.10; torch {torch.__version__} is running. "
            "Rebuild it with `pip install --no-build-isolation --force-reinstall --no-deps darswin`"
            ", or in a checkout with `make build`."
        ) from error
    module = ctypes.CDLL(str(FILE))
    for function in (module.darswin_tier, module.darswin_tiers, module.darswin_build_info):
        function.restype = ctypes.c_char_p
    module.darswin_set_tier.argtypes = [ctypes.c_char_p]
    module.darswin_set_tier.restype = ctypes.c_bool
    module.darswin_cpu_is_intel.restype = ctypes.c_bool
    module.darswin_use_torch_threads.argtypes = [ctypes.c_bool]
    module.darswin_use_torch_threads.restype = None
    return module


def require(what: str) -> None:
    """Raises ImportError if `what` cannot run, because there is no compiled module."""
    if LACK is not None:
        raise ImportError(f"{what} needs the compiled module of darswin: {LACK}")


def cpu_capability() -> str:
    """The instruction-set tier that the operators run on: "generic", "avx2", "avx512" or "neon".

    By default it is the best tier of this CPU. The environment variable ATEN_CPU_CAPABILITY
    (default, avx2, avx512) lowers it, as in torch. ARM CPUs have only "neon". Where the compiled
    module cannot be loaded, it is "reference": the operators run their PyTorch reference.
    """
    return REFERENCE if _loaded is None else _loaded.darswin_tier().decode()


def tiers() -> list[str]:
    """The tiers that this CPU and this build support, from low to high."""
    return [REFERENCE] if _loaded is None else _loaded.darswin_tiers().decode().split()


def set_tier(tier: str) -> None:
    """Switches the operators to another tier. Raises ValueError if the CPU lacks it."""
    found = tier == REFERENCE if _loaded is None else _loaded.darswin_set_tier(tier.encode())
    if not found:
        raise ValueError(
            f"tier must be one that this CPU and build offer (best: {tiers()[-1]!r}), got {tier!r}"
        )


BYTE_PRODUCTS = ("pairs", "fours", "tiles")  # from slow to fast


def byte_products(most: str | None = None) -> str:
    """How 8-bit layers multiply, after an optional limit. The results are the same.

    "pairs": as numbers of 16 bits. "fours": by an instruction for four bytes, such as VNNI.
    "tiles": by AMX, the limit at first. The CPU, the system and the tier may lack the last two.
    """
    limit = -1 if most is None else BYTE_PRODUCTS.index(most)
    return BYTE_PRODUCTS[0 if _loaded is None else _loaded.darswin_byte_products(limit)]


def is_fast_beside_mkl() -> bool:
    """Whether our products in float32 are at least as fast as those of MKL."""
    fast = cpu_capability() in ("avx2", "avx512")
    return _loaded is not None and fast and not _loaded.darswin_cpu_is_intel()


def torch_threads_switch() -> Callable[[bool], None]:
    """The module's own function that says whether calls of this thread use the threads of torch, as
    they should in training. It is called in each recorded call, where Python would take longer."""
    assert _loaded is not None
    return _loaded.darswin_use_torch_threads


def build_info() -> dict[str, str | int]:
    """Facts about the module's build: compiler, cxx_standard, torch_abi."""
    return {"compiler": "none"} if _loaded is None else json.loads(_loaded.darswin_build_info())


_loaded: ctypes.CDLL | None = None
LACK: str | None = None
try:
    _loaded = load()
except ImportError as error:
    LACK = str(error)
    if multiprocessing.parent_process() is None:  # else the parent has said so
        warnings.warn(
            f"{LACK.removesuffix('.')}. The operators now run their PyTorch reference, which gives "
            "the same results but is slower. `darswin.optimize` and `darswin.frames` need the "
            "compiled modules.",
            RuntimeWarning,
            stacklevel=2,
        )
