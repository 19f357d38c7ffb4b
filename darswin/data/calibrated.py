"""A data set of pictures that calibrated cameras took."""

import numpy as np

from darswin.data.calibrations import Calibrations
from darswin.data.frames import Fit, at_size, lens_at_size
from darswin.data.samples import Draw, Samples
from darswin.data.sources import Source
from darswin.data.turning import turned_picture
from darswin.lens import Lens


class Calibrated(Samples):
    """Pictures as they are, with the lenses that took them: `dataset[i]` is (image, lens, label).

    A picture is reduced to `size` and its lens with it. Its EXIF turns both upright.

    Args:
        source: the pictures. calibrations: which lens took which.
        fit: how a picture becomes a square: "crop" cuts its longer side, "stretch" squashes it;
            the lens follows exactly.
        options: as `Samples`.

    Attributes:
        cameras: (N,), the number of each picture's camera.

    Raises:
        ValueError: a picture without a lens, or of another shape than its calibration; named.
    """

    source: Source

    def __init__(self, source: Source, calibrations: Calibrations, *, fit: Fit = "crop", **options):
        if fit not in ("crop", "stretch"):
            raise ValueError(f"fit must be 'crop' or 'stretch', got {fit!r}")
        super().__init__(source, **options)
        self.calibrations, self.fit = calibrations, fit
        self.cameras = calibrations.cameras_of([source.file(k) for k in range(len(source))])

    def _seen(self, draw: Draw) -> tuple[np.ndarray, Lens, int]:
        picture, label, orientation = self.source.oriented(draw.picture)
        file, size = self.source.file(draw.picture), (picture.shape[0], picture.shape[1])
        lens = self.calibrations.lens_of(file, size, orientation)
        if (turn := self._turn(draw)) is not None:
            picture, lens = turned_picture(picture, lens, turn)
        image, lens = at_size(picture, lens, self.size, self.fit)
        return image, lens, label

    def _lens_alone(self, draw: Draw) -> Lens:
        lens = self.calibrations.lens_alone(self.source.file(draw.picture))
        return lens_at_size(lens, self.size, self.fit)
