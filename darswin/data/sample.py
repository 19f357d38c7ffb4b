"""A picture, its target and its lens, which move together."""

from typing import NamedTuple, Self

import numpy as np

from darswin.data.labels.labels import Labels, moved
from darswin.lens import Lens
from darswin.views import PixelView
from darswin.views.remap import Remap


class Sample(NamedTuple):
    """A picture with its target and its lens.

    The image is (H, W, C) uint8, and the lens is one lens with this image_size. The target is the
    label of each pixel, (H, W) uint8 with `IGNORE`; or its distance along the ray, (H, W) float32
    metres with 0 for unknown; or the instances in the picture; or the id of its class; or None.
    """

    image: np.ndarray
    target: np.ndarray | Labels | int | None
    lens: Lens

    def through(self, view: PixelView) -> Self:
        """The sample as a view of a camera shows it, a `CameraView` or a `CropView`; a class stays
        as it is, and `Labels` follow as `moved` says."""
        return self.moved(view.at(self.lens, (self.image.shape[0], self.image.shape[1])))

    def moved(self, remap: Remap) -> Self:
        """`through` the view of a map for pictures of this lens and size."""
        target = self.target
        if isinstance(target, np.ndarray):
            target = remap.target(target)
        elif isinstance(target, Labels):
            target = moved(target, remap)
        assert remap.camera is not None
        return self._replace(image=remap(self.image), target=target, lens=remap.camera)
