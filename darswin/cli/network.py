"""Predictions of a network in an ONNX file, which sees the pictures through a view."""

import io
import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from darswin import boxes
from darswin.cli.answers import Answers, file_of, label_png, said, write_overlay
from darswin.data.scenes.targets import IGNORE
from darswin.data.splits import read_list
from darswin.deploy.network import Detections, OnnxNetwork
from darswin.frames import Plan, Sampler, plan
from darswin.lens import Lens
from darswin.utils.files import replace_file
from darswin.utils.image import BrokenImageError
from darswin.utils.parameters import check, naming
from darswin.views import Prepared, make_view
from darswin.views.base import PixelView
from darswin.views.plain import PlainView
from darswin.viz.pixels import draw_boxes, label_image, overlay, palette

VIEW = "mercator"


class Seen(NamedTuple):
    """A view of the pictures of one camera."""

    sampler: Sampler
    lens: Lens  # float64
    prepared: Prepared | None  # for maps


class NetworkAnswers(Answers):
    """Carries what a network finds in a view to the pictures.

    Boxes and maps become files in a folder; numbers do not.

    Args:
        network: the file of the network.
        view: the name of a view of pixels, with ":" and a count for tiles.
        size, fov_deg, up, mean, std, channels, threshold, labels: as for `darswin predict`.

    Raises:
        ValueError: an option is wrong, or does not fit the view or the network.
    """

    out: Path | None = None  # the folder of the files, and their names
    names: Mapping[str, str] = {}

    def __init__(
        self, network: str, view: str | None = None, size: tuple[int, int] | None = None,
        fov_deg: float | None = None, up: Sequence[float] | None = None,
        mean: Sequence[float] | None = None, std: Sequence[float] | None = None,
        channels: str | None = None, threshold: float | None = None, labels: str | None = None,
    ):  # fmt: skip
        name, _, number = (view or VIEW).partition(":")
        options = _options(name, number, fov_deg, up)
        threshold = 0.3 if threshold is None else threshold
        check("threshold", threshold, math.isfinite(threshold), "a finite number")
        self.labels = None if labels is None else read_list(labels)
        # The size is known only from the network, and the number of pictures only from the view.
        count = _view(name, (64, 64), options).count
        self.network = OnnxNetwork(network, size, count, threshold)
        super().__init__(self.network.channels)
        self.view = _view(name, self.network.size, options)
        self.is_bgr = channels == "bgr"
        given = mean is not None or std is not None or channels is not None
        self._normalization = dict(mean=mean or (0.0,), std=std or (1.0,))
