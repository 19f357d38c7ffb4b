"""The lenses for views of the worlds, by their names."""

import math
from pathlib import Path

import numpy as np

from darswin.data.lens_distributions import parse_lenses
from darswin.lens import Lens, Perspective, load

WIDE = (60.0, 90.0)  # degrees, horizontally and vertically: an ordinary wide-angle lens


def draw_lens(name: str, size: int, fov: float, rng: np.random.Generator) -> Lens:
    """One lens of square pictures of `size` px.

    Args:
        name: one of three kinds. "wide" means perspective lenses of 60° to 90° that fill the
            square. A name for `parse_lenses` (one ξ, a range, a level of the paper or
            "polynomial") gives a lens whose field of view `fov` (rad) fills the circle in the
            square. FILE or FILE:CAMERA is a calibration file; its picture is cut to a square.

    Raises:
        ValueError: a name of no lens, or a calibration of unknown image size.
    """
    if name == "wide":
        angle = math.radians(rng.uniform(*WIDE))
        lens: Lens = Perspective.from_fov(fov=angle, radius=size / 2).with_theta_max(None)
        # The lens sees up to the corners.
        lens = lens.with_theta_max(math.atan(math.sqrt(2) * math.tan(angle / 2)))
        return lens.replace(image_size=lens.theta_max.new_tensor([[size, size]]))
    file, _, camera = name.partition(":")
    if Path(file).is_file():
        return _squared(load(file, camera=camera or None), size, name)
    lens = parse_lenses(name).draw(rng, fov, size / 2)
    return lens.replace(image_size=lens.theta_max.new_tensor([[size, size]]))


def is_one(name: str) -> bool:
    """True if a name always means the same lens."""
    if Path(name.partition(":")[0]).is_file():
        return True
    try:
        return math.isfinite(float(name))
    except ValueError:
        return False


def _squared(lens: Lens, size: int, name: str) -> Lens:
    if lens.image_size is None:
        raise ValueError(f"{name} must give the size of its images")
    height, width = (round(side) for side in lens.image_size[0].tolist())
    side = min(height, width)
    square = lens.cropped((height - side) // 2, (width - side) // 2, side, side)
    return square.resized((size, size))
