"""Networks and plans for the frames of one camera, which `darswin.frames` runs without torch."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from darswin.deploy.networks import frame_program
from darswin.deploy.optimize import check_model, fast_copy, references
from darswin.deploy.program import NoProgramError
from darswin.frames.plan_files import Output, check_output, check_size
from darswin.frames.plans import Plan
from darswin.frames.tensor_file import check_name, write_tensors
from darswin.lens import Lens
from darswin.models.base import Model
from darswin.ops.checks import check_pair, per_channel
from darswin.views import PixelView, PolarView, View
from darswin.views.base import Pair, check_lens

__all__ = ["export_network", "plan"]

# The output of a plan, and its mean and std; None for those of the model or the view.
_Form = tuple[Output | None, float | Sequence[float] | None, float | Sequence[float] | None]
_VERSION = "2.0"  # of the file, as in csrc/core/network_file.h


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
    return _plan(sample, lens, size, (output, mean, std))


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
        model: a model of `create_model`, or a `LensAdapter` of one whose view is one picture, with
            float32 weights in eval mode. If it is quantized (see `quantize_model`), the network
            computes with 8 bits.
        lens: the lens of the camera; None if the model ignores its lens.
        size: (H, W) of the frames.
        path: of the file; its name ends in ".safetensors".
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
    form = (None, mean, std)
    if model.view.uses_lens:
        places = _plan(model, lens, size, form, exact=False)
    else:
        places = _every_pixel(model, size, form)
    try:
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            for reference in references(model):
                program = frame_program(fast_copy(reference), lens, size, reference)
    except NoProgramError as error:
        raise TypeError(
            f"model must be one that a file can contain, got {type(model).__name__}: {error}"
        ) from error
    constants = [np.zeros(0, np.float32), *(one.numpy().ravel() for one in program.constants)]
    write_tensors(
        path,
        {"reads_frame": np.array(program.reads_frame, np.int64)}
        | {f"plan.{name}": array for name, array in places.arrays().items()}
        | dict(
            program=np.array(program.words, np.int64),
            constants=np.concatenate(constants),
            weights=program.weights.numpy(),
        ),
        {"darswin_network": _VERSION, "plan.output": places.output, "finish": program.finish}
        | {f"label.{k}": name for k, name in enumerate(names)},
    )


@torch.no_grad()
def _plan(
    sample: nn.Module, lens: Lens | None, size: Pair, form: _Form, *, exact: bool = True
) -> Plan:
    """The points of views are as exact as can be; or, without `exact`, those at which a model
    itself reads. A polar grid is always the model's own: its samples have the bits of
    `polar_sample`."""
    lens = check_lens(lens, size)
    if len(lens) != 1:
        raise ValueError(f"a plan needs one lens, got {len(lens)}")
    view = sample.view if isinstance(sample, Model) else sample
    if not isinstance(view, View):
        raise TypeError(f"sample must be a model or a view of darswin, got {type(sample).__name__}")
    lens = lens.to("cpu", torch.float64 if exact and isinstance(view, PixelView) else None)
    prepared = view.prepare(lens, size, back=False)
    if isinstance(view, PolarView):
        names = ("radii", "azimuths", "center", "affine", "offsets")
        parts = {name: getattr(prepared.grid, name) for name in names}
        grid: Any = {k: None if part is None else part.float().numpy() for k, part in parts.items()}
        return Plan.of_grid(
            **grid, size=size, samples=view.samples, **_form_of(sample, view.layout, form)
        )
    if prepared.points is None:
        raise ValueError("the model takes images as they are: it needs no plan")
    points = prepared.points[0].double().numpy()
    k = points.shape[1] // view.size[1] if isinstance(view, PixelView) and view.size else 1
    return Plan.of_points(
        points, size, tiles=view.count, supersampling=k, **_form_of(sample, "image", form)
    )


def _every_pixel(model: Model, size: Pair, form: _Form) -> Plan:
    """The plan of a model that takes images of (H, W) as they are."""
    y, x = (np.arange(side, dtype=np.float64) for side in size)
    return Plan.of_points(np.stack(np.meshgrid(x, y), -1), size, **_form_of(model, "image", form))


def _form_of(sample: Any, usual: Output, form: _Form) -> dict[str, Any]:
    """The output, mean and std of a plan. They are those of the model or the view by default."""
    output, mean, std = form
    output = output or usual
    if output == "uint8":
        mean, std = 0.0 if mean is None else mean, 1.0 if std is None else std
    mean, std = sample.mean if mean is None else mean, sample.std if std is None else std
    if mean is None or std is None:
        raise ValueError(
            f"this {type(sample).__name__} does not say how frames are normalised: give the mean "
            "and the std of its network"
        )
    channels = (isinstance(sample, Model) and sample.in_chans) or max(np.size(mean), np.size(std))
    mean, std = per_channel("mean", mean, channels), per_channel("std", std, channels)
    return dict(output=output, mean=mean, std=std)
