"""The ground around a rig, as seen from above."""

import math
from typing import Any, Self

import torch
from torch import Tensor

from darswin.utils.parameters import check
from darswin.views.base import Pair, PerChannel
from darswin.views.pixels import PixelView, check_supersampling

_FARTHEST, _HALVINGS = 1e4, 60  # m along a ray, and steps of the search where it ends


class GroundView(PixelView):
    """A plan of the ground around a rig; its top is ahead. `GroundView((800, 800), 12).at(rig)`.

    The ground is level and passes through the rig's origin: see `Rig.raised`.

    Args:
        size: (H', W') of the view.
        span: the width of the ground that it shows, m.
        center: the middle of the view, m ahead and m to the left of the rig's origin.
        rise: turns the ground into a bowl, so that upright things far away are not drawn out: it is
            `rise` · (r - flat)² m high at r m from the origin. 0 is flat.
        flat: the radius of the level part of a bowl, m.
        supersampling: the points along each side of a pixel at which the pictures are read, 1 to
            16. None means as many at each place as the scales there suggest.
        mean, std: the arguments of `View`.

    Raises:
        ValueError: a number is out of its range.
    """

    size: Pair
    is_surface = True

    def __init__(
        self,
        size: Pair,
        span: float,
        center: tuple[float, float] = (0.0, 0.0),
        rise: float = 0.0,
        *,
        flat: float = 5.0,
        supersampling: int | None = None,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(size, mean=mean, std=std)
        check("span", span, 0 < span < math.inf, "above 0 m")
        check("rise", rise, 0 <= rise < math.inf, "at least 0")
        check("flat", flat, 0 <= flat < math.inf, "at least 0 m")
        finite = len(center) == 2 and all(map(math.isfinite, center))
        check("center", center, finite, "two finite numbers of metres, ahead and to the left")
        check_supersampling(supersampling)
        self.span, self.rise, self.flat, self.supersampling = span, rise, flat, supersampling
        self.center = (float(center[0]), float(center[1]))

    def in_rig(self) -> Self:
        return self

    def places(self, points: Tensor) -> Tensor:
        x, y = points.unbind(-1)
        right, ahead = x * self._step - self._offset[0], self._offset[1] - y * self._step
        return torch.stack((right, -self._height(right, ahead), ahead), -1)

    def met_by(self, rays: Tensor, origin: Tensor) -> Tensor:
        if self.rise == 0:
            along = -origin[1] / rays[..., 1]
            along = torch.where(along > 0, along, torch.nan)
        else:
            # What is above a bowl is convex, so a ray from there meets the bowl once.
            low = torch.zeros_like(rays[..., 0])
            high = torch.full_like(low, _FARTHEST)
            for _ in range(_HALVINGS):
                middle = (low + high) / 2
                above = self._is_above(origin + middle[..., None] * rays)
                low, high = torch.where(above, middle, low), torch.where(above, high, middle)
            along = torch.where(high < _FARTHEST, low, torch.nan)
        right, _, ahead = (origin + along[..., None] * rays).unbind(-1)
        pixels = (right + self._offset[0], self._offset[1] - ahead)
        return torch.stack(pixels, -1) / self._step

    @property
    def _step(self) -> float:
        """The length of a pixel, m."""
        return self.span / self.size[1]

    @property
    def _offset(self) -> tuple[float, float]:
        """m to the left of the rig's origin, and ahead of it, of the middle of the first pixel."""
        half_height, half_width = ((side - 1) / 2 * self._step for side in self.size)
        return half_width + self.center[1], half_height + self.center[0]

    def _height(self, right: Tensor, ahead: Tensor) -> Tensor:
        beyond = (torch.hypot(right, ahead) - self.flat).clamp(min=0)
        return self.rise * beyond * beyond

    def _is_above(self, places: Tensor) -> Tensor:
        right, down, ahead = places.unbind(-1)
        return -down > self._height(right, ahead)

    def prepare(self, lens: Any, size: Pair, *, back: bool | Pair = True) -> Any:
        raise TypeError(
            "GroundView shows a rig: use view.at(Rig.single(lens, size, up=…, height=…))"
        )

    def extra_repr(self) -> str:
        bowl = f", rise={self.rise:g}, flat={self.flat:g}" if self.rise else ""
        return f"{super().extra_repr()}, span={self.span:g}, center={self.center}{bowl}"
