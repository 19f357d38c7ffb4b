"""scikit-learn's 1797 scanned digits of 8×8 pixels."""

from pathlib import Path

import numpy as np

from darswin.data.sources import Arrays
from darswin.data.splits import Split, hold_out


def fits(path: Path) -> bool:
    """Whether a path is "digits"."""
    return str(path) == "digits"


def open_split(
    path: Path, split: Split, channels: int, names: list[str] | None, holdout: float
) -> Arrays:
    """A split; arguments as `darswin.data.open_source`."""
    from sklearn.datasets import load_digits

    digits = load_digits()
    labels = digits.target.tolist()
    parts = hold_out(labels, [str(k) for k in range(len(labels))], holdout, ("test", "val"))
    part = parts[split]
    images = np.round(digits.images[part] * (255 / 16)).astype(np.uint8)
    return Arrays(images, digits.target[part], names or [str(k) for k in range(10)], channels)
