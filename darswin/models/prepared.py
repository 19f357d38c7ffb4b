"""What a model computes of lenses, once for any number of images."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from torch import Tensor

from darswin.views.base import PreparedPixels, PreparedPolar


class Prepared(NamedTuple):
    """Everything of N lenses that a model needs, for images of one size.

    - `view`: what its view needs; `view.shown`, (N or 1, H, W), is True for the pixels of the
      images that the view shows, and None if it shows all.
    - `rays`: `View.ray_channels`, if the network reads them.
    - `tokens`: for each map, a linear function of the positions of its tokens, which is added to
      it, (N or 1, H', W', D).
    - `tables`: for each stage, the position biases of its blocks.
    - `remaps`: the `Remap` of each lens, by which detections come back; None without detections.
    """

    view: PreparedPixels | PreparedPolar
    rays: Tensor | None = None
    tokens: Sequence[Tensor] = ()
    tables: Sequence[Sequence[Tensor]] = ()
    remaps: Sequence[Any] | None = None
