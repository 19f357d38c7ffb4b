"""Networks for the frames of one camera, in a file that needs no torch."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from darswin.frames.compiled import frames
from darswin.frames.plans import check_name, check_size, plan_of, write_arrays

if TYPE_CHECKING:
    from darswin.lens import Lens
    from darswin.models.base import Model

_VERSION = (1, 0)  # csrc/core/network_file.h describes the file


class Network:
    """A network for the frames of one camera: `network(frame, out=None, threads=1)`.

    A call takes a frame of uint8, (H, W, 3) or (H, W), in any memory layout, so that
    `frame[..., ::-1]` turns OpenCV's BGR into RGB at no cost. It returns float32: the probabilities
    of a classifier, (classes,), or what the model returns for one image without the batch axis,
    such as logits (K, H, W) of pixels, or a list of the maps of a backbone. It runs without
    Python's lock, and several threads may call one network.

    `out` is an array for the result, or a list of arrays for a list: C-contiguous, with its shape
    and type, and in other memory than the frame. `threads` is the most threads to use.

    Args:
        path: a file of `export`.

    Attributes:
        size: (H, W) of the frames.
        channels: their number of channels, 1 or 3.
        shapes: the shapes of the outputs, of which all networks but backbones have one.
        labels: the names of the classes; empty if the file has none.

    Raises:
        TypeError: in a call, the frame is no array of uint8, or `out` no array.
        ValueError: the file is no network, is damaged, or of another version; in a call, the frame
            or `out` does not fit, or they share memory.
        OSError: the file cannot be read.
    """

    def __init__(self, path: str | os.PathLike):
        self._run, size, self.shapes, self.labels = frames.network(os.fsencode(path))
        self.size, self.channels = size[:2], size[2]

    def __call__(self, frame: np.ndarray, out: Any = None, threads: int = 1) -> Any:
        return self._run(frame, out, threads)

    def __repr__(self) -> str:
        return f"Network(size={self.size}, channels={self.channels}, shapes={self.shapes})"


def export(
    model: "Model",
    lens: "Lens | None",
    size: tuple[int, int],
    path: str | os.PathLike,
    *,
    labels: Sequence[str] | None = None,
    mean: float | Sequence[float] | None = None,
    std: float | Sequence[float] | None = None,
) -> None:
    """Writes a network for the frames of one camera, which `Network` runs without torch.

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
    import torch

    from darswin.deploy.forward import NoProgramError, frame_program
    from darswin.deploy.optimize import check_model, optimize
    from darswin.deploy.packed import own_alone
    from darswin.frames.reading import every_pixel, reading
    from darswin.layers.quantized import quantized_layers
    from darswin.models.encoder import FeatureMaps

    check_name(path)
    size = check_size(size)
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
        found = reading(model, lens, size, exact=False)
    else:
        found = every_pixel(model, size)
    plan = plan_of(model, found, size, found.output, mean, std)
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
        {f"plan.{name}": value for name, value in plan.parts().items()}
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
