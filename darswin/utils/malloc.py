"""Settings of glibc's malloc: keep freed memory, or return it to the system."""

import ctypes
from collections.abc import Callable

# Constants of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4


def keep_freed_memory() -> bool:
    """Makes this process keep freed memory for reuse.

    By default, glibc returns much of the memory of a training step to the system. In the next step
    the system must find and zero tens of thousands of pages again, which takes a fifth of the time.
    With this setting, the process keeps its peak memory until it ends. Call it before the first
    step; `darswin fit` does so.

    Returns:
        True if there is a glibc.
    """
    mallopt = _function("mallopt")
    if mallopt is None:
        return False
    # Keep the end of the heap, and allocate large blocks in the heap too.
    return bool(mallopt(_TRIM_THRESHOLD, -1) and mallopt(_MMAP_MAX, 0))


def give_back_memory() -> None:
    """Makes glibc return free memory to the system."""
    malloc_trim = _function("malloc_trim")
    if malloc_trim is not None:
        malloc_trim(0)


def _function(name: str) -> Callable[..., int] | None:
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except (OSError, TypeError):  # no library without a name, as on Windows
        return None
