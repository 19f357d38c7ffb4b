"""Networks for the frames of one camera, in a file that needs no torch."""

import os
from typing import Any

import numpy as np

from darswin.frames.compiled import frames


class Network:
    """A network for the frames of one camera: `network(frame, out=None, threads=1)`.

    A call takes a frame of uint8, (H, W, 3) or (H, W), in any memory layout, so that
    `frame[..., ::-1]` turns OpenCV's BGR into RGB at no cost. It returns float32: the probabilities
    of a classifier, (classes,), or what the model returns for one image without the batch axis,
    such as logits (K, H, W) of pixels, or a list of the maps of a backbone. It runs without
    Python's lock, and several threads may call one network.

    `out` is an array for the result, or a list of arrays for a list: C-contiguous, with its shape
    and type, and in other memory than the frame. `threads` is the most threads to use.

    Args:
        path: a file of `darswin.deploy.camera.export_network`. The weights stay there: replace it
            by another file if it changes, and do not write into it.

    Attributes:
        size: (H, W) of the frames.
        channels: their number of channels, 1 or 3.
        shapes: the shapes of the outputs, of which all networks but backbones have one.
        labels: the names of the classes; empty if the file has none.

    Raises:
        TypeError: in a call, the frame is no array of uint8, or `out` no array.
        ValueError: the file is no network, is damaged, or of another version; in a call, the frame
            or `out` does not fit, or they share memory.
        OSError: the file cannot be read.
    """

    def __init__(self, path: str | os.PathLike):
        self._run, size, self.shapes, self.labels = frames.network(os.fsencode(path))
        self.size, self.channels = size[:2], size[2]

    def __call__(self, frame: np.ndarray, out: Any = None, threads: int = 1) -> Any:
        return self._run(frame, out, threads)

    def __repr__(self) -> str:
        return f"Network(size={self.size}, channels={self.channels}, shapes={self.shapes})"
