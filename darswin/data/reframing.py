"""Shows a sample in another way: cut, resized, turned, mirrored, or through another lens.

Every way is one map between the pixels of the old and the new picture, and the lens of the new one.
Each pixel of the new image is the mean over its area in the old one. Targets are never
interpolated: each pixel takes the value of the nearest one. If two pixels are equally near, the
side alternates from pixel to pixel, so that the target is not shifted relative to the image.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
import torch

from darswin.data.labels.labels import Labels, moved
from darswin.data.sample import Sample
from darswin.data.scenes.targets import nothing_of
from darswin.data.warping import Part, area_resized, picture_size, size_of_part, taken_part
from darswin.lens import Lens
from darswin.lens.orientation import rotated, upright
from darswin.lens.solve import direction_of
from darswin.utils.parameters import check
from darswin.utils.tasks import Fit

# An image is read at up to this many points per pixel and axis, and at this distance, in pixels of
# the picture.
_MOST_POINTS = 5
_APART = 1.5
_RADII = 4096  # entries of a table
_AZIMUTHS = 1024
_NUDGE = 1e-3  # px, more than the rounding of places in float32
_FAR = 1e5  # px, or the multiple of a radius, that leads beyond any picture
_ROUNDING = 1 + 1e-6  # of radii at θ_max
_MIRRORED = 2  # the EXIF orientation of a picture whose left and right are swapped


class Turn(NamedTuple):
    """A rotation by `angle` (rad, from x to y, so clockwise on a screen), then a swap of left and
    right if `mirrored`."""

    angle: float = 0.0
    mirrored: bool = False

    @property
    def matrix(self) -> np.ndarray:
        """The matrix (2, 2) for points relative to the principal point of a lens without affine."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        across = -1.0 if self.mirrored else 1.0
        return np.array([[across * cos, -across * sin], [sin, cos]])


STILL = Turn()


@dataclass(frozen=True)
class RandomTurns:
    """Random turns for augmentation.

    Args:
        flip: mirrors half of the images.
        rotate_deg: degrees in [0, 180]; the angle is uniform between minus and plus this value.

    Raises:
        ValueError: an angle out of range.
    """

    flip: bool = False
    rotate_deg: float = 0.0

    def __post_init__(self) -> None:
        check("rotate_deg", self.rotate_deg, 0 <= self.rotate_deg <= 180, "in [0, 180]")

    def draw(self, rng: np.random.Generator) -> Turn:
        """A random turn."""
        angle = rng.uniform(-1, 1) * math.radians(self.rotate_deg)
        return Turn(angle, bool(rng.random() < 0.5) and self.flip)


class Reframing:
    """The map between the pixels of a picture and those of a new one: `Moved` or `Warped`.

    Args:
        lens: the lens of the new picture, with its image_size.
        turn: about the optical axis.
        scale: the pixels of the old picture along a pixel of the new one.
        render: (H, W), the number of points along the sides at which an image is read, if it is not
            only resized. None means up to 5 points along each new pixel.
    """

    def __init__(self, lens: Lens, turn: Turn, scale: float, render: tuple[int, int] | None):
        self.lens, self.size, self._turn = lens, picture_size(lens), turn
        # An odd number, so that one of the points is the centre of the pixel.
        most = 2 * math.ceil((scale / _APART - 1) / 2) + 1
        points = min(_MOST_POINTS, most) if scale > 1 else 1
        self._render = render or (points * self.size[0], points * self.size[1])

    @property
    def mirrored(self) -> bool:
        """Whether left and right are swapped."""
        return self._turn.mirrored

    def to_new(self, points: np.ndarray) -> np.ndarray:
        """Pixels (x, y) of the old picture, (..., 2), in the new one; NaN where no ray lands."""
        raise NotImplementedError

    def to_old(self, points: np.ndarray) -> np.ndarray:
        """Pixels (x, y) of the new picture, (..., 2), in the old one: the inverse of `to_new`."""
        raise NotImplementedError

    def image(self, image: np.ndarray) -> np.ndarray:
        """The new image, (H', W', C), of (H, W, C)."""
        grid = (
            _centres(*sides).astype(np.float32)
            for sides in zip(self.size, self._render, strict=True)
        )
        x, y = self._places(*grid)
        return area_resized(cv2.remap(image, x, y, cv2.INTER_LINEAR), self.size)

    def target(self, target: np.ndarray) -> np.ndarray:
        """The new values (H', W') of the pixels of a target (H, W); unknown beyond θ_max."""
        x, y = self._places(*map(np.arange, self.size))
        down, across = map(_aside, self.size)
        (a, b), (c, d) = self._turn.matrix.T.tolist()
        x = np.rint(x + a * across + b * down[:, None])
        y = np.rint(y + c * across + d * down[:, None])
        height, width = target.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        target = np.asarray(target, target.dtype.newbyteorder("="))
        found = target.ravel().take((y * width + x).astype(np.intp), mode="clip")
        found[~inside] = nothing_of(target)
        return found

    def _places(self, y: np.ndarray, x: np.ndarray) -> Sequence[np.ndarray]:
        """`to_old` of the pixels at y (H,) and x (W,): x and y, (H, W), far outside for NaN."""
        raise NotImplementedError


def reframe(sample: Sample, reframing: Reframing) -> Sample:
    """A sample in another way; a class stays as it is, and `Labels` follow as `moved` says."""
    target = sample.target
    if isinstance(target, np.ndarray):
        target = reframing.target(target)
    elif isinstance(target, Labels):
        target = moved(target, reframing)
    return Sample(reframing.image(sample.image), target, reframing.lens)


def at_size(image: np.ndarray, lens: Lens, size: int, fit: Fit) -> tuple[np.ndarray, Lens]:
    """A picture (H, W, C) uint8 and its lens at a model's `size`, px.

    Args:
        lens: the lens, with the image_size of the picture.
        fit: "crop" cuts the longer side, "stretch" squashes it, and "whole" keeps the aspect ratio
            and gives the shorter side the size.

    Returns:
        (size, size, C) uint8, or a longer side with "whole"; and `lens_at_size`.

    Raises:
        ValueError: an unknown `fit`, or a picture with another aspect ratio than its lens.
    """
    picture_size(lens)  # raises ValueError for a lens without one
    whole = image.shape[0], image.shape[1]
    part = taken_part(whole, fit)
    moved = Moved(lens.in_picture(whole), part, size_of_part(part, size, fit))
    return moved.image(image), moved.lens


# -- a part of a picture ----------------------------------------------------------------------


class Moved(Reframing):
    """Shows a part of a picture at another size, after a turn about the optical axis.

    The pixels move by an affine map. They are sheared if they are oblong, so that the picture looks
    rotated through its lens. Pixels beyond θ_max stay in the image, but have no target.

    Args:
        lens: the lens that took the picture, with its image_size.
        part: top, left, height and width, px, in the turned picture, which keeps its size.
        size: (H, W) of the new picture. turn, render: see `Reframing`.
    """

    def __init__(
        self,
        lens: Lens,
        part: Part,
        size: tuple[int, int],
        turn: Turn = STILL,
        render: tuple[int, int] | None = None,
    ):
        turned, moves = _turned(lens, turn)
        top, left, height, width = part
        scale = max(height / size[0], width / size[1])
        super().__init__(turned.cropped(*part).resized(size), turn, scale, render)
        self._part = part
        # Pixels (x, y, 1) of the old picture become those of the part, and of the new picture.
        self._onto = moves - [[0, 0, left], [0, 0, top]]
        zoom = np.array([[size[1] / width], [size[0] / height]])
        self._matrix = zoom * self._onto
        self._matrix[:, 2:] += (zoom - 1) / 2

    def to_new(self, points: np.ndarray) -> np.ndarray:
        return points @ self._matrix[:, :2].T + self._matrix[:, 2]

    def to_old(self, points: np.ndarray) -> np.ndarray:
        return (points - self._matrix[:, 2]) @ np.linalg.inv(self._matrix[:, :2]).T

    def image(self, image: np.ndarray) -> np.ndarray:
        top, left, height, width = self._part
        if self._turn.angle and self._render != (height, width):
            return super().image(image)
        if self._turn.angle:  # the same, faster
            return area_resized(cv2.warpAffine(image, self._onto, (width, height)), self.size)
        if self._turn.mirrored:
            left = image.shape[1] - left - width
        image = area_resized(image[top : top + height, left : left + width], self.size)
        return np.ascontiguousarray(image[:, ::-1]) if self._turn.mirrored else image

    def _places(self, y: np.ndarray, x: np.ndarray) -> Sequence[np.ndarray]:
        back = cv2.invertAffineTransform(self._matrix).tolist()
        return [a * x + (b * y + c)[:, None] for a, b, c in back]

    def target(self, target: np.ndarray) -> np.ndarray:
        found = super().target(target)
        found[_unseen(self.lens)] = nothing_of(target)
        return found


def _turned(lens: Lens, turn: Turn) -> tuple[Lens, np.ndarray]:
    """The lens of a picture after a turn, and the matrix (2, 3) that moves a pixel (x, y, 1)."""
    moves = np.eye(2, 3)
    if turn.angle:
        lens, matrix = rotated(lens, turn.angle)
        moves = matrix.numpy()
    if turn.mirrored:
        moves = moves * [[-1.0], [1.0]] + [[0, 0, picture_size(lens)[1] - 1], [0, 0, 0]]
        lens = upright(lens, _MIRRORED)
    return lens, moves


def _unseen(lens: Lens) -> np.ndarray:
    """True for pixels (H, W) beyond θ_max."""
    height, width = picture_size(lens)
    u, v = _flat(lens, np.arange(height), np.arange(width), STILL.matrix)
    radius = np.sqrt(u * u + v * v)
    if lens.is_radial:
        return radius > _ROUNDING * lens.r_max.item()
    # θ_max lands on a curve around the principal point.
    azimuth = torch.linspace(-torch.pi, torch.pi, _AZIMUTHS)[None]
    ray = direction_of(azimuth)
    last = lens.theta_max[:, None].expand_as(azimuth)
    x, y = (lens.r_max * ray + lens.offset(last, ray))[0].numpy().T
    edge = _ROUNDING * np.sqrt(x * x + y * y)
    unseen = radius > edge.max()
    near = ~unseen & (radius > edge.min())
    last = np.interp(np.arctan2(v[near], u[near]), np.arctan2(y, x), edge, period=2 * np.pi)
    unseen[near] = radius[near] > last
    return unseen


# -- through another lens ---------------------------------------------------------------------


class Warped(Reframing):
    """Shows a picture as another lens would have seen it; black beyond the θ_max of either lens.

    Args:
        own: the lens that took the picture, with its image_size.
        lens: the other lens, with the image_size of the new picture.
        turn: about the optical axis; the other lens stays as it is. render: see `Reframing`.
    """

    def __init__(
        self, own: Lens, lens: Lens, turn: Turn = STILL, render: tuple[int, int] | None = None
    ):
        super().__init__(lens, turn, (own.r_max / lens.r_max).item(), render)
        self._own = own

    def to_new(self, points: np.ndarray) -> np.ndarray:
        return _seen_by(self.lens, self._own, points, self._turn.matrix)

    def to_old(self, points: np.ndarray) -> np.ndarray:
        return _seen_by(self._own, self.lens, points, self._turn.matrix.T)

    def _places(self, y: np.ndarray, x: np.ndarray) -> Sequence[np.ndarray]:
        if not self.lens.is_radial:
            places = self.to_old(np.stack(np.meshgrid(x, y), -1))
            return np.moveaxis(np.nan_to_num(places, nan=_FAR).astype(np.float32), -1, 0).copy()
        last, ratios, angles = self._curves
        u, v = _flat(self.lens, y, x, self._turn.matrix.T)
        radius = np.sqrt(u * u + v * v)
        share = radius * ((_RADII - 1) / last)
        whole = np.floor(share)
        share -= whole
        index = whole.astype(np.intp)

        def at(table: np.ndarray) -> np.ndarray:
            return table[0].take(index, mode="clip") + table[1].take(index, mode="clip") * share

        ratio, offset = at(ratios), np.zeros((2, 1, 1), np.float32)
        if angles is not None:
            ray = np.stack((u, v), -1) / np.maximum(radius, _NUDGE)[..., None]
            rays = torch.from_numpy(at(angles))[None], torch.from_numpy(ray)[None]
            offset = np.moveaxis(self._own.offset(*rays)[0].numpy().astype(np.float32), -1, 0)
        u, v = u * ratio + offset[0], v * ratio + offset[1]
        if self._own.affine is not None:
            u, v = (a * u + b * v for a, b in self._own.affine[0].tolist())
        cx, cy = self._own.center_in()[0].tolist()
        u += cx
        v += cy
        return u, v

    @cached_property
    def _curves(self) -> tuple[float, np.ndarray, np.ndarray | None]:
        """The radius of the last ray that both lenses see in the new picture; and at equally spaced
        radii up to it, the radius in the old picture as a multiple, and θ if the old lens is not
        radial: values and the steps between them, (2, K).

        They are computed once, because an image has many more radii. Radii beyond lead outside.
        """
        last = torch.minimum(self._own.theta_max, self.lens.theta_max)
        theta = torch.linspace(0, 1, _RADII)[None] * last
        new, old = (lens.project(theta)[0].numpy() for lens in (self.lens, self._own))
        radii = np.linspace(0, new[-1], _RADII)
        ratios = np.interp(radii, new, old)
        ratios[1:] /= radii[1:]
        ratios[0] = old[1] / new[1]
        tables = [ratios] if self._own.is_radial else [ratios, np.interp(radii, new, theta[0])]
        ratio, *angle = (np.stack((k, np.diff(k, append=k[-1]))).astype(np.float32) for k in tables)
        ratio[0, -1] = _FAR
        return new[-1].item(), ratio, angle[0] if angle else None


def _seen_by(lens: Lens, own: Lens, points: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """The pixels (..., 2) of `lens` for those of `own`, by their rays after a turn."""
    lens, own = lens.to(torch.float64), own.to(torch.float64)
    theta, direction = own.theta_and_direction(
        torch.from_numpy(np.asarray(points, np.float64))[None]
    )
    theta = torch.where(own.sees(theta), theta, torch.nan)
    return lens.seen_pixels(theta, direction @ torch.from_numpy(turn.T))[0].numpy()


# -- points in pixels -------------------------------------------------------------------------


def _centres(size: int, count: int) -> np.ndarray:
    """`count` equally spaced points of a side, (count,)."""
    return (np.arange(count) + 0.5) * (size / count) - 0.5


def _aside(size: int) -> np.ndarray:
    """The offset of each place, px, before the nearest pixel is chosen, (size,).

    An even reduction puts every centre halfway between two pixels. If all took the upper one, the
    whole target would be shifted. So neighbours move in opposite directions. Pixels at mirrored
    places do so too, so that the target of a mirrored picture is mirrored.
    """
    sign = (-1.0) ** np.arange(size // 2)
    return _NUDGE * np.concatenate((-sign, np.zeros(size % 2), sign[::-1]))


def _flat(lens: Lens, y: np.ndarray, x: np.ndarray, turn: np.ndarray) -> list:
    """The points (u, v) around the principal point, before `affine` and after a turn, of the pixels
    at y (H,) and x (W,): two arrays (H, W) float32."""
    cx, cy = lens.center_in()[0].tolist()
    x, y = (x - cx).astype(np.float32), (y - cy).astype(np.float32)[:, None]
    if lens.affine is not None:
        turn = turn @ np.linalg.inv(lens.affine[0].double().numpy())
    return [a * x + b * y for a, b in turn.tolist()]
