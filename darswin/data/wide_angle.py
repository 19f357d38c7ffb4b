"""A data set of wide-angle images that are made from ordinary pictures."""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from darswin.data.framing import taken_part
from darswin.data.lens_distributions import LensDistribution
from darswin.data.pictures import Source
from darswin.data.sample import Sample
from darswin.data.samples import Draw, Samples
from darswin.lens import Lens, Perspective
from darswin.utils.angles import degrees_hint
from darswin.utils.resize import area_resized
from darswin.utils.tasks import Fit
from darswin.views import CameraView, CropView
from darswin.views.remap import Remap

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
        fit: "crop", or "stretch" as in the authors' code.
        options: mean, std, turns, lens_augmentation, augment, erase, seed and skip_broken, as
            `Calibrated` takes them. With lens_augmentation, an image of `render` px through a lens
            of `lenses` is warped again, as another camera would have seen it.

    Raises:
        ValueError: sizes or angles out of range.

    Source: DarSwin, ICCV 2023, sec. 5.1.
    """

    source: Source
    _other = 4

    def __init__(
        self,
        source: Source,
        lenses: LensDistribution,
        *,
        size: int = 64,
        render: int = 224,
        fov: float = PAPER_FOV,
        picture_size: int = 384,
        fit: Fit = "crop",
        **options: Any,
    ):
        if not 0 < size <= render:
            raise ValueError(f"sizes must be 0 < size ≤ render, got {size} and {render}")
        if not 0 < fov < math.pi:
            raise ValueError(f"fov must be in (0, π), got {fov}{degrees_hint(fov)}")
        super().__init__(source, size=size, fit=fit, **options)
        self.lenses, self.fov = lenses, fov
        self.render, self.picture_size = render, picture_size
        self._last: tuple[Any, Remap] | None = None  # the map of the last sample, and its key

    def _read(self, draw: Draw) -> Sample:
        picture, label = self.source[draw.picture]
        picture = self._square(picture)
        sample = Sample(picture, label, _view(self.fov, len(picture)))
        key, last = (draw.epoch, draw.lens, len(picture)), self._last
        if last is None or last[0] != key:
            # A turn leaves the lens as it is, which is round and in the middle.
            view = CameraView(self._lens_alone(draw), turn=self._turn(draw), supersampling=1)
            self._last = last = key, view.at(sample.lens, (len(picture), len(picture)))
        return sample.moved(last[1])

    def _view(self, own: Lens, draw: Draw) -> CameraView | CropView:
        if self.lens_augmentation is not None:
            return CameraView(self._other_lens(draw, own))
        return CropView((0, 0, self.render, self.render), (self.size, self.size))

    def _taken(self, index: int) -> tuple[tuple[int, int], None]:
        height, width = self.source[index][0].shape[:2]
        return (height, width), None

    def _lens_alone(self, draw: Draw) -> Lens:
        """The lens of a picture of `render` px."""
        lens = self._drawn(self.lenses, draw, 1, self.fov, None)
        return lens.resized((self.render, self.render))

    def _square(self, picture: np.ndarray) -> np.ndarray:
        top, left, height, width = taken_part(picture.shape[:2], self.fit)
        picture = picture[top : top + height, left : left + width]
        side = min(max(height, width), self.picture_size)
        if (height, width) == (side, side):
            return np.ascontiguousarray(picture)
        return area_resized(picture, (side, side))


@lru_cache(maxsize=256)
def _view(fov: float, side: int) -> Perspective:
    """The perspective lens of a square picture."""
    return Perspective.from_fov(fov, side / 2, image_size=(side, side))
