"""A lens from ordinary pictures: from curves that are straight, and often orthogonal, in the world.

The rays of a straight line lie in a plane. This determines the curve of a lens up to a factor of
tan θ, because the map (x, y, z) → (x, y, s z) of rays keeps planes. What people build has three
orthogonal directions, which determine the factor; so does the field of view of the image circle.

Source: Devernay and Faugeras, MVA 2001; Coughlan and Yuille, ICCV 1999.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from darswin.calibrate import edges
from darswin.calibrate.calibration import CalibrationError
from darswin.lens import OCam, fit, to_dict
from darswin.lens.base import MODELS, Lens, unknown_model
from darswin.lens.files.load import reach

MOST, FEWEST = 120, 10  # curves of a picture, and of all
STEP = 4  # points of an edge that are averaged
NEAR = (2.0, 1.0)  # px, in two rounds: curves that miss by more count little
ORTHOGONAL = 4.0  # the weight of directions, compared with straightness
BENDS, DEPTHS = np.linspace(-2, 0.3, 47), np.geomspace(0.12, 4, 40)  # a₁ and h₀ that are tried
AS_GOOD = 1.1  # times the least cost: other answers that the pictures allow
GROUPS = 8  # of curves; the answers without each of them show the uncertainty
UNSURE, OFF = 0.05, 2.0  # of the angle at the rim; px between the model and what lines show


@dataclass(frozen=True)
class Estimate:
    """A lens from pictures without a board.

    Attributes:
        lens: one lens in float64.
        rim: rad, its θ at `radius`, px: at the image circle, or at the nearest side without one.
        interval: rad: the least and the largest θ at the rim that the pictures allow, one standard
            deviation around all answers that are nearly as good.
        curves: the number of curves that are straight with this lens.
        covered: the part of the radius, in [0, 1], on which they lie.
        verdict: what supports the lens, in one sentence; doubts: sentences on what does not.
    """

    lens: Lens
    rim: float
    radius: float
    interval: tuple[float, float]
    curves: int
    covered: float
    verdict: str
    doubts: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """All of it as a JSON object; the lens is described as by `darswin.lens.to_dict`."""
        return vars(self) | {"lens": to_dict(self.lens)}


def estimate(
    pictures: Sequence[np.ndarray],
    model: str = "Spherical",
    *,
    center: tuple[float, float] | None = None,
    fov: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> Estimate:
    """Finds the lens of a camera from pictures with straight edges.

    Args:
        pictures: (H, W) or (H, W, 3), uint8, all of one size and one camera.
        model: a name in `darswin.lens.MODELS`; or "Division", the `OCam` lens with [a₀, 0, a₂].
        center: (x, y) px, if it is known. Otherwise it is near the middle of the image circle, or
            of the picture.
        fov: rad, the field of view of the visible image circle, if it is known.
        progress: a function that is called with lines of text.

    Raises:
        CalibrationError: too few lines, or lines that do not determine the lens.
        ValueError: an unknown model, or pictures of several sizes.
    """
    if model not in MODELS and model != "Division":
        raise ValueError(unknown_model(model))
    if fov is not None and not 0 < fov < 2 * math.pi:
        raise ValueError(f"`fov` must be above 0 and below 2π, got {fov}")
    sizes = {picture.shape[:2] for picture in pictures}
    if len(sizes) != 1:
        found = ", ".join(f"{w} × {h}" for h, w in sorted(sizes)) or "no pictures"
        raise ValueError(f"pictures must be of one camera and one size (W × H), got {found}")
    circle = edges.image_circle(pictures)
    if fov is not None and circle is None:
        raise CalibrationError("no image circle is visible, so its field of view says nothing")
    found_curves = []
    for number, picture in enumerate(pictures, 1):
        found_curves.append(edges.curves(picture))
        if progress is not None:
            progress(f"picture {number} of {len(pictures)}: {len(found_curves[-1])} curves")
    return from_curves(found_curves, sizes.pop(), model, center=center, fov=fov, circle=circle)


def from_curves(
    curves: Sequence[Sequence[np.ndarray]],
    size: tuple[int, int],
    model: str = "Spherical",
    *,
    center: tuple[float, float] | None = None,
    fov: float | None = None,
    circle: tuple[float, float, float] | None = None,
) -> Estimate:
    """`estimate` from the curves of each picture, (n, 2) px; circle: (x, y, radius), px."""
    height, width = size
    x, y = center or (circle[:2] if circle else ((width - 1) / 2, (height - 1) / 2))
    radius = circle[2] if circle else min(x, y, width - 1 - x, height - 1 - y) + 0.5
    pieces, picture = [], []
    for number, of_picture in enumerate(curves):
        for curve in of_picture[:MOST]:
            if circle and (np.hypot(*(curve - circle[:2]).T) > 0.98 * radius).mean() > 0.1:
                continue  # the edge of the image circle
            points = curve[: len(curve) // STEP * STEP].reshape(-1, STEP, 2).mean(1)
            if len(points) > 3:
                pieces.append(points / radius)
                picture.append(number)
    lines = _Lines(pieces, np.array(picture), radius, np.array((x, y)) / radius)
    lines.about = 1e-4 if center else 0.002 if circle else 0.01
    lines.rim = None if fov is None else fov / 2
    if len(pieces) < FEWEST:
        raise CalibrationError(
            f"only {len(pieces)} curves may be straight lines, but an estimate needs {FEWEST}: "
            "give more pictures, or some of rooms, houses or streets"
        )
    found = _search(lines)
    best = found[0]
    straight = best.straightness < 1
    along = [np.bincount(best.nearest[best.fits & (best.lines.picture == p)], minlength=3)
             for p in best.axes]
    oriented = sum((of >= 3).sum() >= 2 for of in along)
    if straight.sum() < FEWEST:
        raise CalibrationError(f"only {straight.sum()} curves are straight in one and the same lens")
    if fov is None and not oriented:
        raise CalibrationError(
            "straight lines alone do not tell the focal length, and no picture has several lines "
            "in each of two orthogonal directions: give the field of view of the image circle"
        )
    raw = best.lens(size)
    far = min(radius * best.rho.max(), raw.r_max.item())
    raw = raw.with_theta_max(raw.unproject(far).item())
    kind, terms = ("OCam", 2) if model == "Division" else (model, min(MODELS[model].terms, 2))
    try:
        lens, error = fit(kind, raw, terms=terms)
    except ValueError as reason:
        raise CalibrationError(str(reason)) from reason
    lens = lens.with_theta_max(None)
    rim = lens.unproject(min(radius, lens.r_max.item())).item()
    lens = lens.with_theta_max(rim if circle else reach(lens))
    low, high = (end([rim, *(f.rim for f in found)]) for end in (min, max))
    spread = best.deviation() if fov is None else 0.0
    return _described(...)
