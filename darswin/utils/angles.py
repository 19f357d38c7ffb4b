"""Angles are in radians. An error about one that looks like degrees shows the conversion."""

import math
from typing import Any


def degrees_hint(angle: float) -> str:
    """The end of an error about an angle out of its range: what it is in radians, if it looks like
    degrees, else nothing."""
    half_turns = abs(angle) / math.pi
    # π and 2π are angles in radians, and so is what exceeds them by a little.
    near = any(abs(half_turns - n) < 0.05 * n for n in (1, 2))
    if near or not 1 < half_turns <= 360 / math.pi:
        return ""
    return f"; angles are in radians, and {angle:g}° is {math.radians(angle):.4g}"


def check_turn(name: str, angle: float) -> None:
    """Raises ValueError unless an angle by which something turns is in [-2π, 2π]."""
    if not abs(angle) <= 2 * math.pi:
        raise ValueError(f"{name} must be in [-2π, 2π] rad, got {angle}{degrees_hint(angle)}")


def unit_vector(name: str, vector: Any) -> tuple[float, float, float]:
    """The unit vector of three finite numbers that are not all 0; ValueError otherwise."""
    try:
        values = [float(x) for x in (vector.tolist() if hasattr(vector, "tolist") else vector)]
    except (TypeError, ValueError):
        values = []
    length = math.hypot(*values)
    if len(values) != 3 or not 0 < length < math.inf:
        raise ValueError(f"{name} must be three finite numbers that are not all 0, got {vector!r}")
    x, y, z = (value / length for value in values)
    return x, y, z
