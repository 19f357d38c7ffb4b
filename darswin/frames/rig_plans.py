"""Plans of several cameras: where their frames are read for one picture."""

import json
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from darswin.frames.plan_files import Output, PlanFile, check_output

_READS: dict[str, type[np.generic]] = dict(
    sources=np.uint8, columns=np.int16, rows=np.int16,
    right=np.float32, lower=np.float32, weights=np.float32,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class RigPlan(PlanFile):
    """The places at which the frames of several cameras are read: each pixel is a weighted sum of
    bilinear reads.

    Plans are equal if all of their attributes are.

    Attributes:
        counts: (H', W') uint16, the number of reads of each pixel. A pixel with none is 0.
        sources: (E,) uint8, the camera of each read. Reads are in the order of the pixels.
        columns, rows: (E,) int16, the upper left one of the four pixels around the point of each
            read, all of which are inside the frame.
        right, lower: (E,) float32, the distances of the point from the centre of that pixel, in
            [0, 1].
        weights: (E,) float32, at least 0. Those of a pixel need not have the sum 1.
        sizes: (H, W) of each camera's frames, at least 2 × 2 px.
        names: of the cameras, at most 255.
        output: "image" is float32 (C, H', W'), and "uint8" is (H', W', C), as OpenCV has it.
        mean, std: normalization `(pixel/255 - mean) / std`, one number for each channel, or one for
            all; "uint8" is not normalized, nor is a pixel without reads.

    Raises:
        ValueError: an array has another type or shape, the output is unknown, there are not as many
            different names as sizes, or mean and std are not 1 or 3 finite numbers each, or a std
            is not above 0. `Sampler` checks the places.
    """

    counts: np.ndarray
    sources: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    right: np.ndarray
    lower: np.ndarray
    weights: np.ndarray
    sizes: tuple[tuple[int, int], ...]
    names: tuple[str, ...]
    output: Output = "uint8"
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)

    key = "darswin_rig_plan"
    version = 1
    kinds: ClassVar = dict(
        counts=np.uint16, sizes=np.int64, mean=np.float64, std=np.float64, **_READS
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_output(self.output)
        if self.output == "tokens":
            raise ValueError("several cameras have no tokens: choose 'image' or 'uint8'")
        for name, axes in dict(counts=2, **dict.fromkeys(_READS, 1)).items():
            array, kind = getattr(self, name), np.dtype(self.kinds[name])
            if array.dtype != kind or array.ndim != axes:
                raise ValueError(
                    f"{name} of a plan must be {kind} with {axes} axes, got {array.dtype} of shape "
                    f"{array.shape}"
                )
        object.__setattr__(self, "sizes", tuple((int(h), int(w)) for h, w in self.sizes))
        object.__setattr__(self, "names", tuple(map(str, self.names)))
        if not len(set(self.names)) == len(self.names) == len(self.sizes):
            raise ValueError(
                f"a plan needs a name of its own for each camera, got {', '.join(self.names)} for "
                f"{len(self.sizes)} sizes"
            )

    def texts(self) -> dict[str, str]:
        return super().texts() | {"names": json.dumps(self.names)}

    @classmethod
    def of_file(cls, parts: dict[str, Any], texts: dict[str, str]) -> Self:
        return cls(**parts | dict(names=json.loads(texts["names"])))
