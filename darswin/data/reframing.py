"""Resizes, rotates and warps scenes: image, target and lens move together.

A picture becomes a square image in one resampling step. The image is averaged over areas. Targets
are never interpolated: each new pixel takes the value of the nearest one. If two pixels are equally
near, the side alternates from pixel to pixel, so that the target is not shifted relative to the
image.
"""

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from darswin.data.scenes.scene import Scene
from darswin.data.scenes.targets import nothing_of
from darswin.data.warping import Turn, area_resized, remap, turned_lens
from darswin.lens import Lens
from darswin.lens.pixels import as_map, pixel_angles
from darswin.lens.solve import length_of

# An image is read at up to this many points per pixel and axis, and at this distance, in pixels of
# the picture. The number is odd so that one of the points is the centre of the pixel.
_MOST_POINTS = 5
_APART = 1.5
_RADII = 4096  # entries of a table
_NUDGE = 1e-3  # px, more than the rounding of places in float32


def resize_scene(
    scene: Scene, taken: tuple[int, int, int, int], size: int, mirrored: bool
) -> Scene:
    """A part (top, left, height, width) of a scene or of its mirror image, at (size, size)."""
    image, target, lens = scene
    if mirrored:
        lens = turned_lens(lens, Turn(0.0, True))[0]
        image, target = image[:, ::-1], target[:, ::-1]
    top, left, height, width = taken
    image, target = (a[top : top + height, left : left + width] for a in (image, target))
    image = area_resized(np.ascontiguousarray(image), (size, size))
    down, across = (_nearest(side, size) for side in (height, width))
    lens = lens.cropped(*taken).resized((size, size))
    return _only_seen(Scene(image, target[down[:, None], across], lens))


def turn_scene(scene: Scene, turn: Turn, taken: tuple[int, int, int, int], size: int) -> Scene:
    """A part of a scene after a turn about the optical axis, at (size, size)."""
    lens, matrix = turned_lens(scene.lens, turn)
    top, left, height, width = taken
    scale = np.array([width, height]) / size
    back = np.linalg.inv(matrix[:, :2])
    points = _points(max(height, width) / size)
    places = _grid(size, points) * scale + (scale - 1) / 2 + (left, top)
    places = (places - matrix[:, 2]) @ back.T
    lens = lens.cropped(*taken).resized((size, size))
    return _only_seen(_read(scene, places.astype(np.float32), lens, size, points))


def warp_scene(scene: Scene, lens: Lens, size: int, turn: Turn | None = None) -> Scene:
    """A scene as another radial lens without `affine` would have seen it, at (size, size)."""
    places, points = _warped(scene.target.shape, scene.lens, lens, size, turn)
    return _read(scene, places, lens, size, points)


def warp_picture(
    image: np.ndarray, source: Lens, lens: Lens, size: int, turn: Turn | None = None
) -> np.ndarray:
    """The image (H, W, C) of `source` as `warp_scene` warps the image of a scene."""
    places, points = _warped(image.shape[:2], source, lens, size, turn)
    return _read_image(image, places, size, points)


def _warped(
    shape: tuple[int, ...], own: Lens, lens: Lens, size: int, turn: Turn | None
) -> tuple[np.ndarray, int]:
    """The places in a picture (H, W) of `own` that `lens` sees, and the points in each pixel."""
    exact, source = lens.to(torch.float64), own.to(torch.float64)
    last = exact.r_max.item()
    points = _points(source.r_max.item() / last)
    offset = _grid(size, points) - exact.center_in((size, size)).numpy()
    radius = np.sqrt(np.square(offset).sum(-1))
    # A table of θ, because most lenses need an iteration to invert, and an image has many radii.
    radii = np.linspace(0, last, _RADII)
    angles = exact.unproject(torch.from_numpy(radii)).numpy()
    theta = torch.from_numpy(np.interp(radius, radii, angles, right=np.nan))
    direction = torch.from_numpy(offset / np.maximum(radius, np.finfo(float).tiny)[..., None])
    if turn is not None:
        direction = direction @ torch.from_numpy(turn.matrix)
    height, width = shape
    places = as_map(source.seen_pixels(theta[None], direction[None], (height, width)))[0]
    return places.to(torch.float32).numpy(), points


def _read(scene: Scene, places: np.ndarray, lens: Lens, size: int, points: int) -> Scene:
    """A scene at the places (points · size, points · size, 2) in a picture."""
    aside = _aside(size).astype(np.float32)
    centres = places[points // 2 :: points, points // 2 :: points].copy()
    centres += np.stack(np.meshgrid(aside, aside), -1)
    target = remap(scene.target, centres, cv2.INTER_NEAREST, nothing_of(scene.target))
    return Scene(_read_image(scene.image, places, size, points), target, lens)


def _read_image(image: np.ndarray, places: np.ndarray, size: int, points: int) -> np.ndarray:
    """The mean over the points of each pixel, (size, size, C)."""
    image = remap(image, places)
    if points > 1:
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    return image.reshape(size, size, -1)


def _only_seen(scene: Scene) -> Scene:
    """The scene with unknown targets beyond θ_max."""
    height, width = scene.target.shape
    lens = scene.lens
    if lens.is_radial:  # radii are enough, and no angle has to be computed
        places = torch.from_numpy(_grid(height, 1)).to(lens.theta_max)
        beyond = (length_of(lens.from_pixels(places[None])) > lens.r_max[:, None, None])[0]
    else:
        beyond = _unseen(_ByValue(lens), (height, width))
    scene.target[beyond.numpy()] = nothing_of(scene.target)
    return scene


class _ByValue:
    """A lens that equals others with the same numbers."""

    def __init__(self, lens: Lens):
        self.lens = lens

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.lens.same_as(other.lens)

    def __hash__(self) -> int:
        return hash((type(self.lens), self.lens.theta_max.item()))


@lru_cache(maxsize=8)  # pictures often have one camera, and its angles take long to compute
def _unseen(lens: _ByValue, size: tuple[int, int]) -> Tensor:
    """True for pixels (H, W) that no ray of the lens reaches."""
    return pixel_angles(lens.lens, size)[0].isnan()


def _nearest(side: int, size: int) -> np.ndarray:
    """The pixels of a side that are nearest to the centres of `size` new pixels, (size,)."""
    centres = (np.arange(size) + 0.5) * side / size - 0.5
    return np.rint(centres + _aside(size)).astype(np.int64)


@lru_cache(maxsize=8)
def _aside(size: int) -> np.ndarray:
    """The offset of each centre, px, before the nearest pixel is chosen, (size,).

    An even reduction puts every centre halfway between two pixels. If all took the upper one, the
    whole target would be shifted. So neighbours move in opposite directions. Pixels at mirrored
    places do so too, so that the target of a mirrored picture is mirrored.
    """
    sign = (-1.0) ** np.arange(size // 2)
    return _NUDGE * np.concatenate((-sign, np.zeros(size % 2), sign[::-1]))


def _points(scale: float) -> int:
    """The number of points along an axis for a pixel that covers `scale` pixels of the picture."""
    return min(_MOST_POINTS, 2 * int(np.ceil((scale / _APART - 1) / 2)) + 1) if scale > 1 else 1


@lru_cache(maxsize=8)
def _grid(size: int, points: int) -> np.ndarray:
    """The x and y of the points in each pixel, (points · size, points · size, 2)."""
    along = (np.arange(points * size) + 0.5) / points - 0.5
    return np.stack(np.meshgrid(along, along), -1)
