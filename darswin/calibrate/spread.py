"""How far an estimated lens may be from the true one, along its whole curve."""

from contextlib import suppress
from operator import attrgetter
from typing import Any

import numpy as np
import torch

from darswin.lens import Lens, fit

RHO = np.linspace(0.05, 1, 20)  # of the radius: where curves are compared
SIGMAS = 3.0  # standard deviations
SCALES = 0.03, 0.08, 0.15, 0.3, 0.6  # of the logarithm of h₀, from the best
ROUNDS = 3  # if a profile has a better lens than the best one
FAMILIES = "Spherical", "KannalaBrandt"  # models that suit most lenses
REAL = 0.005  # of θ: by which real cameras are no round lens with square pixels


def angles(lens: Lens, radius: float) -> np.ndarray:
    """(20,) rad: θ at `RHO` times a radius in px."""
    lens = lens.with_theta_max(None)
    at = torch.from_numpy(radius * RHO).clamp(max=lens.r_max.item())
    return lens.unproject(at[None])[0].numpy()


def misfit(lens: Lens, seen: Lens, radius: float) -> np.ndarray:
    """(20,) rad: by how much a lens differs from what the lines show, or from lenses of other
    models that are closest to that; and `REAL`."""
    others = [seen]
    for model in FAMILIES:
        with suppress(ValueError):
            others.append(fit(model, seen, terms=2).lens)
    found = angles(lens, radius)
    apart = np.abs([angles(other, radius) - found for other in others]).max(0)
    return np.hypot(apart, REAL * found)


def allowed(best: Any) -> tuple[Any, np.ndarray, np.ndarray]:
    """The best lens, and (20,) rad: the least and the largest θ that the lines allow.

    This is the profile of the cost: for each scale, all else is found again, also which lines are
    orthogonal. The errors along a curve are alike, so a curve counts as one observation.
    """
    planes, lines = type(best), best.lines
    for _ in range(ROUNDS):
        noise = (best.rows**2)[: len(lines.points) + len(lines.counts)].sum() / len(lines.counts)
        lines = lines.some(lines.counts > 0, float(np.sqrt(noise)))
        best = planes(lines, best.v, best.normal).orient(best.axes).refined()
        trials, ends = [best], [best.curve]
        for sign in (-1, 1):
            near, before = best, 0.0
            for step in SCALES:
                v = np.r_[best.v[0] + sign * step, near.v[1:]]
                tried = planes(lines, v, near.normal).orient(near.axes), planes(lines, v).orient()
                trial = min(tried, key=attrgetter("cost")).refined(8, range(1, 7))
                rise = np.sqrt(max(trial.cost - best.cost, 0.0) / noise)
                if before <= SIGMAS or rise <= SIGMAS:
                    part = (SIGMAS - before) / (rise - before) if max(rise, before) > SIGMAS else 1
                    ends.append(near.curve + part * (trial.curve - near.curve))
                near, before = trial, rise
                trials.append(trial)
        lowest = min(trials, key=attrgetter("cost"))
        if lowest.cost > best.cost - 0.1 * noise:
            break
        best = lowest
    slopes, turns = best.slopes()[1][:, 1:], np.eye(7)[1:]
    change = np.stack([best.moved(1e-5 * d).curve - best.curve for d in turns], 1) / 1e-5
    rest = SIGMAS * np.sqrt(((change @ np.linalg.pinv(slopes.T @ slopes)) * change).sum(1) * noise)
    return (
        best,
        best.curve - np.hypot(best.curve - np.min(ends, 0), rest),
        best.curve + np.hypot(np.max(ends, 0) - best.curve, rest),
    )
