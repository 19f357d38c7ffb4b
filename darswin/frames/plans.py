"""Plans: where the frames of one camera are read, and the sampler that reads them there."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal, Self, cast, get_args

import numpy as np

from darswin.frames.compiled import frames
from darswin.frames.tensor_file import write_tensors
from darswin.utils.tables import read_table

Output = Literal["tokens", "image", "uint8"]
_VERSION = 5
_LARGEST_SIDE = 2**15 - 1  # places are stored in 16 bits
_OUTSIDE = -3  # the column and row of a point outside of the frame
_KINDS = dict(  # of the arrays of a file
    size=np.int64, mean=np.float64, std=np.float64, supersampling=np.int64,
    columns=np.int16, rows=np.int16, right=np.float32, lower=np.float32,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Plan:
    """The places at which the frames of one camera are read, and the form of the result.

    Plans are equal if all of their attributes are.

    Attributes:
        columns, rows: the upper left one of the four pixels around each point, int16; -3 if a point
            lies outside of the frame. Their shape is (R, A, S_r, S_φ) for tokens, (H', W') for an
            image, and (n, H', W') for n tiles; a polar image has H' = R·S_r and W' = A·S_φ. If
            `supersampling` is above 1, there is a last axis of the points of a pixel, row by row.
        right, lower: the distances of each point from the centre of that pixel, in [0, 1], float32.
        size: (H, W) of the frames.
        output: "tokens" is float32 (R, A, S_r·S_φ·C), "image" is float32 (C, H', W') or (n, C, H',
            W'), and "uint8" is (H', W', C) or (n, H', W', C), as OpenCV has it.
        mean, std: normalization `(pixel/255 - mean) / std`, one number for each channel, or one for
            all; "uint8" is not normalized.
        supersampling: the points along each side of a pixel, which is their mean. An image only.

    Raises:
        ValueError: mean and std are not 1 or 3 finite numbers each, or a std is not above 0.
    """

    columns: np.ndarray
    rows: np.ndarray
    right: np.ndarray
    lower: np.ndarray
    size: tuple[int, int]
    output: Output
    mean: tuple[float, ...] = (0.0,)
    std: tuple[float, ...] = (1.0,)
    supersampling: int = 1

    def __post_init__(self) -> None:
        for name, least in (("mean", -math.inf), ("std", 0.0)):
            values = tuple(map(float, getattr(self, name)))
            if len(values) not in (1, 3):
                raise ValueError(f"a plan needs 1 {name}, or 3 for RGB, got {len(values)}")
            if not all(least < value < math.inf for value in values):
                above = " and above 0" * (least == 0)
                raise ValueError(f"{name} of a plan must be finite{above}, got {values}")
            object.__setattr__(self, name, values)
        if len(self.mean) != len(self.std):
            raise ValueError(f"a plan needs as many means as stds, got {self.mean} and {self.std}")

    @classmethod
    def of_points(
        cls,
        points: np.ndarray,
        size: tuple[int, int],
        *,
        output: Output = "image",
        mean: Sequence[float] = (0.0,),
        std: Sequence[float] = (1.0,),
        tiles: int = 1,
        supersampling: int = 1,
    ) -> Self:
        """The plan that reads frames of (H, W) at points.

        Args:
            points: x and y in px, (k·H', k·W', 2) with a supersampling of k, or those of tiles
                below each other; NaN reads nothing.
            tiles: the number of tiles.
            output, mean, std, supersampling: as the attributes of a plan.

        Raises:
            ValueError: the output is unknown or tokens, or a side is longer than 32,767 pixels.
        """
        check_output(output)
        if output == "tokens":
            raise ValueError("only a polar grid has tokens: choose the output 'image' or 'uint8'")
        x, y = points.transpose(2, 0, 1)
        inside = (x > -1) & (x < size[1]) & (y > -1) & (y < size[0])
        x, y = np.where(inside, x, _OUTSIDE), np.where(inside, y, _OUTSIDE)
        if supersampling > 1:
            height, width = (side // supersampling for side in x.shape)
            x, y = (
                v.reshape(height, supersampling, width, supersampling).swapaxes(1, 2)
                for v in (x, y)
            )
            x, y = (v.reshape(height, width, supersampling**2) for v in (x, y))
        if tiles > 1:
            x, y = (v.reshape(tiles, -1, *v.shape[1:]) for v in (x, y))
        columns, rows = np.floor(x), np.floor(y)
        return cls(
            columns=columns.astype(np.int16),
            rows=rows.astype(np.int16),
            right=(x - columns).astype(np.float32),
            lower=(y - rows).astype(np.float32),
            size=check_size(size),
            output=output,
            mean=tuple(mean),
            std=tuple(std),
            supersampling=supersampling,
        )

    @classmethod
    def of_grid(
        cls,
        radii: np.ndarray,
        azimuths: np.ndarray,
        center: np.ndarray,
        affine: np.ndarray | None,
        offsets: np.ndarray | None,
        size: tuple[int, int],
        *,
        output: Output,
        samples: tuple[int, int],
        mean: Sequence[float] = (0.0,),
        std: Sequence[float] = (1.0,),
    ) -> Self:
        """The plan that reads frames of (H, W) on a polar grid, as `darswin.ops.polar_sample` does.

        Args:
            radii, azimuths, center, affine, offsets: float32, the grid of one lens, see
                `darswin.views.PolarGrid`.
            samples: (S_r, S_φ) of a token.
            output, mean, std: as the attributes of a plan.

        Raises:
            ValueError: the output is unknown, or a side is longer than 32,767 pixels.
        """
        check_output(output)
        size = check_size(size)
        arrays = frames.polar_places(radii, azimuths, center, affine, offsets, size)
        if output == "tokens":
            (rings, turns), (sr, sa) = arrays[0].shape, samples
            arrays = tuple(
                np.ascontiguousarray(
                    array.reshape(rings // sr, sr, turns // sa, sa).transpose(0, 2, 1, 3)
                )
                for array in arrays
            )
        columns, rows, right, lower = arrays
        return cls(columns, rows, right, lower, size, output, tuple(mean), tuple(std))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Plan):
            return NotImplemented
        others = other.parts()
        return all(np.array_equal(value, others[name]) for name, value in self.parts().items())

    def parts(self) -> dict[str, Any]:
        """The attributes by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def __hash__(self) -> int:
        return hash((self.size, self.output, self.mean, self.std, self.columns.shape))

    def points(self, points: np.ndarray, tile: int = 0) -> np.ndarray:
        """Carries pixels of the image to pixels of the frame, as a map for `darswin.boxes`.

        Args:
            points: (..., 2), x and y; pixel centres are integers.
            tile: the number of the tile, if the plan has tiles.

        Returns:
            (..., 2) float64, NaN where nothing is seen. Places between pixels are read bilinearly.
            For pictures of at least 256 pixels along rays, such as tiles, this differs from the
            lens by a few thousandths of a pixel; for small ones and squares, by more.

        Raises:
            ValueError: the points have another shape, or the plan has tokens, which have no pixels.
            IndexError: there is no such tile.
        """
        return read_table(self._tables[tile], (np.asarray(points) + 0.5) * self.supersampling - 0.5)

    @cached_property
    def _tables(self) -> np.ndarray:
        """The points, (n, k·H', k·W', 2), NaN outside of the frame."""
        if self.output == "tokens":
            raise ValueError("a plan of tokens has no pixels that could be carried to the frame")
        places = np.stack((self.columns + self.right, self.rows + self.lower), -1)
        places[self.columns == _OUTSIDE] = np.nan
        height, width = self.columns.shape[-2 - (self.supersampling > 1) :][:2]
        k = self.supersampling
        places = places.reshape(-1, height, width, k, k, 2).swapaxes(2, 3)
        return places.reshape(-1, height * k, width * k, 2)

    def save(self, path: str | os.PathLike) -> None:
        """Writes the plan to a file, which `Plan.load` and `Sampler` read. Its name ends in
        ".safetensors".

        Raises:
            ValueError: the name has another ending, or the plan is larger than 2 GB.
            OSError: the file cannot be written.
        """
        write_tensors(path, self.arrays(), {"darswin_plan": str(_VERSION), "output": self.output})

    def arrays(self) -> dict[str, np.ndarray]:
        """The attributes that are numbers, as arrays for a file."""
        parts = self.parts()
        return {name: np.asarray(parts[name], kind) for name, kind in _KINDS.items()}

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Plan":
        """Reads a plan from a file.

        Raises:
            ValueError: the file is no plan, is damaged, or comes from another version of darswin.
            OSError: the file cannot be read.
        """
        try:
            arrays, texts = frames.read_tensors(os.fsencode(path))
            version = int(texts["darswin_plan"])
            if version > _VERSION:
                raise ValueError("it comes from a newer version of darswin: update darswin")
            if version < _VERSION:
                raise ValueError("it comes from an older version of darswin: make the plan again")
            for name, kind in _KINDS.items():
                if arrays[name].dtype != kind:
                    raise TypeError(f"its array {name!r} has another type")
            places = {name: arrays[name] for name in ("columns", "rows", "right", "lower")}
            if len({array.shape for array in places.values()}) > 1:
                raise ValueError("its places do not fit together")
            check_output(texts["output"])
            height, width = check_size(arrays["size"].tolist())
            return cls(
                **places,
                size=(height, width),
                output=cast(Output, texts["output"]),
                mean=tuple(arrays["mean"].tolist()),
                std=tuple(arrays["std"].tolist()),
                supersampling=arrays["supersampling"].item(),
            )
        except (KeyError, TypeError, ValueError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else error
            raise ValueError(
                f"{os.fspath(path)} is no plan that darswin.frames can read: {what}"
            ) from error


def check_output(output: str) -> None:
    """ValueError unless the output is one of a plan."""
    if output not in get_args(Output):
        raise ValueError(f"output must be one of {get_args(Output)}, got {output!r}")


def check_size(size: tuple[int, int]) -> tuple[int, int]:
    """(H, W) of frames; ValueError if a side is longer than a plan can have."""
    if max(size) > _LARGEST_SIDE:
        raise ValueError(f"size must be (H, W) of at most {_LARGEST_SIDE} pixels, got {size}")
    return size


class Sampler:
    """Samples frames at the points of a plan: `sampler(frame, out=None, threads=1)`.

    A call takes a frame of uint8, (H, W, 3) or (H, W), in any memory layout, so that
    `frame[..., ::-1]` turns OpenCV's BGR into RGB at no cost. It returns the plan's `output`. It
    runs without Python's lock, and several threads may call one sampler.

    `out` is an array for the result: C-contiguous, with its shape and type, and in other memory
    than the frame. `threads` is the most threads to use; small plans use fewer. The tokens and the
    polar image are those of `darswin.ops.polar_sample`, bit for bit.

    Args:
        plan: a `Plan`, or its file.

    Raises:
        TypeError: in a call, the frame is no array of uint8.
        ValueError: the plan is damaged; in a call, the frame or `out` does not fit the plan, or
            they share memory.
        OSError: the file cannot be read.
    """

    def __init__(self, plan: Plan | str | os.PathLike):
        if not isinstance(plan, Plan):
            plan = Plan.load(plan)
        try:
            self._sample = frames.sampler(
                plan.columns, plan.rows, plan.right, plan.lower, plan.size,
                [1 / (255 * std) for std in plan.std],
                [-mean / std for mean, std in zip(plan.mean, plan.std, strict=True)],
                plan.output, plan.supersampling,
            )  # fmt: skip
        except TypeError as error:
            raise ValueError("the parts of the plan do not fit together") from error
        self.plan = plan

    def __call__(
        self, frame: np.ndarray, out: np.ndarray | None = None, threads: int = 1
    ) -> np.ndarray:
        return self._sample(frame, out, threads)
