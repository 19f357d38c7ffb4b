"""Sizes and counts in messages, each in one form everywhere."""

from collections.abc import Sequence
from typing import Any


def counted(count: int, noun: str) -> str:
    """A count with its noun: "1 picture", "1,200 pictures", "2 boxes", "3 classes"."""
    ending = "" if count == 1 else "es" if noun.endswith(("s", "x")) else "s"
    return f"{count:,} {noun}{ending}"


def in_px(size: Sequence[Any]) -> str:
    """A picture's (H, W), in the order of all options and arguments: "480 × 640 px (H × W)"."""
    height, width = (round(float(side)) for side in size)
    return f"{height} × {width} px (H × W)"
