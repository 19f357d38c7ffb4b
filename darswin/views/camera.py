"""What another camera at the same place would see: another lens, and a turn about its axis."""

import math
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from darswin.lens import Lens
from darswin.lens.pixels import pixel_rays
from darswin.lens.solve import vector_of
from darswin.ops.checks import check_pair, readable
from darswin.views.base import Pair, PerChannel
from darswin.views.pixels import PixelView, check_supersampling
from darswin.views.turn import STILL, Turn, as_turn

_MOST, _APART = 5, 1.5  # points along a pixel, and pixels of the picture between them
_RADII = 4096  # entries of a table
_NUDGE = 1e-3  # px, of a radius that is not 0
_FAR = 1e5  # px, or the multiple of a radius, that leads beyond any picture


class CameraView(PixelView):
    """The picture of another camera at the same place; 0 beyond θ_max of either lens.

    `CameraView(lens, size)(images, own)` resamples images of `own` lenses as `lens` would see
    them. Gradients go to the images and to both lenses.

    Args:
        lens: of the other camera, one lens or one for each image.
        size: (H', W') of its pictures; None means its image_size.
        turn: about the optical axis; the other lens stays as it is.
        supersampling: the points along each side of a pixel at which the image is read, 1 to 16.
            None means an odd number up to 5 that suits the radii of the lenses.
        mean, std: the arguments of `View`.

    Raises:
        TypeError: the lens is no `Lens`, or the turn no `Turn`.
        ValueError: the size is missing, or a number is out of range.
    """

    size: Pair

    def __init__(
        self,
        lens: Lens,
        size: Pair | None = None,
        turn: Turn = STILL,
        *,
        supersampling: int | None = None,
        mean: PerChannel | None = 0.0,
        std: PerChannel | None = 1.0,
    ):
        if not isinstance(lens, Lens):
            raise TypeError(f"lens must be a darswin.lens.Lens, got {type(lens).__name__}")
        size = picture_size(lens) if size is None else check_pair("size", size, 1)
        super().__init__(size, mean=mean, std=std)
        check_supersampling(supersampling)
        self.lens, self.turn, self.supersampling = lens, as_turn(turn), supersampling

    def to_rays(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return vector_of(*self._seen(self._like(lens), points))

    def to_points(self, rays: Tensor, lens: Lens, size: Pair) -> Tensor:
        matrix = self._matrix(rays)
        flat = torch.cat((rays[..., :2] @ matrix.T, rays[..., 2:]), -1)
        return self._like(lens).project_points(flat, self.size)

    def to_image(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        return lens.seen_pixels(*self._seen(self._like(lens), points), size)

    def to_view(self, points: Tensor, lens: Lens, size: Pair) -> Tensor:
        theta, direction = lens.theta_and_direction(points, size)
        theta = torch.where(lens.sees(theta), theta, torch.nan)
        return self._like(lens).seen_pixels(theta, direction @ self._matrix(theta).T, self.size)

    def pixel_rays(self, lens: Lens, size: Pair) -> tuple[Tensor, Tensor]:
        theta, direction = pixel_rays(self._like(lens), self.size)
        theta = torch.where(lens.sees(theta), theta, torch.nan)
        return theta, direction @ self._matrix(theta)

    def in_rig(self) -> Self:
        return self._with(lens=self.lens.detach().to("cpu", torch.float64))

    def camera(self, lens: Lens, size: Pair) -> Lens:
        return self.lens

    def supersampling_of(self, lens: Lens, size: Pair) -> int:
        if self.supersampling is not None:
            return self.supersampling
        if not readable(lens.theta_max):
            raise ValueError("a graph does not know its lens: give a supersampling to CameraView")
        scales = lens.r_max / self.lens.r_max.to(lens.theta_max)
        return points_along(max(scales.tolist(), default=0.0))

    def _seen(self, own: Lens, points: Tensor) -> tuple[Tensor, Tensor]:
        """θ, NaN where no ray lands, and (cos φ, sin φ) in the frame of the images."""
        theta, direction = own.theta_and_direction(points, self.size)
        theta = torch.where(own.sees(theta), theta, torch.nan)
        return theta, direction @ self._matrix(theta)

    def _like(self, lens: Lens) -> Lens:
        return self.lens.to(lens.theta_max.device, lens.theta_max.dtype)

    def _matrix(self, like: Tensor) -> Tensor:
        return torch.from_numpy(self.turn.matrix).to(like.device, like.dtype)

    # -- of one lens ----------------------------------------------------------------------------

    def points_read(self, lens: Lens, size: Pair) -> np.ndarray:
        if not self.lens.is_radial:
            return super().points_read(lens, size)
        return self._points(lens, size, *centres(self, lens, size))

    def points_of_target(self, lens: Lens, size: Pair) -> np.ndarray:
        if not self.lens.is_radial:
            return super().points_of_target(lens, size)
        return self._points(lens, size, *map(np.arange, self.size))

    def _points(self, lens: Lens, size: Pair, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """`to_image` of the pixels at y (H,) and x (W,) of a radial lens, (H, W, 2) float32, far
        outside for NaN: by tables along the radius, because a picture has many more radii."""
        last, ratios, angles = self._curves(lens)
        u, v = flat_points(self.lens, self.size, y, x, self.turn.matrix.T)
        radius = u * u
        radius += v * v
        np.sqrt(radius, out=radius)
        share = radius * ((_RADII - 1) / last)
        whole = np.floor(share)
        share -= whole
        index = whole.astype(np.intp)

        def at(table: np.ndarray) -> np.ndarray:
            values = table[1].take(index, mode="clip")
            values *= share
            values += table[0].take(index, mode="clip")
            return values

        ratio = at(ratios)
        if angles is not None:
            ray = np.stack((u, v), -1) / np.maximum(radius, _NUDGE)[..., None]
            rays = torch.from_numpy(at(angles))[None], torch.from_numpy(ray)[None]
            offset = np.moveaxis(lens.to(torch.float32).offset(*rays)[0].numpy(), -1, 0)
        u *= ratio
        v *= ratio
        if angles is not None:
            u, v = u + offset[0], v + offset[1]
        if lens.affine is not None:
            u, v = (a * u + b * v for a, b in lens.affine[0].tolist())
        points = np.empty((2, *u.shape), np.float32)
        for row, flat, center in zip(points, (u, v), lens.center_in(size)[0].tolist(), strict=True):
            np.add(flat, center, out=row)
        return np.moveaxis(points, 0, -1)

    def _curves(self, own: Lens) -> tuple[float, np.ndarray, np.ndarray | None]:
        """The radius of the last ray in the new picture, up to its corners, that both lenses see;
        and at equally spaced radii up to it, the radius in the old picture as a multiple, and θ if
        the old lens is not radial: values and the steps between them, (2, K). Radii beyond lead
        outside."""
        new_lens = self._like(own)
        y, x = (np.array((-0.5, side - 0.5)) for side in self.size)
        corners = np.hypot(*flat_points(self.lens, self.size, y, x, STILL.matrix))
        in_corner = new_lens.unproject(corners.max().item())  # NaN beyond θ_max
        last = torch.fmin(torch.minimum(own.theta_max, new_lens.theta_max), in_corner)
        theta = torch.linspace(0, 1, _RADII, dtype=own.theta_max.dtype)[None] * last
        new, old = (lens.project(theta)[0].detach().numpy() for lens in (new_lens, own))
        radii = np.linspace(0, new[-1], _RADII)
        ratios = np.interp(radii, new, old)
        ratios[1:] /= radii[1:]
        ratios[0] = old[1] / new[1]
        tables = [ratios] if own.is_radial else [ratios, np.interp(radii, new, theta[0].numpy())]
        ratio, *angle = (np.stack((k, np.diff(k, append=k[-1]))).astype(np.float32) for k in tables)
        ratio[0, -1] = _FAR
        return new[-1].item(), ratio, angle[0] if angle else None

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, lens={self.lens}, turn={self.turn}"


def points_along(scale: float) -> int:
    """The number of points along a pixel of the view that is as long as `scale` of the picture: an
    odd one, so that one of them is the centre."""
    return min(_MOST, 2 * math.ceil((scale / _APART - 1) / 2) + 1) if scale > 1 else 1


def picture_size(lens: Lens) -> Pair:
    """(H, W) of the pictures of one lens; ValueError if it does not know it."""
    if lens.image_size is None:
        raise ValueError("a lens that follows its picture needs an image_size")
    height, width = lens.image_size[0].tolist()
    return round(height), round(width)


def centres(view: PixelView, lens: Lens, size: Pair) -> list[np.ndarray]:
    """y and x of the points of a view at which it reads images of (H, W)."""
    each = view.supersampling_of(lens, size)
    return [(np.arange(each * side) + 0.5) * (1 / each) - 0.5 for side in view.size or size]


def flat_points(lens: Lens, size: Any, y: np.ndarray, x: np.ndarray, turn: np.ndarray) -> list:
    """The points (u, v) around the principal point, before `affine` and after a turn, of the pixels
    at y (H,) and x (W,): two arrays (H, W) float32."""
    cx, cy = lens.center_in(size)[0].tolist()
    x, y = (x - cx).astype(np.float32), (y - cy).astype(np.float32)[:, None]
    if lens.affine is not None:
        turn = turn @ np.linalg.inv(lens.affine[0].detach().double().numpy())
    return [a * x + b * y for a, b in turn.tolist()]
