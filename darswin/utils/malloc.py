"""Settings of glibc's malloc: keep freed memory for the process, or give it back to the system."""

import ctypes
from collections.abc import Callable

__all__ = ["keep_freed_memory"]

# Of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4


def keep_freed_memory() -> bool:
    """Makes this process keep the memory that it frees, to use it again.

    Else glibc gives much of what a step of training frees back to the system, and the next step
    waits for the same pages to be found and zeroed: tens of thousands, a fifth of its time. The
    process then holds what it needed at its peak until it ends. Call it before the first step;
    `darswin fit` and `darswin bench` do.

    Returns:
        True if there is a glibc.
    """
    mallopt = _function("mallopt")
    if mallopt is None:
        return False
    # Neither the heap's end nor large blocks, which else have mappings of their own.
    return bool(mallopt(_TRIM_THRESHOLD, -1) and mallopt(_MMAP_MAX, 0))


def give_back_memory() -> None:
    """Makes glibc give back to the system what is free now."""
    malloc_trim = _function("malloc_trim")
    if malloc_trim is not None:
        malloc_trim(0)


def _function(name: str) -> Callable[..., int] | None:
    try:
        return getattr(ctypes.CDLL(None), name, None)
    except (OSError, TypeError):  # no library without a name, as on Windows
        return None
