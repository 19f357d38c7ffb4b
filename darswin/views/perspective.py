"""A perspective picture in one direction, as of a camera without distortion that looks there."""

import math

import torch
from torch import Tensor

from darswin.lens import Lens, Perspective
from darswin.utils.angles import degrees_hint
from darswin.views.base import Pair, PerChannel
from darswin.views.directions import RayView
from darswin.views.orientation import Vector
from darswin.views.registry import register_view


@register_view("perspective")
class PerspectiveView(RayView):
    """A perspective picture around one `direction`: straight lines stay straight.

    This is the picture for a network that looks at one object, as a classifier does. It is coarse
    in the middle above 100°, so a view of a whole lens ends there. The other arguments and the
    errors are those of `RayView`, but `fov` is below π.

    Args:
        reach: in place of `fov`, the angle between `direction` and the nearest edges, in (0, π/2)
            rad, but θ_max of each lens where that is less, also if the picture ends before.
    """

    usual_fov = math.radians(100)
    widest = math.radians(179.9)

    def __init__(
        self,
        size: Pair,
        fov: float | None = None,
        theta_max: float | None = None,
        *,
        reach: float | None = None,
        up: Vector | None = None,
        direction: Vector | None = None,
        supersampling: int | None = None,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(
            size,
            fov,
            theta_max,
            up=up,
            direction=direction,
            supersampling=supersampling,
            mean=mean,
            std=std,
        )
        if reach is not None and not 0 < reach <= self.widest / 2:
            hint = degrees_hint(reach)
            raise ValueError(f"reach must be in (0, {self.widest / 2:.4g}] rad, got {reach}{hint}")
        if reach is not None and fov is not None:
            raise ValueError(f"give either fov or reach, got {fov} and {reach}")
        self.reach = reach

    def half_width(self, angle: float) -> float:
        return math.tan(angle)

    def to_plane(self, rays: Tensor) -> Tensor:
        ahead = rays[..., 2:]
        flat = rays[..., :2] / torch.where(ahead > 0, ahead, 1.0)
        return torch.where(ahead > 0, flat, torch.nan)

    def from_plane(self, points: Tensor) -> Tensor:
        x, y = points.split(1, -1)  # not `sum`, as in `length_of`
        length = torch.rsqrt(1 + x * x + y * y)
        return torch.cat((points * length, length), -1)

    def camera(self, lens: Lens, size: Pair) -> Lens:
        """A camera without distortion in the view's own frame, up to the corners of its picture."""
        step, middle = self._layout(lens, size)
        height, width = self.size
        center = middle.new_tensor([[(width - 1) / 2, (height - 1) / 2]]) - middle / step
        farthest = torch.maximum(center.abs() + 0.5, (center - center.new_tensor(
            [[width - 0.5, height - 0.5]])).abs()).norm()  # fmt: skip
        focal = 1 / step[:, 0]
        return Perspective(focal, torch.atan(farthest / focal), center=center, image_size=self.size)

    def _layout(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        if self.reach is None:
            return super()._layout(lens, size)
        half = torch.tan(lens.theta_max.detach().clamp(max=self.reach))
        return 2 * half[:, None] / min(self.size), half.new_zeros(1, 2)

    def extra_repr(self) -> str:
        reach = "" if self.reach is None else f", reach={self.reach:.4g}"
        return f"{super().extra_repr()}{reach}"
