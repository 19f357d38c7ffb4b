"""Plans: where the frames of one camera are read."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from darswin.frames.compiled import frames
from darswin.frames.plan_files import Output, PlanFile, check_output, check_size
from darswin.utils.tables import read_table

_OUTSIDE = -3  # the column and row of a point outside of the frame


@dataclass(frozen=True, eq=False)
class Plan(PlanFile):
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

    key = "darswin_plan"
    version = 5
    kinds: ClassVar = dict(
        size=np.int64, mean=np.float64, std=np.float64, supersampling=np.int64,
        columns=np.int16, rows=np.int16, right=np.float32, lower=np.float32,
    )  # fmt: skip

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

    @classmethod
    def of_file(cls, parts: dict[str, Any], texts: dict[str, str]) -> Self:
        if len({parts[name].shape for name in ("columns", "rows", "right", "lower")}) > 1:
            raise ValueError("its places do not fit together")
        height, width = check_size(parts["size"].tolist())
        return cls(
            **parts | dict(size=(height, width), supersampling=parts["supersampling"].item())
        )
