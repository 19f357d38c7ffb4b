"""Whether a lens fits its picture: lengths in another unit make a lens that is valid but wrong."""

import math
from collections.abc import Mapping

import torch

from darswin.lens.base import Lens
from darswin.lens.distorted import BrownConrady, Fisheye624, KannalaBrandt
from darswin.lens.polynomial import PolynomialLens
from darswin.utils.words import in_px

# The thresholds lie far from real lenses. Their image circles are as large as the picture's shorter
# side or larger, and half the diagonal spans 0.4 to 4 rad in pixels of the axis. Small circles in
# large pictures, telescopes, shifted lenses and crops shall pass.
SMALLEST_CIRCLE = 0.2  # of the shorter side
LARGEST_RADIUS = 20.0  # halves of the diagonal
SMALLEST_SPAN, LARGEST_SPAN = 1e-4, 40.0  # rad
WIDEST_PINHOLE = math.radians(86)
MOST_CHANGE = 8.0  # times, of the px per angle, beside those of a pinhole
MOST_MISSED = 3.0  # px; calibrations miss their corners by less than 1 px
# The distance of the principal point from the middle, in parts of the picture. A crop along one
# side and a shifted lens move it along one axis; another unit moves it along both.
FAR_ON_BOTH, FAR_ON_ONE, NEAR = 0.2, 1.0, 0.1
LEAST_CIRCULAR = math.radians(70)  # θ_max of a fisheye whose picture shows its circle
SHOWN = 0.75  # its circle may lie anywhere if the picture shows this part of its width and height
# For guesses. px per unit of length are those of pixels of 3 µm, MOST_OFF times more or less.
UNITS = {"in mm": 1e3 / 3, "in cm": 1e4 / 3, "in m": 1e6 / 3, "in inches": 25.4e3 / 3,
         "in µm": 1 / 3}  # fmt: skip
MOST_OFF = 2.5
TYPICAL_SPANS = (0.15, 6.0)  # rad
MOST_APART = 1.2  # ratio of the factors along x and y
LEAST_SCALE, SMALL = 8.0, 0.1  # px per rad, by r at this θ
LEAST_SIDE, MOST_SIDE = 64, 1e6  # px; a smaller "picture" is a sensor in a unit of length


class ImplausibleLens(UserWarning):
    """A warning of a calibration that does not fit its picture, as if in another unit."""


def doubts(lens: Lens, missed: float = 0.0) -> list[str]:
    """What looks wrong with each lens in its picture, and what would fit; "" if nothing does.

    The image circle up to θ_max, the pixels per angle, θ_max and the principal point are held
    against the picture, and so are the px by which the calibration missed its corners, as far as
    its file says. A lens without an image_size is doubted only if no picture would fit it.
    """
    lens = lens.detach().to("cpu", torch.float64)
    limit, small = lens.theta_limit, lens.theta_limit.clamp(max=SMALL)
    scale = lens.project(small) / small
    if lens.image_size is None:
        return [_tiny(px) for px in scale.tolist()]
    stretch = torch.ones(1) if lens.affine is None else lens.affine.det().abs().sqrt()
    is_pinhole = (limit < math.pi / 2) & (lens.project(limit) > 10 * scale)
    rows = (lens.theta_max, stretch * lens.r_max, stretch * scale, is_pinhole, _change(lens),
            lens.center_in().flatten(1), lens.image_size)  # fmt: skip
    values = [row.expand(len(lens), *row.shape[1:]).tolist() for row in rows]
    return [_doubt(missed, *of_one) for of_one in zip(*values, strict=True)]


def _change(lens: Lens) -> torch.Tensor:
    """(N,): how many-fold the px per angle change within the picture, for models whose terms a
    failed calibration can make wild; of a pinhole, beside those of one without terms."""
    if not isinstance(lens, (BrownConrady, Fisheye624, KannalaBrandt, PolynomialLens)):
        return torch.ones(1)
    theta = lens.theta_max[:, None] * torch.linspace(0, 0.9, 33).to(lens.theta_max)
    steps = lens.project(theta).diff(dim=1) / theta.diff(dim=1)
    part = steps / steps[:, :1]
    most = part * theta[:, 1:].cos().square() if isinstance(lens, BrownConrady) else part
    return torch.maximum(most.amax(1), 1 / part.amin(1))


def _doubt(
    missed: float, theta_max: float, radius: float, scale: float, is_pinhole: bool, change: float,
    center: list[float], size: list[float],
) -> str:  # fmt: skip
    """That of one lens; radius: of the image circle, px; scale: px per rad at the axis."""
    (height, width), (x, y) = size, center
    half, degrees = math.hypot(width, height) / 2, math.degrees(theta_max)
    oddities = []
    if 2 * radius < SMALLEST_CIRCLE * min(size):
        oddities.append(f"an image circle of {2 * radius:.3g} px up to θ_max = {degrees:.4g}°")
    elif half > LARGEST_SPAN * scale or (is_pinhole and theta_max > WIDEST_PINHOLE):
        oddities.append(f"{scale * math.pi / 180:.3g} px per degree and a θ_max of {degrees:.4g}°")
    elif half < SMALLEST_SPAN * scale or radius > LARGEST_RADIUS * half:
        oddities.append(f"an image circle of {2 * radius:.6g} px up to θ_max = {degrees:.3g}°")
    off = _off_axes(x, y, width, height)
    swapped = min(off) > NEAR / 2 and swap_fits(x, y, width, height)
    far = min(off) > FAR_ON_BOTH and (
        bool(oddities) or theta_max < LEAST_CIRCULAR
        or min(_shown(x, radius, width), _shown(y, radius, height)) < SHOWN
    )  # fmt: skip
    if far or max(off) > FAR_ON_ONE or swapped:
        oddities.append(f"the principal point at ({x:.4g}, {y:.4g}), far from the middle")
    guess = _guess(x, y, width, height, min(max(scale, 1e-99), 1e99)) if oddities else ""
    if change > MOST_CHANGE:
        oddities.insert(0, f"px per degree that change {change:.2g}-fold, as after a failed fit")
    if missed > MOST_MISSED:
        oddities.insert(0, f"corners that its calibration missed by {missed:.3g} px")
    shown = f"a picture of {in_px(size)} with {' and '.join(oddities)}{guess}"
    return shown if oddities else ""


def _tiny(scale: float) -> str:
    """What is said of a lens with so few px per rad that its lengths are no pixels."""
    per_degree = f"{math.radians(scale):.2g} px per degree"
    return f"{per_degree}, as if the lengths were in mm; they are in px" * (scale < LEAST_SCALE)


def off_middle(x: float, y: float, width: float, height: float) -> float:
    """How far a pixel is from the middle of an image, as the larger part of its sides."""
    return max(_off_axes(x, y, width, height))


def swap_fits(x: float, y: float, width: float, height: float) -> bool:
    """True if a pixel is far from the middle, but near that of an image with swapped sides."""
    off, other = off_middle(x, y, width, height), off_middle(x, y, height, width)
    return off > NEAR / 2 and other < min(off / 2, NEAR)


def _shown(middle: float, radius: float, side: float) -> float:
    """The part of a circle's diameter along one axis that lies within the picture."""
    return (min(middle + radius, side) - max(middle - radius, 0.0)) / (2 * radius)


def _off_axes(x: float, y: float, width: float, height: float) -> tuple[float, float]:
    return abs((x + 0.5) / width - 0.5), abs((y + 0.5) / height - 0.5)


def _guess(x: float, y: float, width: float, height: float, scale: float) -> str:
    """What would fit the picture, in words that follow the doubt; "" without an idea."""
    half = math.hypot(width, height) / 2
    fits_in_px = TYPICAL_SPANS[0] < half / scale < TYPICAL_SPANS[1]
    if swap_fits(x, y, width, height):
        return "; width and height seem to be swapped"
    if off_middle(x, y, width, height) < FAR_ON_BOTH:  # then the principal point is in px
        sides = {"normalised by the width": width, "normalised by the height": height}
        if fits_in_px:
            return "; θ_max may be in another unit"
        units = _nearest(UNITS | sides, half / 1.2 / scale)
        return f"; the focal length would fit {units}" if units else ""
    may_be = []
    for name, (across, down) in {
        "width and height": (width, height), "width": (width,) * 2, "height": (height,) * 2,
    }.items():  # fmt: skip
        focal_fits = TYPICAL_SPANS[0] < half / scale / math.sqrt(across * down) < TYPICAL_SPANS[1]
        for origin in (0.0, 0.5):  # formats with the upper left pixel at ½ have subtracted it
            pixel = (x + origin) * across, (y + origin) * down
            if off_middle(*pixel, width, height) < NEAR:
                if focal_fits:
                    return f"; the lengths would fit normalised by the {name}"
                may_be = [f"normalised by the {name}"]
    if fits_in_px and max(abs(x) / width, abs(y) / height) < NEAR / 2:
        return f"; it may be {' or '.join([*may_be, 'measured from the middle'])}"
    if x > 0 and y > 0 and MOST_APART > (ratio := width * y / height / x) > 1 / MOST_APART:
        factor = width / x / 2 / math.sqrt(ratio)  # from these lengths to px
        if LEAST_SIDE * factor < min(width, height) < MOST_SIDE * factor:
            fit = f"the lengths would fit {in_px((height / factor, width / factor))}"
            return f"; {fit}, or the picture is a crop"
        if units := _nearest(UNITS, factor):
            return f"; the lengths would fit {units}"
    return ", unless the picture is a crop" if fits_in_px else ""


def _nearest(units: Mapping[str, float], factor: float) -> str:
    """The units whose number of px is at most MOST_OFF times off a factor, the best first."""
    off = {unit: abs(math.log(px / factor)) for unit, px in units.items()}
    return " or ".join(u for u in sorted(off, key=off.__getitem__) if off[u] < math.log(MOST_OFF))
