"""Things of several cameras: a list in the order of the cameras, or a mapping from their names."""

from collections.abc import Mapping, Sequence
from typing import Any


def in_order(frames: Any, names: Sequence[str]) -> tuple[Any, ...]:
    """Frames in the order of the names.

    Raises:
        TypeError: they are no sequence and no mapping.
        ValueError: they are more or fewer than the names, or a name is missing or unknown.
    """
    if isinstance(frames, Mapping):
        for name in (*names, *frames):
            if name not in frames:
                raise ValueError(f"the frame of {name} is missing")
            if name not in names:
                raise ValueError(f"there is no camera {name!r}, only {', '.join(names)}")
        return tuple(frames[name] for name in names)
    if not isinstance(frames, Sequence):
        kind = type(frames).__name__
        raise TypeError(f"frames must be a list, or a mapping from names of cameras, got {kind}")
    if len(frames) != len(names):
        known = f"{len(names)} frames, those of {', '.join(names)}"
        raise ValueError(f"there must be {known}, got {len(frames)}")
    return tuple(frames)
