"""What looks wrong with a calibration."""

import math

import torch
from torch import Tensor

from darswin.calibrate.calibrated import CalibratedLens
from darswin.calibrate.inputs import LEAST_CORNERS, CalibrationError
from darswin.calibrate.refine import OFF, SHARPEST
from darswin.calibrate.steady import FEW, Steadiness
from darswin.lens import Lens
from darswin.utils.words import counted

UNSURE, UNKNOWN = 0.1, 2.0  # degrees: the standard deviation of rays
DISAGREE, APART = 3.0, 0.06  # times that by the noise, for pictures that differ; degrees
GROWN, SURE = 0.003, 4.0  # of the scale; standard deviations
BLURRED, PARALLEL = 1.0, 12.0  # px; degrees
WRONG = 0.02  # of the picture's side: a corner's standard deviation
GUESSED = 4.0  # left_out, by the standard deviation; 1.5 is usual
ONE_DISTANCE = 1.05  # the distance of the farthest board, by that of the nearest
COVERED, SEEN = 0.8, 0.6  # of theta_max; of the angle at most sides of the picture
SHOWN = 10  # corners


class Note(str):
    """A warning that needs no action: what it tells is usual, or was taken into account."""


def doubts(found: CalibratedLens, seen: Tensor, middle: Tensor, steady: Steadiness) -> list[str]:
    """What looks wrong, in sentences; seen: (P, K); middle: (3,), of the board's points.

    Raises:
        CalibrationError: the pictures do not determine the lens.
    """
    said, used = list[str](), found.used
    rotations = found.rotations[used]
    middles = rotations @ middle + found.translations[used]
    noise = math.degrees(steady.noise) * max(1.0, SHARPEST / max(found.sigma, 1e-12))
    scatter = math.degrees(steady.scatter)
    unsure, disagree = max(noise, scatter), scatter > DISAGREE * noise
    if not unsure <= (APART if disagree else UNSURE):
        tilt = torch.acos(rotations[:, 2, 2].abs().clamp(max=1)).max().rad2deg()
        why = "take more pictures, with tilted boards that fill more of the picture"
        if disagree:
            why = (
                "pictures disagree by more than the noise; are zoom, focus and camera the same in "
                "all, is the board flat and as you say, and was it still?"
            )
        if tilt < PARALLEL:
            why = "all boards are nearly parallel to the sensor: tilt them by 20 to 45°"
        # Near to the plane, the linear estimate is much too small.
        if not unsure <= UNKNOWN * (tilt / PARALLEL).clamp(max=1).square():
            raise CalibrationError(f"The pictures do not determine the lens: {why.rstrip('?')}.")
        said.append(f"the rays are unsure by {unsure:.2g}°: {why}")
    if abs(steady.growth) > GROWN and abs(steady.sure) > SURE:
        said.append(
            f"the scale changes by {100 * steady.growth:+.2g} % from the first picture to the "
            "last: zoom and focus must stay the same"
        )
    distance = found.residuals.norm(dim=-1)
    off = (distance > OFF * max(found.sigma, SHARPEST)) & used[:, None]
    worst = sorted(((distance[k, i].item(), k, i) for k, i in off.nonzero().tolist()), reverse=True)
    for d, k, i in worst[:SHOWN]:
        said.append(Note(f"corner {i + 1} of {found.names[k]} is {d:.3g} px off"))
    if len(worst) > SHOWN:
        where = counted(int(off.any(1).sum()), "picture")
        said.append(Note(f"{counted(len(worst) - SHOWN, 'more corner')} off, in {where}"))
    for k in (~used).nonzero()[:, 0].tolist():
        what = f"does not fit: half of its corners are {distance[k].nanmedian():.3g} px off"
        if found.rotations[k].isnan().any():
            count = int(seen[k].sum())
            what = f"shows {counted(count, 'corner')}; {LEAST_CORNERS}, not on one line, are needed"
        said.append(f"{found.names[k]} {what}")
    if steady.places < FEW:
        count = int(used.sum())
        same = f" show the board at {steady.places} places, which" * (steady.places < count)
        said.append(f"{count} pictures{same} are few: take 10 to 20, at other places")
    if found.left_out > GUESSED * max(found.sigma, SHARPEST):
        said.append(
            f"pictures that were left out are missed by {found.left_out:.3g} px, but the noise is "
            f"{found.noise:.2g} px: take more pictures"
        )
    if found.sigma > BLURRED:
        said.append(
            f"corners are {found.noise:.2g} px off: the pictures are blurred, the board is bent, "
            "or another model fits better"
        )
    far = middles.norm(dim=1)
    if far.max() < ONE_DISTANCE * far.min():
        said.append("all boards are at one distance: take some nearer and some farther")
    behind = used.nonzero()[(rotations[:, :, 2] * middles).sum(1) < 0, 0].tolist()
    if behind:
        which = ", ".join(found.names[k] for k in behind[:SHOWN])
        said.append(f"the board is mirrored, or seen from behind, in {len(behind)}: {which}")
    return [*said, *out_of_reach(found.supported, found.lens)]


def out_of_reach(supported: float, lens: Lens) -> list[str]:
    """What is said if corners reach up to an angle, rad, but the lens sees farther."""
    end = lens.theta_max.item()
    usual = min(end, lens.side_angles().median().item())
    kind = str if supported < SEEN * usual else Note
    words = (
        f"corners reach {math.degrees(supported):.0f}° from the axis, but the picture "
        f"{math.degrees(end):.0f}°: in between, the lens is a guess"
    )
    return [kind(words)] * (supported < COVERED * end)


def misshapen(found: CalibratedLens, shape: Tensor, confounded: bool) -> list[str]:
    """What was found of the pixels and of the board, in sentences; shape: (3,), of the board;
    confounded: its stretch may be that of the pixels."""
    said, stretch = list[str](), shape[2].item()
    ratio = found.lens._affine()[0, 1, 1].item() - 1
    if ratio:
        said.append(Note(f"lengths along y are {_longer(ratio)} than along x: this is in the lens"))
    if confounded:
        said.append(
            f"lengths along y seem {_longer(stretch)}, of the pixels or of the board: measure the "
            "board's sides, and turn it by a quarter in some pictures; the pixels are taken as "
            "square"
        )
    elif stretch:
        words = f"the board is {_longer(stretch)} along its columns than along its rows"
        said.append(Note(f"{words}, as printers stretch: this is taken into account"))
    if shape[:2].any():
        plane = torch.nn.functional.pad(found.board[:, :2], (0, 1), value=1.0)
        flat = plane @ torch.linalg.lstsq(plane, found.board[:, 2:]).solution
        bend = (found.board[:, 2:] - flat).abs().max().item()
        said.append(
            Note(f"the board is bent by {bend:.2g} of its unit: this is taken into account")
        )
    return said


def _longer(ratio: float) -> str:
    return f"{100 * abs(ratio):.2g} % {'longer' if ratio > 0 else 'shorter'}"
