"""How far an estimated lens may be from the true one, along its whole curve."""

from contextlib import suppress
from operator import attrgetter
from typing import Any

import numpy as np
import torch

from darswin.lens import Lens, fit

RHO = np.linspace(0.05, 1, 20)  # of the radius: where curves are compared
GROUPS = 8  # of curves; the answers without each of them show the uncertainty
FAMILIES = "Spherical", "KannalaBrandt"  # models that suit most lenses
REAL = 0.005  # of θ: by which real cameras are no round lens with square pixels
USUAL = 10.0  # the weight of what usual lenses are like


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


def deviation(fits: list[Any]) -> np.ndarray:
    """(20,) rad: the standard deviation of θ of the first of some fits to lines. By the jackknife
    over groups of neighbouring curves, whose errors are alike, and by other beliefs on usual lenses
    and on the centre."""
    lines, best = fits[0].lines, fits[0]

    def curve(keep: np.ndarray, belief: np.ndarray | float = 0.0) -> np.ndarray:
        some = lines.some(keep, belief)
        near = (type(best)(some, f.v).orient(f.axes).refined(8) for f in fits)
        return min(near, key=attrgetter("cost")).curve

    x, y = np.array([piece.mean(0) for piece in lines.pieces]).T - best.v[4:, None]
    group = np.empty(len(x), int)
    group[np.lexsort((np.arctan2(y, x), lines.picture))] = np.arange(len(x)) * GROUPS // len(x)
    without = [curve(group != k) for k in range(GROUPS)]
    # How far lenses differ from `usual` ones and their centres from the middle. Few curves do not
    # show a centre that is 2 % off, as those of cameras often are.
    off = 10 if 0.001 < lines.center[2] < 0.01 else 5
    beliefs = np.diag((0.5 * USUAL, 0.5 * USUAL, 0.4 * USUAL, off, off, 0))[:5]
    changes = [curve(group >= 0, belief) - best.curve for belief in beliefs]
    return np.sqrt((GROUPS - 1) * np.var(without, 0) + np.square(changes).sum(0))
