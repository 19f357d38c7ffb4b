"""A part of the picture at another size, turned or mirrored: the pixels move by an affine map."""

import numpy as np
import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.orientation import rotated, upright
from darswin.lens.pixels import pixel_rays
from darswin.lens.solve import direction_of
from darswin.ops.checks import as_int, check_pair
from darswin.views.base import Pair, PerChannel
from darswin.views.camera import centres, flat_points, picture_size, points_along
from darswin.views.pixels import PixelView
from darswin.views.remap import Remap
from darswin.views.turn import STILL, Turn, as_turn

Part = tuple[int, int, int, int]  # top, left, height, width

_AZIMUTHS = 1024
_ROUNDING = 1 + 1e-6  # of radii at θ_max
_MIRRORED = 2  # the EXIF orientation of a picture whose left and right are swapped


class CropView(PixelView):
    """A part of a picture at another size, after a turn about the optical axis.

    The pixels move by an affine map. They are sheared if they are oblong, so that the picture looks
    rotated through its lens. `camera` is the lens of the new picture. An array is resized by the
    areas of pixels. Pixels beyond θ_max stay in the picture, but have no label.

    Args:
        part: top, left, height and width, px, in the turned picture, which keeps its size. Beyond
            the picture, the view is 0.
        size: (H', W') of the new picture. turn: about the optical axis.
        each_pixel: a rotated picture is read once for each pixel of the part. Otherwise it is read
            at up to 5 points along each new pixel.
        mean, std: the arguments of `View`.

    Raises:
        TypeError: the part is not four ints, the size not two, or the turn no `Turn`.
        ValueError: a side is below 1.
    """

    size: Pair

    def __init__(
        self,
        part: Part,
        size: Pair,
        turn: Turn = STILL,
        *,
        each_pixel: bool = False,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        super().__init__(check_pair("size", size, 1), mean=mean, std=std)
        ints = [side for value in part if (side := as_int(value)) is not None]
        if len(ints) != 4 or len(part) != 4:
            raise TypeError(f"part must be four ints, top, left, height and width, got {part}")
        height, width = check_pair("height and width of the part", ints[2:], 1)
        self.part: Part = (ints[0], ints[1], height, width)
        self.turn, self.each_pixel = as_turn(turn), each_pixel

    def camera(self, lens: Lens, size: Pair) -> Lens:
        return self._turned(lens, size)[0].cropped(*self.part).resized(self.size)

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return lens.unproject_points(self.to_image(points, lens, size), size)

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        return self.to_view(lens.project_points(rays, size), lens, size)

    def to_image(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        turns, moves = self._affine(lens, size, points)
        return torch.einsum("nij,n...j->n...i", torch.linalg.inv(turns), points - moves)

    def to_view(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        turns, moves = self._affine(lens, size, points)
        return torch.einsum("nij,n...j->n...i", turns, points) + moves

    def pixel_rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        theta, direction = pixel_rays(self.camera(lens, size), self.size)
        turn = torch.from_numpy(self.turn.matrix).to(direction.device, direction.dtype)
        return theta, direction @ turn

    def supersampling_of(self, lens: Lens, size: Pair) -> int:
        return points_along(max(p / s for p, s in zip(self.part[2:], self.size, strict=True)))

    def _turned(self, lens: Lens, size: Pair) -> tuple[Lens, np.ndarray]:
        """The lens of a picture after the turn, and the matrix (2, 3) that moves a pixel (x, y,
        1)."""
        if lens.image_size is None:
            lens = lens.replace(image_size=lens.theta_max.new_tensor([size]))
        moves = np.eye(2, 3)
        if self.turn.angle:
            lens, matrix = rotated(lens, self.turn.angle)
            moves = matrix.numpy()
        if self.turn.mirrored:
            moves = moves * [[-1.0], [1.0]] + [[0, 0, size[1] - 1], [0, 0, 0]]
            lens = upright(lens, _MIRRORED)
        return lens, moves

    def _matrix(self, lens: Lens, size: Pair) -> np.ndarray:
        """The matrix (2, 3) that moves a pixel (x, y, 1) of one lens to the new picture."""
        top, left, height, width = self.part
        zoom = np.array([[self.size[1] / width], [self.size[0] / height]])
        moves = self._turned(lens, size)[1] - [[0, 0, left], [0, 0, top]]
        return zoom * moves + (zoom - 1) / 2 * [[0, 0, 1]]

    def _affine(self, lens: Lens, size: Pair, like: Tensor) -> tuple[Tensor, Tensor]:
        """`_matrix` of N lenses for points (N, ..., 2): (N, 2, 2), and (N, …, 2)."""
        # Without a rotation, it is the same for all lenses, and the graph may not know how many.
        each = [lens[k] for k in range(len(lens))] if self.turn.angle else [lens]
        matrices = np.array([self._matrix(of_lens, size) for of_lens in each]).reshape(-1, 2, 3)
        matrix = torch.from_numpy(matrices).to(like.device, like.dtype)
        return matrix[..., :2], matrix[..., 2].reshape(len(each), *(1,) * (like.dim() - 2), 2)

    # -- of one lens ----------------------------------------------------------------------------

    def picture(self, picture: np.ndarray, remap: Remap) -> np.ndarray:
        import cv2  # models, which import views, do not need it

        from darswin.utils.resize import area_resized

        top, left, height, width = self.part
        below, right = remap.size[0] - top - height, remap.size[1] - left - width
        if not self.each_pixel if self.turn.angle else min(top, left, below, right) < 0:
            return remap.sampled(picture)
        if picture.dtype == np.float16:  # OpenCV has none
            return self.picture(picture.astype(np.float32), remap).astype(picture.dtype)
        if self.turn.angle:
            whole = CropView(self.part, (height, width), self.turn)
            onto = whole._matrix(remap.some_lens, remap.size)
            resized = area_resized(cv2.warpAffine(picture, onto, (width, height)), self.size)
        else:
            if self.turn.mirrored:
                left = picture.shape[1] - left - width
            resized = area_resized(picture[top : top + height, left : left + width], self.size)
            resized = resized[:, ::-1] if self.turn.mirrored else resized
        return np.ascontiguousarray(resized).reshape(*self.size, *picture.shape[2:])

    def points_read(self, lens: Lens, size: Pair) -> np.ndarray:
        return self._points(lens, size, *centres(self, lens, size))

    def points_of_target(self, lens: Lens, size: Pair) -> np.ndarray:
        points = self._points(lens, size, *map(np.arange, self.size))
        points[_unseen(self.camera(lens, size))] = np.nan
        return points

    def _points(self, lens: Lens, size: Pair, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """`to_image` of the pixels at y (H,) and x (W,) for one lens, (H, W, 2)."""
        turn, moves = np.split(self._matrix(lens, size), [2], 1)
        back = np.linalg.inv(turn)
        rows = zip(back.tolist(), (-back @ moves).ravel().tolist(), strict=True)
        return np.stack([a * x + (b * y + c)[:, None] for (a, b), c in rows], -1)

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, part={self.part}, turn={self.turn}"


def _unseen(lens: Lens) -> np.ndarray:
    """True for pixels (H, W) beyond θ_max."""
    size = picture_size(lens)
    u, v = flat_points(lens, size, np.arange(size[0]), np.arange(size[1]), STILL.matrix)
    radius = np.sqrt(u * u + v * v)
    if lens.is_radial:
        return radius > _ROUNDING * lens.r_max.item()
    # θ_max lands on a curve around the principal point.
    azimuth = torch.linspace(-torch.pi, torch.pi, _AZIMUTHS)[None]
    ray = direction_of(azimuth).to(lens.theta_max)
    last = lens.theta_max[:, None].expand_as(azimuth)
    x, y = (lens.r_max * ray + lens.offset(last, ray))[0].numpy().T
    edge = _ROUNDING * np.sqrt(x * x + y * y)
    unseen = radius > edge.max()
    near = ~unseen & (radius > edge.min())
    last = np.interp(np.arctan2(v[near], u[near]), np.arctan2(y, x), edge, period=2 * np.pi)
    unseen[near] = radius[near] > last
    return unseen
