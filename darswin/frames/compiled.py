"""The compiled module of frames, `darswin.frames._frames`, and the types of its functions."""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol, cast

import numpy as np

from darswin.utils.elf import check_whole


class Sample(Protocol):
    """Samples a frame, or a tuple of those of several cameras."""

    def __call__(
        self, frame: Any, out: np.ndarray | None = None, threads: int = 1, /
    ) -> np.ndarray: ...


class Run(Protocol):
    """Runs a network; the result is an array or a list of arrays, as is `out`."""

    def __call__(self, frame: np.ndarray, out: Any = None, threads: int = 1) -> Any: ...


class Frames(Protocol):
    """The functions of the compiled module."""

    @staticmethod
    def sampler(
        columns: np.ndarray,
        rows: np.ndarray,
        right: np.ndarray,
        lower: np.ndarray,
        size: tuple[int, int],
        scale: Sequence[float],
        offset: Sequence[float],
        output: str,
        supersampling: int,
        /,
    ) -> Sample:
        """A function that samples frames at the points of a plan."""

    @staticmethod
    def rig_sampler(
        counts: np.ndarray,
        sources: np.ndarray,
        columns: np.ndarray,
        rows: np.ndarray,
        right: np.ndarray,
        lower: np.ndarray,
        weights: np.ndarray,
        sizes: Sequence[tuple[int, int]],
        names: Sequence[str],
        scale: Sequence[float],
        offset: Sequence[float],
        output: str,
        /,
    ) -> Sample:
        """A function that samples the frames of several cameras at the places of a plan."""

    @staticmethod
    def network(
        path: bytes, /
    ) -> tuple[Run, tuple[int, int, int], list[tuple[int, ...]], list[str]]:
        """A function that runs the network of a file; (H, W, C) of its frames, the shapes of its
        outputs, and its labels."""

    @staticmethod
    def read_tensors(path: bytes, /) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """The arrays and the texts of a file."""

    @staticmethod
    def polar_places(
        radii: np.ndarray,
        azimuths: np.ndarray,
        center: np.ndarray,
        affine: np.ndarray | None,
        offsets: np.ndarray | None,
        size: tuple[int, int],
        /,
    ) -> tuple[np.ndarray, ...]:
        """The places of the points of a polar grid: columns, rows, right, lower."""

    @staticmethod
    def read(picture: np.ndarray, points: np.ndarray, supersampling: int, /) -> np.ndarray:
        """A picture (H, W, C) of uint8 or float32 at points (k·H', k·W', 2): (H', W', C), each the
        mean of k² points, with 0 outside."""


try:
    if (found := find_spec("darswin.frames._frames")) and found.origin:
        check_whole(found.origin)
    frames = cast(Frames, import_module("darswin.frames._frames"))
except ImportError as error:
    raise ImportError(
        f"cannot load darswin's compiled module for frames: {error}. The package has one for each "
        "Python it was built with. Build it for this Python with `pip install "
        "--no-build-isolation --no-binary darswin darswin`, or in a checkout with `make build`."
    ) from error
