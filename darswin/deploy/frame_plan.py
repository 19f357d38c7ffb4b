"""The places of the plans of `darswin.frames`: where models, layers and views read an image."""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from darswin import _frames
from darswin.compat.official import OfficialDarSwin
from darswin.layers.polar import PolarGrid, PolarSample, check_lens
from darswin.lens import Lens
from darswin.lens.pixels import as_map
from darswin.models.base import Model
from darswin.models.encoder import FeatureMaps
from darswin.models.stages import Pair
from darswin.models.unet import Unet
from darswin.models.views import LensAdapter

_OUTSIDE = -3


@torch.no_grad()
def places(
    sample: nn.Module | Tensor, lens: Lens, size: Pair, output: str | None
) -> dict[str, Any]:
    """The attributes of a `Plan`, all but its size; `mean` and `std` may be single numbers."""
    if len(check_lens(lens, size)) != 1:
        raise ValueError(f"a plan needs one lens, got {len(lens)}")
    lens = lens.to("cpu")
    if isinstance(sample, Tensor):
        return _at_pixels(_pixels_of_rays(sample, lens, size), size, output or "uint8")
    if isinstance(sample, PolarSample):
        grid, samples = sample.grid(lens, size), sample.spec.samples
        found = _on_grid(grid, samples, size, output or sample.layout)
    elif isinstance(sample, Model):
        points = _points(sample, sample.prepare(lens, size))
        if points is None:
            raise ValueError("the model takes images as they are: it needs no plan")
        if isinstance(points, PolarGrid):
            found = _on_grid(points, _spec(sample).samples, size, output or "tokens")
        else:
            found = _at_pixels(points[0], size, output or "image")
    else:
        raise TypeError(
            "sample must be a model of darswin, a PolarSample or rays (H, W, 3), "
            f"got {type(sample).__name__}"
        )
    return found | dict(mean=getattr(sample, "mean", 0.0), std=getattr(sample, "std", 1.0))


def _points(model: Model, prepared: Any) -> PolarGrid | Tensor | None:
    """The points at which a model samples the images."""
    if isinstance(model, OfficialDarSwin):
        raise ValueError("OfficialDarSwin samples the transposed image, which no plan does")
    if isinstance(model, FeatureMaps):
        return _points(model.encoder, prepared)
    if isinstance(model, LensAdapter):
        return prepared[0]
    if isinstance(model, Unet):
        grid = prepared.encoder.points
        return prepared.image_points if grid is None else grid
    return prepared.points


def _spec(model: Any) -> Any:
    return model.spec if hasattr(model, "spec") else _spec(model.encoder)


def _on_grid(grid: PolarGrid, samples: Pair, size: Pair, output: str) -> dict[str, Any]:
    """The places of a polar grid of one lens."""
    affine, offsets = (
        None if x is None else x.float().numpy() for x in (grid.affine, grid.offsets)
    )
    radii, azimuths, center = (x.float().numpy() for x in (grid.radii, grid.azimuths, grid.center))
    *arrays, packed = _frames.polar_places(radii, azimuths, center, affine, offsets, size)
    if output == "tokens":
        (rows, columns), (sr, sa) = arrays[0].shape, samples
        arrays = [
            np.ascontiguousarray(
                array.reshape(rows // sr, sr, columns // sa, sa).transpose(0, 2, 1, 3)
            )
            for array in arrays
        ]
    names = ("columns", "rows", "right", "lower")
    return dict(zip(names, arrays, strict=True), output=output, normalize_first=packed)


def _pixels_of_rays(rays: Tensor, lens: Lens, size: Pair) -> Tensor:
    if rays.dim() != 3 or rays.shape[2] != 3:
        raise ValueError(f"rays must have shape (H, W, 3), got {tuple(rays.shape)}")
    return as_map(lens.to(torch.float64).project_points(rays[None].double().cpu(), size))[0]


def _at_pixels(points: Tensor, size: Pair, output: str) -> dict[str, Any]:
    """The places of single points (H', W', 2), x and y in px."""
    if output == "tokens":
        raise ValueError("only a polar grid has tokens: choose the output 'image' or 'uint8'")
    x, y = points.double().numpy().transpose(2, 0, 1)
    inside = (x > -1) & (x < size[1]) & (y > -1) & (y < size[0])
    x, y = np.where(inside, x, _OUTSIDE), np.where(inside, y, _OUTSIDE)
    columns, rows = np.floor(x), np.floor(y)
    return dict(
        columns=columns.astype(np.int16),
        rows=rows.astype(np.int16),
        right=(x - columns).astype(np.float32),
        lower=(y - rows).astype(np.float32),
        output=output,
        mean=0.0,
        std=1.0,
    )
