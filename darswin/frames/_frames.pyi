from collections.abc import Sequence
from typing import Protocol

import numpy as np

class _Sample(Protocol):
    def __call__(
        self, frame: np.ndarray, out: np.ndarray | None = None, threads: int = 1
    ) -> np.ndarray: ...

def sampler(
    columns: np.ndarray,
    rows: np.ndarray,
    right: np.ndarray,
    lower: np.ndarray,
    size: tuple[int, int],
    scale: Sequence[float],
    offset: Sequence[float],
    output: str,
    reads: int,
    /,
) -> _Sample: ...
def polar_places(
    radii: np.ndarray,
    azimuths: np.ndarray,
    center: np.ndarray,
    affine: np.ndarray | None,
    offsets: np.ndarray | None,
    size: tuple[int, int],
    /,
) -> tuple[np.ndarray, ...]: ...
