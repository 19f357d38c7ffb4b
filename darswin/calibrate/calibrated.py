"""A calibrated lens: a lens, and how sure it is."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from darswin.calibrate.refine import Free
from darswin.lens import Lens, to_dict
from darswin.lens.fitting import slopes_of
from darswin.utils.arrays import as_tensor


@dataclass(frozen=True, eq=False, kw_only=True)
class CalibratedLens:
    """A lens found from P pictures of a board with K corners, and how sure it is.

    Attributes:
        lens: the lens, a batch of one in float64. Its theta_max is the largest of its
            `side_angles`, at most the angle up to which r rises.
        rotations, translations: (P, 3, 3) and (P, 3): the points of the board are at
            rotation @ board[k] + translation in the camera's frame, in the board's unit. NaN for
            pictures that show too few corners.
        board: (K, 3): its points as they were found: bent, and stretched along y, if that is sure.
        corners: (P, K, 2) px: those that were given; NaN where not seen.
        residuals: (P, K, 2) px: the pixels of the lens minus the corners; NaN where not seen.
        weights: (P, K) in [0, 1]: how much each corner counts.
        theta: (P, K) rad: the angle of each corner; NaN where not seen.
        used: (P,) bool: the pictures that count.
        names: those of the pictures.
        sigma: px: the standard deviation of a corner along one axis, from the median.
        error: px: the root mean square distance of corners from the lens, without those off it.
        left_out: px: the same in pictures that were left out, each fifth of them once; NaN for
            fewer than 4 places of the board.
        supported: rad: the largest angle with corners around it.
        unsure: rad: the standard deviation of 95 % of the rays up to there is no larger, after the
            best rotation; by the noise of corners, or by leaving out one place of the board.
        parameters: the names of the n numbers that were found for the lens and for the board: its
            bend in x and in y, and its stretch.
        covariance: (n, n), theirs.
        models: for "auto", the best first: (model, left_out, error, ""), or (model, NaN, NaN, the
            reason why there is none). For all but the best few, left_out is of first order.
        doubts: what looks wrong, in sentences. Corners are counted from 1.
    """

    lens: Lens
    rotations: Tensor
    translations: Tensor
    board: Tensor
    corners: Tensor
    residuals: Tensor
    weights: Tensor
    theta: Tensor
    used: Tensor
    names: list[str]
    sigma: float
    error: float
    left_out: float
    supported: float
    unsure: float
    parameters: list[str]
    covariance: Tensor
    models: list[tuple[str, float, float, str]]
    doubts: list[str]
    _free: Free = field(repr=False)
    _vector: Tensor = field(repr=False)
    _joint: Tensor = field(repr=False)

    @property
    def noise(self) -> float:
        """px: by `sigma`, the root mean square distance of corners, as `error` and `left_out`."""
        return math.sqrt(2) * self.sigma

    def uncertainty(self, pixels: Any) -> Tensor:
        """(...,) px: the standard deviation of the pixel of a far point, along its worst direction.

        Pixels are (..., 2). As mrcal defines it, the point stays fixed with respect to the boards:
        its ray moves with the mean rotation of the poses. NaN where no ray lands.
        """
        pixels = as_tensor(pixels, torch.float64)
        lens = self.lens.with_theta_max(None)
        rays = lens.unproject_points(pixels.reshape(-1, 2))
        slopes = self._free.slopes(self._vector, lens.theta_max, rays)
        (a, b), (_, d) = ((slopes @ self._joint @ slopes.mT)[:, k].unbind(1) for k in (0, 1))
        spread = (a + d) / 2 + torch.hypot(b, (a - d) / 2)
        return spread.sqrt().reshape(pixels.shape[:-1])

    def uncertainty_of_theta(self, theta: Any) -> Tensor:
        """(...,) px: the standard deviation of the radius r(θ), for θ (...,) rad."""
        theta = as_tensor(theta, torch.float64)
        slopes = slopes_of(
            lambda vectors: self._free.at(vectors, self.lens.theta_limit).project(
                theta.view(1, -1)
            ),
            self._vector,
        )
        return ((slopes @ self.covariance) * slopes).sum(-1).sqrt().reshape(theta.shape)

    def to_dict(self) -> dict[str, Any]:
        """All of it as a JSON object; NaN becomes None."""
        named = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        public = {name: _plain(value) for name, value in named.items() if name[0] != "_"}
        return public | {"lens": to_dict(self.lens)}


def _plain(value: Any) -> Any:
    value = value.tolist() if isinstance(value, Tensor) else value
    if isinstance(value, list | tuple):
        return [_plain(x) for x in value]
    return None if isinstance(value, float) and math.isnan(value) else value
