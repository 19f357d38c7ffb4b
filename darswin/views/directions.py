"""Views whose pixels look along rays of the camera: maps of the sphere, upright if you know up."""

import math
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import as_map, ray_channels
from darswin.lens.solve import repeated
from darswin.ops._library import no_gradients
from darswin.ops.checks import readable, tensor_there
from darswin.utils.angles import degrees_hint
from darswin.utils.poses import AXIS, PICTURE_TOP, frame_of
from darswin.views.base import Pair, PerChannel, check_lens, in_full_precision
from darswin.views.orientation import Vector, unit_vector
from darswin.views.pixels import PixelView, check_supersampling

_STEEPEST = math.radians(80)  # elevations beyond are far away in maps of the sphere
_STEPS, _BISECTIONS = 361, 12  # points at which the end of what a lens sees is looked for
_LEAST_STEP = 1e-9  # of a view whose middle the picture does not show
_SEAM = 1e-3  # px that a view may lack and still goes all around
_APART = 1.5  # pixels of the image between points at which it is read
_USUAL_SUPERSAMPLING = 4  # at most, unless `supersampling` says more


class RayView(PixelView):
    """A view whose pixels look along rays: a map of the sphere, with an exact inverse.

    A subclass says which map, in functions between unit vectors (x, y, z), with x right, y down
    and z forward in the view's own frame, and points of a plane, in rad at its middle.

    Each pixel of the view is the mean of several points of the image if the view shrinks the
    picture. Pixels that no ray of the lens reaches get 0.

    Args:
        size: (H', W') of the view.
        fov: the horizontal field of view between the outer edges of a row, rad. The view then is
            the same for all lenses, and its middle is `direction`. None shows all that each lens
            sees in the picture: along the middle row, and as high as the size allows.
        theta_max: the largest incident angle that is shown, rad; None means θ_max of each lens.
        up: (x, y, z), the direction away from gravity in the camera's frame, of any length: x
            right, y down, z forward. None means the top of the picture, (0, -1, 0). `up_of` makes
            it from the roll and pitch of a camera, or from its extrinsics.
        direction: (x, y, z), the middle of the view in the camera's frame, of any length. None
            means the optical axis.
        supersampling: the points along each side of a pixel at which the image is read, 1 to 16.
            None means as many as the sizes of the image and of the view suggest, for a picture that
            is 180° across.
        mean, std: the arguments of `View`.

    Raises:
        ValueError: an angle is out of range, or a vector is not three finite numbers or is zero.
            With a lens: the view sees nothing of it.
    """

    size: Pair
    upright = False  # True if all columns are vertical in the world, and not only the middle one
    around = False  # True if a view shows all around the horizon, and not as much as the lens
    usual_fov = 2 * math.pi  # at most, of a view of a whole lens, rad
    widest = 2 * math.pi  # the largest fov
    aspect: float | None = None  # the usual H'/W'; None means that of the images

    def __init__(
        self,
        size: Pair,
        fov: float | None = None,
        theta_max: float | None = None,
        *,
        up: Vector | None = None,
        direction: Vector | None = None,
        supersampling: int | None = None,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(size, mean=mean, std=std)
        for name, angle, most in (("fov", fov, self.widest), ("theta_max", theta_max, math.pi)):
            if angle is not None and not 0 < angle <= most:
                hint = degrees_hint(angle)
                raise ValueError(f"{name} must be in (0, {most:.4g}] rad, got {angle}{hint}")
        check_supersampling(supersampling)
        self.fov, self.theta_max, self.supersampling = fov, theta_max, supersampling
        self.up = unit_vector("up", PICTURE_TOP if up is None else up)
        self.direction = unit_vector("direction", AXIS if direction is None else direction)
        self._frame = frame_of(self.up, self.direction, self.upright)
        self._fixed: tuple[Tensor, Tensor] | None = None  # `_layout`, `for_lens`

    @classmethod
    def usual_shape(cls, lens: Lens, size: Pair, fov: float | None = None) -> tuple[float, float]:
        """The field of view, rad, and H'/W' of a view of all that images of (H, W) show in the row
        of the principal point, or of `fov`."""
        if fov is None:
            across, _ = fields_of_view(lens, size)
            fov = cls.widest if cls.around else min(across, cls.usual_fov)
        return fov, size[0] / size[1] if cls.aspect is None else cls.aspect

    @in_full_precision
    def for_lens(self, lens: Lens | None, size: Pair) -> Self:
        # What the view covers takes most of the time of `to_view`.
        return self._with(_fixed=self._layout(check_lens(lens, size), size))

    def in_rig(self) -> Self:
        # Of a rig, a view without `fov` shows as much as its kind of map usually has.
        if getattr(self, "reach", None) is not None:
            raise ValueError("reach follows one lens: give a view of a rig its field of view, fov")
        fov = self.fov or self.usual_fov
        start = self._start(torch.zeros((), dtype=torch.float64))
        step = start.new_tensor([[2 * self.half_width(fov / 2) / self.size[1]]])
        return self._with(fov=fov, _fixed=(step, start))

    def to_plane(self, rays: Tensor) -> Tensor:
        """Unit vectors (..., 3) in the view's frame → the plane, (..., 2); NaN where it ends."""
        raise NotImplementedError

    def from_plane(self, points: Tensor) -> Tensor:
        """The plane, (..., 2) → unit vectors (..., 3) in the view's frame; NaN where it ends."""
        raise NotImplementedError

    def half_width(self, angle: float) -> float:
        """The x in the plane of a ray at an angle from the middle, to the right."""
        return angle

    # -- pixels and rays ----------------------------------------------------------------------

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        """Pixels (N or 1, ..., 2) of the view → unit vectors (N or 1, ..., 3) in the camera's
        frame; NaN where the view shows nothing. size: (H, W) of the images of N lenses."""
        step, middle = self._layout(lens, size)
        dim = points.dim()
        flat = (points - self._center(points)) * _row(step, dim) + _row(middle, dim)
        rays = self.from_plane(flat) @ self._turn(points).T
        return torch.where(self._shows(rays)[..., None], rays, torch.nan)

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        """Rays (N or 1, ..., 3), of any length, → pixels (N or 1, ..., 2) of the view, also outside
        of its size: the inverse of `to_rays`. NaN where the view shows nothing, and for rays 0."""
        has_length = (rays != 0).any(-1)
        rays = F.normalize(rays, dim=-1)
        return self._points(rays, has_length & self._shows(rays), lens, size)

    def _points(self, rays: Tensor, shown: Tensor, lens: Lens, size: Pair) -> Tensor:
        """`to_points` of unit vectors; NaN unless they are shown."""
        step, middle = self._layout(lens, size)
        # NaN must not reach the gradients.
        rays = torch.where(shown[..., None], rays, tensor_there(self.direction, rays))
        flat = self.to_plane(rays @ self._turn(rays))
        points = (flat - _row(middle, flat.dim())) / _row(step, flat.dim()) + self._center(flat)
        return torch.where(shown[..., None], points, torch.nan)

    def image_points(self, lens: Lens, size: Pair) -> Tensor:
        return check_sees(self.read_points(lens, size), self, lens, size)

    def read_points(self, lens: Lens, size: Pair) -> Tensor:
        """`image_points` of a view that may see nothing of the lens."""
        return as_map(self.to_image(self._finely(lens, size), lens, size))

    def to_image(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return self.place(lens, self.to_rays(points, lens, size), size)

    def to_view(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        rays = lens.unproject_points(points, size)
        return self._points(rays, self._shows(rays), lens, size)

    def goes_around(self, lens: Lens, size: Pair) -> Tensor | None:
        if not self.upright:
            return None
        around = self._layout(lens, size)[0][:, 0] * (self.size[1] + _SEAM) >= 2 * math.pi
        return around if not readable(around) or around.any() else None

    def rays(self, lens: Lens, size: Pair) -> Tensor:
        """The rays of the pixels, unit vectors (N, H', W', 3) in the camera's frame; 0 where the
        lens or the view sees nothing. size: (H, W) of the images."""
        return ray_channels(*self.pixel_rays(check_lens(lens, size), size)).movedim(1, -1)

    def place(self, lens: Lens, rays: Tensor, size: Pair) -> Tensor:
        """The pixels of images of (H, W) at which rays land; NaN where the view shows nothing."""
        shown = self._shows(rays)
        safe = torch.where(shown[..., None], rays, tensor_there(AXIS, rays))
        return torch.where(shown[..., None], lens.project_points(safe, size), torch.nan)

    def _shows(self, rays: Tensor) -> Tensor:
        """True for unit vectors (..., 3) within `theta_max`; False for NaN."""
        least = -1.0 if self.theta_max is None else math.cos(self.theta_max)
        return rays[..., 2] >= least - 1e-6

    def supersampling_of(self, lens: Lens, size: Pair) -> int:
        # It must not depend on the values of a lens, which a compiled graph does not have.
        if self.supersampling is not None:
            return self.supersampling
        shrinks = min(size) / min(self.size) * min(1.0, (self.fov or math.pi) / math.pi)
        return min(max(math.ceil(shrinks / _APART), 1), _USUAL_SUPERSAMPLING)

    def _center(self, like: Tensor) -> Tensor:
        return tensor_there([(side - 1) / 2 for side in self.size[::-1]], like)

    def _turn(self, like: Tensor) -> Tensor:
        """The rotation (3, 3) from the view's frame to the camera's."""
        return tensor_there([x for row in self._frame for x in row], like).reshape(3, 3)

    # -- what the view covers -----------------------------------------------------------------

    def _layout(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        """The length of a pixel in the plane, (N or 1, 1), and the middle of the view there, (N or
        1, 2)."""
        if self._fixed is not None:
            return self._fixed
        with no_gradients():
            return self._covered(lens.detach(), size)

    def _covered(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        """`_layout`, from where the lens sees."""
        start = self._start(lens.theta_max)
        if self.fov is not None:
            return start.new_tensor([[2 * self.half_width(self.fov / 2) / self.size[1]]]), start
        # Upright views are as wide as the lens sees on the horizon, if it sees that at all.
        horizon = torch.zeros_like(start)
        row = torch.where(self._sees(lens, horizon[None], size)[..., None], horizon, start)[:, 0]
        edge = row.new_tensor([self.half_width(self.usual_fov / 2), 0.0])
        begins = torch.stack(torch.broadcast_tensors(row, row, start, start), 1)
        ends = (row - edge, row + edge, self._highest(start, -1), self._highest(start, 1))
        goals = torch.stack(torch.broadcast_tensors(*ends), 1)
        limits = self._seen_ends(lens, begins, goals, size)
        left, right, upper, lower = *limits[:, :2, 0].unbind(1), *limits[:, 2:, 1].unbind(1)
        if self.around:
            left, right = torch.full_like(left, -math.pi), torch.full_like(right, math.pi)
        step = (right - left) / self.size[1]
        if not self.upright:
            step = torch.maximum(step, (lower - upper) / self.size[0])
        step = step.clamp(min=_LEAST_STEP)
        half = step * (self.size[0] / 2)
        first, last = upper + half, lower - half  # of the middles that show nothing unseen
        wanted = (horizon if self.around else start)[:, 1]
        y = torch.minimum(torch.maximum(wanted, first), last)
        y = torch.where(first <= last, y, (upper + lower) / 2)
        return step[:, None], torch.stack(((left + right) / 2, y), -1)

    def _start(self, like: Tensor) -> Tensor:
        """The point of the plane (1, 2) at `direction`, or at its nearest elevation that is not too
        steep for a map of the sphere."""
        if not self.upright:
            return like.new_zeros(1, 2)
        down = -sum(a * b for a, b in zip(self.direction, self.up, strict=True))
        elevation = max(-_STEEPEST, min(_STEEPEST, math.asin(max(-1.0, min(1.0, down)))))
        return self.to_plane(like.new_tensor([[0.0, math.sin(elevation), math.cos(elevation)]]))

    def _highest(self, start: Tensor, sign: int) -> Tensor:
        """The end of the column at `start`, (1, 2), upwards (-1) or downwards (1)."""
        if not self.upright:
            return start.new_tensor([[0.0, sign * self.half_width(self.usual_fov / 2)]])
        steepest = (0.0, sign * math.sin(_STEEPEST), math.cos(_STEEPEST))
        return self.to_plane(start.new_tensor([steepest]))

    def _seen_ends(self, lens: Lens, begins: Tensor, ends: Tensor, size: Pair) -> Tensor:
        """The last points of the plane that the images show on the ways from K points (N or 1, K,
        2) to K others, (N, K, 2)."""
        shares = torch.linspace(0, 1, _STEPS, dtype=begins.dtype, device=begins.device)

        def at(share: Tensor) -> Tensor:  # (N or 1, K, J) → (N or 1, K, J, 2)
            return begins[:, :, None] + (ends - begins)[:, :, None] * share[..., None]

        def sees(share: Tensor) -> Tensor:
            return self._sees(lens, at(share), size)

        def halved(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
            middle = (low + high) / 2
            inside = sees(middle)
            return torch.where(inside, middle, low), torch.where(inside, high, middle)

        # As a cumulative product, which ONNX lacks.
        count = ((~sees(shares[None, None])).int().cumsum(2) == 0).sum(2, keepdim=True)
        low, high = (shares[(count + k).clamp(0, _STEPS - 1)] for k in (-1, 0))
        low, _ = repeated(halved, torch.less, (low, high), _BISECTIONS)
        return at(low)[:, :, 0]

    def _sees(self, lens: Lens, points: Tensor, size: Pair) -> Tensor:
        """True where images of (H, W) show points (N or 1, ..., 2) of the plane, (N, ...)."""
        pixels = self.place(lens, self.from_plane(points) @ self._turn(points).T, size)
        x, y = pixels.unbind(-1)  # not `all`, as in `length_of`
        return (x >= -0.5) & (x <= size[1] - 0.5) & (y >= -0.5) & (y <= size[0] - 0.5)

    def extra_repr(self) -> str:
        shown = dict(fov=self.fov, theta_max=self.theta_max, supersampling=self.supersampling)
        options = [f"{name}={value:.4g}" for name, value in shown.items() if value is not None]
        for name, vector, usual in (("up", self.up, PICTURE_TOP),
                                    ("direction", self.direction, AXIS)):  # fmt: skip
            if vector != usual:
                options.append(f"{name}=({', '.join(f'{x:.4g}' for x in vector)})")
        return ", ".join([super().extra_repr(), *options])


def check_sees(points: Tensor, view: PixelView, lens: Lens, size: Pair) -> Tensor:
    """The points at which a view reads images of (H, W); ValueError if none is in any of them."""
    if readable(points) and points.numel():
        inside = (points > -1) & (points < tensor_there(size[::-1], points))
        if not inside.all(-1).any():
            raise ValueError(f"this view sees nothing of the lens: {view} of {lens}")
    return points


def sides(lens: Lens, size: Pair) -> Tensor:
    """The `side_angles` of one lens, (4,) rad; negative if the principal point lies beyond that
    side."""
    cx, cy = lens.center_in(size)[0].tolist()
    height, width = size
    past = (cx < -0.5, cy < -0.5, cx > width - 0.5, cy > height - 0.5)
    angles = lens.side_angles(size)[0]
    return torch.where(torch.tensor(past), -angles, angles)


def fields_of_view(lens: Lens, size: Pair) -> tuple[float, float]:
    """The horizontal and the vertical field of view up to θ_max in pictures of (H, W), rad."""
    end = lens.theta_max.item()
    left, top, right, bottom = sides(lens, size).clamp(-end, end).tolist()
    return min(left + right, 2 * math.pi), min(top + bottom, math.pi)


def _row(values: Tensor, dim: int) -> Tensor:
    """(N, K) → (N, 1, …, K) with `dim` dimensions."""
    return values.view(values.shape[0], *(1,) * (dim - 2), values.shape[1])
