"""Scenes in another frame: image, target and lens move together.

A scene becomes square, of a size, in one step from its picture: a part of it resized, turned about
the optical axis, or as another lens would have seen it. The image is averaged over areas. A target
is never mixed from several pixels: each new pixel takes the value of the nearest one. Where two are
equally near, the side alternates from pixel to pixel, so that the target is not shifted relative to
the image.
"""

from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor

from darswin.data.scenes.scene import Scene, nothing_of
from darswin.data.warping import Turn, area_resized, remap, turned_lens
from darswin.lens import Lens
from darswin.lens.pixels import as_map, pixel_angles
from darswin.lens.solve import length_of

# An image is read at up to so many points a pixel and axis, an odd number, so that one of them is
# the pixel's centre, and so close together, in pixels of the picture.
_MOST_POINTS = 5
_APART = 1.5
_RADII = 4096  # of a table
_NUDGE = 1e-3  # px, more than the rounding of places in float32


def resize_scene(
    scene: Scene, taken: tuple[int, int, int, int], size: int, mirrored: bool
) -> Scene:
    """A part (top, left, height, width) of a scene, or of its mirror image, as (size, size)."""
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
    """A part of a scene turned about its lens's optical axis, as (size, size)."""
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
    """A scene as another lens, radial and without `affine`, would have seen it, (size, size)."""
    exact, source = lens.to(torch.float64), scene.lens.to(torch.float64)
    last = exact.r_max.item()
    points = _points(source.r_max.item() / last)
    offset = _grid(size, points) - exact.center_in((size, size)).numpy()
    radius = np.sqrt(np.square(offset).sum(-1))
    # A table of θ, because few lenses have a closed inverse and an image has many radii.
    radii = np.linspace(0, last, _RADII)
    angles = exact.unproject(torch.from_numpy(radii)).numpy()
    theta = torch.from_numpy(np.interp(radius, radii, angles, right=np.nan))
    direction = torch.from_numpy(offset / np.maximum(radius, np.finfo(float).tiny)[..., None])
    if turn is not None:
        direction = direction @ torch.from_numpy(turn.matrix)
    height, width = scene.target.shape
    places = as_map(source.seen_pixels(theta[None], direction[None], (height, width)))[0]
    return _read(scene, places.to(torch.float32).numpy(), lens, size, points)


def _read(scene: Scene, places: np.ndarray, lens: Lens, size: int, points: int) -> Scene:
    """A scene read at the places (points · size, points · size, 2) of a picture's pixels."""
    image = remap(scene.image, places)
    if points > 1:
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    aside = _aside(size).astype(np.float32)
    centres = places[points // 2 :: points, points // 2 :: points].copy()
    centres += np.stack(np.meshgrid(aside, aside), -1)
    target = remap(scene.target, centres, cv2.INTER_NEAREST, nothing_of(scene.target))
    return Scene(image.reshape(size, size, -1), target, lens)


def _only_seen(scene: Scene) -> Scene:
    """Nothing is known of pixels beyond the lens's θ_max."""
    height, width = scene.target.shape
    lens = scene.lens
    if lens.is_radial:  # then radii tell, and no angle has to be found
        places = torch.from_numpy(_grid(height, 1)).to(lens.theta_max)
        beyond = (length_of(lens.from_pixels(places[None])) > lens.r_max[:, None, None])[0]
    else:
        beyond = _unseen(_ByValue(lens), (height, width))
    scene.target[beyond.numpy()] = nothing_of(scene.target)
    return scene


class _ByValue:
    """A lens, equal to others with the same numbers."""

    def __init__(self, lens: Lens):
        self.lens = lens

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByValue) and self.lens.same_as(other.lens)

    def __hash__(self) -> int:
        return hash((type(self.lens), self.lens.theta_max.item()))


@lru_cache(maxsize=8)  # since pictures often have one camera, whose angles take long to find
def _unseen(lens: _ByValue, size: tuple[int, int]) -> Tensor:
    """The pixels (H, W) that no ray of the lens reaches, as bool."""
    return pixel_angles(lens.lens, size)[0].isnan()


def _nearest(side: int, size: int) -> np.ndarray:
    """(size,): of a side of so many pixels, those nearest to the centres of `size` others."""
    centres = (np.arange(size) + 0.5) * side / size - 0.5
    return np.rint(centres + _aside(size)).astype(np.int64)


@lru_cache(maxsize=8)
def _aside(size: int) -> np.ndarray:
    """(size,): px by which the centre of a pixel is moved before the nearest one is taken.

    An even reduction puts every centre halfway between two pixels, and taking the upper one always
    would shift the whole target. Neighbours are moved in opposite directions, and so are pixels
    that mirror each other in the image's middle: the target of a mirrored picture is mirrored.
    """
    sign = (-1.0) ** np.arange(size // 2)
    return _NUDGE * np.concatenate((-sign, np.zeros(size % 2), sign[::-1]))


def _points(scale: float) -> int:
    """Points along an axis at which a pixel is read that is as large as `scale` others."""
    return min(_MOST_POINTS, 2 * int(np.ceil((scale / _APART - 1) / 2)) + 1) if scale > 1 else 1


@lru_cache(maxsize=8)
def _grid(size: int, points: int) -> np.ndarray:
    """(points · size, points · size, 2): x and y of so many points in each pixel and axis."""
    along = (np.arange(points * size) + 0.5) / points - 0.5
    return np.stack(np.meshgrid(along, along), -1)
