"""A data set of wide-angle images that are made from ordinary pictures."""

import math
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from darswin.data.lens_distributions import LensDistribution
from darswin.data.pictures import Source
from darswin.data.reframing import warp_picture
from darswin.data.samples import Draw, Samples
from darswin.data.warping import Framing, Turn, area_resized, remap, taken_part
from darswin.lens import Lens, Perspective
from darswin.lens.pixels import OUTSIDE, radial_reprojection
from darswin.utils.angles import degrees_hint

# The paper's pictures, 384 px wide, have a focal length of 9 px.
PAPER_FOV = 2 * math.atan(192 / 9)


class WideAngle(Samples):
    """Pictures seen through random lenses: `dataset[i]` is (image, lens, label).

    Each picture is treated as a perspective view whose width spans `fov`. It is warped to `render`
    pixels through a lens with the same field of view, whose circle touches the sides of the image.
    The image is then reduced to `size` by averaging areas. It is black beyond the field of view.

    Args:
        source: the pictures. lenses: the distribution of lenses.
        size: px, H = W of the images. render: px, their size before the reduction; at least `size`.
        fov: rad, the full field of view, below π.
        picture_size: px, the width to which larger pictures are reduced before the warp.
        framing: "crop", or "stretch" as in the authors' code.
        options: mean, std, turns, lens_augmentation, augment, erase, seed and skip_broken, as
            `Calibrated` takes them. With lens_augmentation, an image of `render` px through a lens
            of `lenses` is warped again, as another camera would have seen it.

    Raises:
        ValueError: sizes or angles out of range.

    Source: DarSwin, ICCV 2023, sec. 5.1.
    """

    source: Source

    def __init__(
        self,
        source: Source,
        lenses: LensDistribution,
        *,
        size: int = 64,
        render: int = 224,
        fov: float = PAPER_FOV,
        picture_size: int = 384,
        framing: Framing = "crop",
        **options: Any,
    ):
        if not 0 < size <= render:
            raise ValueError(f"sizes must be 0 < size ≤ render, got {size} and {render}")
        if not 0 < fov < math.pi:
            raise ValueError(f"fov must be in (0, π), got {fov}{degrees_hint(fov)}")
        super().__init__(source, size=size, framing=framing, **options)
        self.lenses, self.fov = lenses, fov
        self.render, self.picture_size = render, picture_size

    def _seen(self, draw: Draw) -> tuple[np.ndarray, Lens, int]:
        picture, label = self.source[draw.picture]
        lens = self._first_lens(draw)
        turn = self._turn(draw)  # leaves the lens as it is, which is round and in the middle
        if self.lens_augmentation is None:
            return self.through(lens, picture, turn), lens, label
        image, other = self._rendered(lens, picture, turn), self._second_lens(draw, lens)
        return warp_picture(image, self._large(lens), other, self.size), other, label

    def _taken(self, index: int) -> tuple[tuple[int, int], None]:
        height, width = self.source[index][0].shape[:2]
        return (height, width), None

    def _lens_alone(self, draw: Draw) -> Lens:
        lens = self._first_lens(draw)
        return lens if self.lens_augmentation is None else self._second_lens(draw, lens)

    def _first_lens(self, draw: Draw) -> Lens:
        return self.lenses.draw(self._random(draw.epoch, draw.lens, 1), self.fov, self.size / 2)

    def _second_lens(self, draw: Draw, first: Lens) -> Lens:
        return self._other_lens(draw, first, purpose=4)

    def through(self, lens: Lens, picture: np.ndarray, turn: Turn | None = None) -> np.ndarray:
        """The picture (H, W, C) uint8 through a lens → (size, size, C) uint8."""
        image = self._rendered(lens, picture, turn)
        if self.render != self.size:
            image = cv2.resize(image, (self.size, self.size), interpolation=cv2.INTER_AREA)
        return image.reshape(self.size, self.size, -1)

    def _rendered(self, lens: Lens, picture: np.ndarray, turn: Turn | None) -> np.ndarray:
        picture = self._square(picture)
        return remap(picture, self._map(lens, picture.shape[0], turn))

    def _large(self, lens: Lens) -> Lens:
        """The lens at `render` px."""
        return lens.resized(self.render / self.size)

    def _map(self, lens: Lens, side: int, turn: Turn | None = None) -> np.ndarray:
        """The place of each pixel in a picture of `side` px, (render, render, 2).

        The curve of the lens is computed once for each radius; there are eight times more pixels.
        """
        radii, place, offset = _rays(self.render)
        view = _view(self.fov, side)
        ratio = radial_reprojection(view, self._large(lens), radii)[0].numpy()[place]
        if turn is not None:
            offset = offset @ turn.matrix.astype(np.float32)
        places = offset * ratio[..., None] + np.float32((side - 1) / 2)
        return np.fmax(places, np.float32(OUTSIDE), out=places)  # NaN becomes OUTSIDE

    def _square(self, picture: np.ndarray) -> np.ndarray:
        top, left, height, width = taken_part(picture.shape[:2], self.framing)
        picture = picture[top : top + height, left : left + width]
        side = min(max(height, width), self.picture_size)
        if (height, width) == (side, side):
            return np.ascontiguousarray(picture)
        return area_resized(picture, (side, side))


@lru_cache(maxsize=256)
def _view(fov: float, side: int) -> Perspective:
    """The perspective lens of a square picture."""
    return Perspective.from_fov(fov, side / 2)


@lru_cache(maxsize=4)
def _rays(side: int) -> tuple[Tensor, np.ndarray, np.ndarray]:
    """The different radii (1, K) of a square's pixels, which one each pixel has, and its offset."""
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    square, place = np.unique(x * x + y * y, return_inverse=True)
    radii = torch.from_numpy(np.sqrt(square)).to(torch.float32).clamp(min=1e-6)
    return radii[None], place.reshape(side, side), np.stack((x, y), -1).astype(np.float32)
