"""The compiled module, `libdarswin.so`: loads its operators into torch, and asks for its facts.

It holds nothing of Python, so that one file serves every version; its facts are C functions.
"""

import ctypes
import json
from pathlib import Path

import torch  # before the module: both must share the libgomp that torch loads

FILE = Path(__file__).parent.parent / "libdarswin.so"


def load() -> ctypes.CDLL:
    """Loads `FILE`; its ImportError says what was tried and how to rebuild."""
    checkout = FILE.parent.parent
    if not FILE.exists() and (checkout / "setup.py").exists():
        raise ImportError(
            f"Python imports darswin from its source code in {checkout}, which has no compiled "
            "module. Build it with `make build` or `pip install --no-build-isolation -e .`, or "
            "start Python in another folder to import an installed package."
        )
    try:
        torch.ops.load_library(FILE)
    except OSError as error:
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
    module.darswin_set_gathers.argtypes = [ctypes.c_int]
    module.darswin_set_gathers.restype = None
    return module


def cpu_capability() -> str:
    """The instruction-set tier that the operators run on: "generic", "avx2" or "avx512".

    It is the best one of this CPU; ATEN_CPU_CAPABILITY (default, avx2, avx512) lowers it, as it
    does in torch.
    """
    return _loaded.darswin_tier().decode()


def tiers() -> list[str]:
    """The tiers that this CPU and this build offer, from low to high."""
    return _loaded.darswin_tiers().decode().split()


def set_tier(tier: str) -> None:
    """Runs the operators on another tier from now on. Raises ValueError if the CPU lacks it."""
    if not _loaded.darswin_set_tier(tier.encode()):
        raise ValueError(
            f"tier must be one that this CPU and build offer (best: {tiers()[-1]!r}), got {tier!r}"
        )


def set_gathers(way: bool | None) -> None:
    """Reads large gray or RGB images with gathers or without; None: as is faster on this CPU.

    None is the default. The results are the same. Only the AVX-512 tier has gathers.
    """
    _loaded.darswin_set_gathers(2 if way is None else int(way))


def build_info() -> dict[str, str | int]:
    """Facts of the module's build: compiler, cxx_standard, openmp, torch_abi."""
    return json.loads(_loaded.darswin_build_info())


_loaded = load()
