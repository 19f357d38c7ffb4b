"""Networks and plans for the frames of one camera, which `darswin.frames` runs without torch."""

import os
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from darswin.deploy.forward import NoProgramError, frame_program
from darswin.deploy.optimize import check_model, optimize
from darswin.deploy.packed import own_alone
from darswin.frames.plans import Output, Plan, check_name, check_output, check_size, write_arrays
from darswin.layers.quantized import quantized_layers
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.models.encoder import FeatureMaps
from darswin.ops.checks import check_pair, per_channel
from darswin.views import PixelView, PolarGrid, PolarView, View
from darswin.views.base import Pair, check_lens

__all__ = ["export_network", "plan"]

_VERSION = (1, 0)  # csrc/core/network_file.h describes the file


def plan(
    sample: nn.Module,
    lens: Lens,
    size: Pair,
    *,
    output: Output | None = None,
    mean: float | Sequence[float] | None = None,
    std: float | Sequence[float] | None = None,
) -> Plan:
    """Finds the places at which a network or a view reads the frames of a camera.

    Args:
        sample: a model, which reads a polar grid or a view of its own, or a view of
            `darswin.views`. All tiles of a view are in one plan.
        lens: the lens of the camera.
        size: (H, W) of the frames.
        output: the form of the result, see `darswin.frames.Plan`. By default it is the input of the
            network, "tokens" or "image". Only a polar grid has tokens.
        mean, std: the normalization of the frames, a number for all channels or one for each; by
            default the view's.

    Raises:
        TypeError: `sample` is none of these, or the size is not whole.
        ValueError: there is more than one lens, the lens belongs to another size, the model takes
            the images as they are, a side is longer than 32,767 pixels, the output is unknown, mean
            or std do not fit the channels, or they are missing and the model has none.
    """
    if output is not None:
        check_output(output)
    size = check_size(check_pair("size", size, 1))
    found = _reading(sample, lens, size)
    return _plan_of(sample, found, size, output or found.output, mean, std)


def export_network(
    model: Model,
    lens: Lens | None,
    size: Pair,
    path: str | os.PathLike,
    *,
    labels: Sequence[str] | None = None,
    mean: float | Sequence[float] | None = None,
    std: float | Sequence[float] | None = None,
) -> None:
    """Writes a network for the frames of one camera, which `frames.Network` runs without torch.

    The file contains where the frames are read, the packed weights and all that depends on the
    lens. It also runs in C and C++ programs, by the library libdarswin_frames.so.

    Args:
        model: a classifier, a backbone or a Unet of `create_model` with float32 weights in eval
            mode. If it is quantized (see `quantize_model`), the network computes with 8 bits.
        lens: the lens of the camera; None if the model ignores its lens.
        size: (H, W) of the frames.
        path: of the file; its name ends in ".npz".
        labels: the names of the classes; by default those of the model, if it was loaded from a
            file that has them.
        mean, std: the normalization of the frames, a number for all channels or one for each; by
            default the model's.

    Raises:
        TypeError: another kind of model, one with parts or a dtype that the file cannot contain, or
            the size is not whole.
        ValueError: the model is in training mode, or takes frames of another size or with other
            than 1 or 3 channels; there is not one lens, or it belongs to another size; there is not
            a label for each class; mean and std do not fit the channels; or the name has another
            ending.
        OSError: the file cannot be written.
    """
    check_name(path)
    size = check_size(check_pair("size", size, 1))
    check_model(model, torch.float32, None)
    if model.dtype != torch.float32:
        raise TypeError(f"model must have float32 weights, got {model.dtype}")
    if model.training:
        raise ValueError("model must be in eval mode, got one in training mode: call model.eval()")
    if model.image_size not in (None, size):
        raise ValueError(f"size must be the model's image_size, {model.image_size}, got {size}")
    names = list(model.pretrained_cfg.get("label_names", ()) if labels is None else labels)
    if names and (len(names) != model.num_classes or not all(isinstance(n, str) for n in names)):
        raise ValueError(f"labels must be {model.num_classes} names, one for each class")
    if model.view.uses_lens:
        found = _reading(model, lens, size, exact=False)
    else:
        found = _every_pixel(model, size)
    places = _plan_of(model, found, size, found.output, mean, std)
    try:
        with torch.no_grad(), own_alone():
            fast = optimize(model, torch.int8 if quantized_layers(model) else torch.float32)
            program = frame_program(fast, fast.prepare(lens, size))
    except NoProgramError as error:
        raise TypeError(
            f"model must be a classifier, a backbone or a Unet that a file can contain, got "
            f"{type(model).__name__}: {error}"
        ) from error
    constants = [np.zeros(0, np.float32), *(one.numpy().ravel() for one in program.constants)]
    is_list = isinstance(model, FeatureMaps)
    finish = "probabilities" if program.is_classifier else "list" if is_list else "array"
    write_arrays(
        path,
        {f"plan.{name}": value for name, value in places.parts().items()}
        | dict(
            darswin_network=_VERSION,
            program=np.array(program.words, np.int64),
            weights=program.weights.numpy(),
            reads_frame=int(program.reads_frame),
            constants=np.concatenate(constants),
            finish=finish,
            labels=np.array(names, str),
        ),
    )


class _Reading(NamedTuple):
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
def _reading(sample: nn.Module, lens: Lens | None, size: Pair, *, exact: bool = True) -> _Reading:
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
        return _Reading(points, view.layout, view.samples, channels, view.mean, view.std)
    assert isinstance(points, Tensor)
    reads = points.shape[2] // view.size[1] if isinstance(view, PixelView) and view.size else 1
    return _Reading(points[0], "image", None, channels, view.mean, view.std, view.count, reads)


def _every_pixel(model: Model, size: Pair) -> _Reading:
    """The points of a model that takes images of (H, W) as they are."""
    y, x = (torch.arange(side, dtype=torch.float64) for side in size)
    points = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    return _Reading(points, "image", None, model.in_chans, model.mean, model.std)


def _plan_of(
    sample: nn.Module,
    found: _Reading,
    size: Pair,
    output: Output,
    mean: float | Sequence[float] | None,
    std: float | Sequence[float] | None,
) -> Plan:
    if output == "uint8":
        found = found._replace(mean=0.0, std=1.0)
    mean, std = found.mean if mean is None else mean, found.std if std is None else std
    if mean is None or std is None:
        raise ValueError(
            f"this {type(sample).__name__} does not say how frames are normalised: give the mean "
            "and the std of its network"
        )
    channels = found.channels or max(np.size(mean), np.size(std))
    form: dict[str, Any] = dict(
        output=output,
        mean=per_channel("mean", mean, channels),
        std=per_channel("std", std, channels),
    )
    points: Any = found.points
    if found.samples is None:
        points = points.double().numpy()
        return Plan.of_points(points, size, tiles=found.tiles, reads=found.reads, **form)
    names = ("radii", "azimuths", "center", "affine", "offsets")
    parts = {name: getattr(points, name) for name in names}
    grid: Any = {k: None if part is None else part.float().numpy() for k, part in parts.items()}
    return Plan.of_grid(**grid, size=size, samples=found.samples, **form)
