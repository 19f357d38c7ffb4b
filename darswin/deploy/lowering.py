"""The rules by which functions become instructions: see record.py."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from darswin.deploy.hidden import PICTURES
from darswin.deploy.own import OwnLinear, OwnNorm
from darswin.deploy.packed import OwnBlocks
from darswin.deploy.program import GELU, RELU, NoProgramError, Slot
from darswin.deploy.record import Recorded, inverse, lowers
from darswin.lens.pixels import OUTSIDE, sample_at
from darswin.models.pixel import distances
from darswin.ops.polar_to_image import polar_to_image, polar_to_image_plan

# -- layers of our own ---------------------------------------------------------------------------


@lowers(OwnLinear.__call__)
def _(layer: OwnLinear, x: Recorded) -> Recorded:
    return x.writer.by_rows(x, layer.columns, lambda rows: x.writer.program.linear(rows, layer))


@lowers(OwnNorm.__call__)
def _(norm: OwnNorm, x: Recorded) -> Recorded:
    return x.writer.by_rows(x, x.shape[-1], lambda rows: x.writer.program.norm(rows, norm))


@lowers(OwnBlocks.__call__)
def _(blocks: OwnBlocks, x: Recorded, tables: Sequence[Tensor]) -> Recorded:
    trace, inputs = x.writer, [x.writer.input_of(table) for table in tables]
    return trace.filled(trace.program.blocks(trace.dense(x), blocks, inputs))


# -- functions between them ----------------------------------------------------------------------


@lowers(Tensor.shape.__get__, Tensor.size)  # type: ignore[attr-defined]
def _(x: Recorded, dim: int | None = None) -> Any:
    sizes = (PICTURES, *x.whole.shape[1:])
    return sizes if dim is None else sizes[dim]


@lowers(Tensor.device.__get__)
def _(x: Recorded) -> torch.device:
    return torch.device("cpu")  # where tensors of the lens are


@lowers(Tensor.to)
def _(x: Tensor, like: Tensor | None = None, *others: Any, **named: Any) -> Tensor:
    kind: Any = [torch.empty(0) if isinstance(like, Recorded) else like, *others]
    if kind[0] is None:  # they have names
        kind = []
    if not isinstance(x, Recorded):
        return x.to(*kind, **named)
    cast = torch.empty(0).to(*kind, **named)
    # Values have the dtype of the weights, but are computed in float32.
    if cast.device.type != "cpu" or cast.dtype not in x.writer.dtypes:
        raise NoProgramError(f"a cast to {cast.dtype} is no instruction")
    return x


@lowers(Tensor.contiguous)
def _(x: Recorded, memory_format: torch.memory_format = torch.contiguous_format) -> Recorded:
    if memory_format != torch.contiguous_format or x.meta.is_contiguous():
        return x
    return x.writer.copy_of(x, x.whole)


@lowers(Tensor.mean)
def _(x: Recorded, dim: int | Sequence[int]) -> Recorded:
    if dim != (*range(1, x.dim() - 1),):
        raise NoProgramError(f"a mean over the axes {dim} is no instruction")
    return x.writer.filled(x.writer.program.mean(x.writer.dense(x)))


@lowers(torch.add, Tensor.add, Tensor.__add__, Tensor.__radd__)
def _(x: Tensor, y: Tensor) -> Recorded:
    trace = next(value.writer for value in (x, y) if isinstance(value, Recorded))
    one, other = trace.of(x), trace.of(y)
    if one.whole.shape != other.whole.shape:
        raise NoProgramError("a sum of values of other shapes is no instruction")
    order = one.made().order()
    total = trace.program.added(trace.dense(one, order), trace.dense(other, order))
    return trace.filled(total, inverse(order))


@lowers(F.gelu)
def _(x: Recorded, approximate: str = "none") -> Recorded:
    if approximate != "none":
        raise NoProgramError(f"an approximate GELU, {approximate}, is no instruction")
    return _applied(x, x.writer.program.apply, GELU)


@lowers(F.relu, torch.relu, Tensor.relu)
def _(x: Recorded, inplace: bool = False) -> Recorded:
    if inplace:
        raise NoProgramError("a ReLU in place is no instruction")
    return _applied(x, x.writer.program.apply, RELU)


@lowers(distances)
def _(x: Recorded, typical: float) -> Recorded:
    return _applied(x, x.writer.program.distance, typical)


def _applied(x: Recorded, write: Callable[[Slot, Any], Slot], argument: Any) -> Recorded:
    """The result of an instruction that takes each number for itself."""
    order = x.made().order()
    return x.writer.filled(write(x.writer.dense(x, order), argument), inverse(order))


@lowers(torch.cat)
def _(tensors: Sequence[Tensor], dim: int = 0) -> Recorded:
    trace = next(value.writer for value in tensors if isinstance(value, Recorded))
    parts = [trace.of(value) for value in tensors]
    first, dim = parts[0], dim % parts[0].dim()
    sizes = [part.shape[1:dim] + part.shape[dim + 1 :] for part in parts]
    if dim == 0 or any(others != sizes[0] for others in sizes):
        raise NoProgramError("this joining is no instruction")
    # Convolutions read maps with the channels last.
    order = [0, 2, 3, 1] if first.dim() == 4 and dim == 1 else first.made().order()
    shape = list(first.meta.shape)
    shape[dim] = sum(part.shape[dim] for part in parts)
    whole = trace.filled(trace.program.buffer(*(shape[axis] for axis in order[1:])), inverse(order))
    begin = 0
    for part in parts:
        place = trace.value(whole.slot, whole.whole.narrow(dim, begin, part.shape[dim]))
        begin += part.shape[dim]
        if part.slot is None and (there := _in_shape(place, part.source.shape)) is not None:
            part, place = part.source, there
        part.made()
        assert part.slot is not None
        trace.move(part.slot, part.meta, place)
    return whole


def _in_shape(place: Recorded, shape: Sequence[int]) -> Recorded | None:
    """A view in another shape, or None if its strides have none."""
    try:
        return place.writer.value(place.slot, place.whole.view(shape))
    except RuntimeError:
        return None


@lowers(torch.where)
def _(condition: Tensor, x: Recorded, other: float) -> Tensor:
    """Pixels (1, K, H, W) where the condition (1, 1, H, W) is true, else 0."""
    shape = (1, 1, *x.shape[2:])
    if isinstance(condition, Recorded) or condition.shape != shape or other != 0.0:
        raise NoProgramError("a choice between values is no instruction")
    if x.writer.for_file and condition.all():  # else other lenses may show less
        return x
    rows, columns = (torch.arange(side) for side in condition.shape[2:])
    pixels = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)[None]
    return sample_at(x, torch.where(condition[:, 0, :, :, None], pixels, OUTSIDE))


# -- maps and pixels -----------------------------------------------------------------------------

_LAST, _FIRST = (0, 2, 3, 1), (0, 3, 1, 2)  # (1, C, H, W) as (1, H, W, C), and back


@lowers(torch.conv2d)
def _(x: Recorded, weight: Any, bias: Any = None, stride: Any = 1, padding: Any = 0,
      dilation: Any = 1, groups: int = 1) -> Recorded:  # fmt: skip
    size = tuple(weight.shape[2:])
    if (size, stride, padding, dilation, groups) != ((3, 3), (1, 1), (1, 1), (1, 1), 1):
        raise NoProgramError(f"this convolution of {size[0]} × {size[1]} is no instruction")
    return x.writer.filled(x.writer.program.conv(x.writer.dense(x, _LAST), weight, bias), _FIRST)


@lowers(F.max_pool2d)
def _(x: Recorded, size: Any, stride: Any = None, padding: Any = 0, dilation: Any = 1, *,
      ceil_mode: bool = False, return_indices: bool = False) -> Recorded:  # fmt: skip
    usual = (2, None, 0, 1, True, False)
    if (size, stride, padding, dilation, ceil_mode, return_indices) != usual:
        raise NoProgramError("this pooling is no instruction")
    return x.writer.filled(x.writer.program.pooled(x.writer.dense(x, _LAST)), _FIRST)


@lowers(F.interpolate)
def _(x: Recorded, size: Any, mode: str, align_corners: bool | None, **others: Any) -> Recorded:
    if mode != "bilinear" or align_corners or any(others.values()):
        raise NoProgramError(f"this interpolation, {mode}, is no instruction")
    return x.writer.filled(x.writer.program.resized(x.writer.dense(x, _LAST), tuple(size)), _FIRST)


@lowers(sample_at)
def _(images: Recorded, pixels: Tensor) -> Recorded:
    trace = images.writer
    points = trace.input_of(pixels.float())
    return trace.filled(trace.program.sampled(trace.dense(images, _LAST), points), _FIRST)


@lowers(polar_to_image)
def _(x: Recorded, radii: Tensor, center: Tensor | None, size: Any, *, layout: str,
      affine: Tensor | None, points: Tensor | None, r_max: Tensor | None, plan: Tensor | None,
) -> Recorded:  # fmt: skip
    if plan is None:
        like = radii.new_empty((1, *x.shape[1:3], 0))
        plan = polar_to_image_plan(
            like, radii, center, size, affine=affine, points=points, r_max=r_max
        )
    if layout != "tokens" or plan is None:
        raise NoProgramError("polar_to_image without a plan is no instruction")
    trace = x.writer
    return trace.filled(trace.program.to_image(trace.dense(x), trace.input_of(plan)))
