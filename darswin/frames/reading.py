"""The points at which models, layers and views read an image."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from darswin.lens import Lens
from darswin.models.base import Model
from darswin.views import PixelView, PolarGrid, PolarView, View
from darswin.views.base import Pair, check_lens


class Reading(NamedTuple):
    """The points at which images of one size are read, and the usual form of the result."""

    points: PolarGrid | Tensor  # the polar grid of one lens, or pixels (H', W', 2)
    output: Literal["tokens", "image"]  # of `Plan`
    samples: Pair | None  # (S_r, S_φ) of a token of the grid
    channels: int | None  # of the frames, if the sampling says it
    # The normalization of frames; None if the sampling has none of its own.
    mean: float | Sequence[float] | None
    std: float | Sequence[float] | None
    tiles: int = 1  # pictures below each other
    reads: int = 1  # points along each side of a pixel


@torch.no_grad()
def reading(sample: nn.Module, lens: Lens | None, size: Pair, *, exact: bool = True) -> Reading:
    """The points at which a model, a layer or a view reads images of (H, W).

    The points of views are as exact as can be; or, without `exact`, those at which a model itself
    reads. A polar grid is always the model's own: its samples have the bits of `polar_sample`.
    """
    lens = check_lens(lens, size)
    if len(lens) != 1:
        raise ValueError(f"a plan needs one lens, got {len(lens)}")
    view = sample.view if isinstance(sample, Model) else sample
    if not isinstance(view, View):
        raise TypeError(f"sample must be a model or a view of darswin, got {type(sample).__name__}")
    channels = sample.in_chans if isinstance(sample, Model) else None
    dtype = torch.float64 if exact and isinstance(view, PixelView) else lens.theta_max.dtype
    points = view.prepare(lens.to("cpu", dtype), size, back=False, rays=False).points
    if points is None:
        raise ValueError("the model takes images as they are: it needs no plan")
    if isinstance(view, PolarView):
        return Reading(points, view.layout, view.samples, channels, view.mean, view.std)
    assert isinstance(points, Tensor)
    reads = points.shape[2] // view.size[1] if isinstance(view, PixelView) and view.size else 1
    return Reading(points[0], "image", None, channels, view.mean, view.std, view.count, reads)


def every_pixel(model: Model, size: Pair) -> Reading:
    """The points of a model that takes images of (H, W) as they are."""
    y, x = (torch.arange(side, dtype=torch.float64) for side in size)
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    return Reading(points, "image", None, model.in_chans, model.mean, model.std)
