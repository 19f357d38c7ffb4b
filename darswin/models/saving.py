"""Models as files: safetensors, with what is needed to build the model in their metadata."""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from darswin.layers.quantized import Quantization, with_quantized_layers
from darswin.models.pretrained import list_pretrained, pretrained_file
from darswin.models.registry import create_model
from darswin.utils.files import replace_file

Task = Literal["classification", "segmentation", "distance"]

_ENTRY = "darswin"  # of the metadata


class NoCardError(ValueError):
    """A safetensors file that does not say what model its weights are of."""


@dataclass(frozen=True)
class ModelCard:
    """What a model file says besides its weights.

    Args:
        model: a name of `create_model`. options: its options.
        classes: names of the logits.
        size: px, of the images it was trained on. fov: rad, the field of view of their lenses, 0
            where calibrations say it.
        fit: how a camera's pictures get that size, as `darswin.data.frames.at_size` takes it:
            "whole" where it was trained through the lenses of `darswin.data.WideAngle`.
        task: what it tells: a class for an image, or a class or a distance for each pixel.
        colors: (r, g, b) in 0 … 255 of each class, where the data say them.
        quantized: for each layer of int8 weights its name and how its input becomes 8 bits, (scale,
            zero point): see `darswin.deploy.quantize.quantize_model`.
    """

    model: str
    options: Mapping[str, Any] = field(default_factory=dict)
    classes: Sequence[str] = ()
    size: int = 64
    fov: float = 0.0
    fit: Literal["crop", "stretch", "whole"] = "whole"
    task: Task = "classification"
    colors: Sequence[Sequence[int]] = field(default_factory=list)
    quantized: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def create(self) -> Any:
        """The model, with new weights."""
        model = create_model(self.model, **self.options)
        activations = {
            name: Quantization(float(scale), int(zero_point))
            for name, (scale, zero_point) in self.quantized.items()
        }
        with_quantized_layers(model, activations)
        return model


def save_model(path: str | os.PathLike, weights: Mapping[str, Tensor], card: ModelCard) -> None:
    """Writes a model's state dict and its card, replacing what stood there in one go."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    replace_file(
        path, save(contiguous, metadata={_ENTRY: json.dumps(asdict(card), allow_nan=False)})
    )


def model_of_run(run: str | os.PathLike, suffix: str = ".safetensors") -> Path:
    """The best model of a run of `darswin fit`, or, before there is one, the last.

    Raises:
        FileNotFoundError: neither.
    """
    folder = Path(run) / "checkpoints"
    for name in ("best", "last"):
        if (path := folder / f"{name}{suffix}").exists():
            return path
    raise FileNotFoundError(f"there is no model in {run} yet")


def read_card(path: str | os.PathLike) -> ModelCard:
    """The card of a model's file, or of a name in `list_pretrained()`, without its weights.

    Raises:
        NoCardError: other weights. ValueError: no model file of darswin.
    """
    path = _model_file(path)
    with _opened(path) as file:
        return _card(file, path)


def load_model(path: str | os.PathLike) -> tuple[Any, ModelCard]:
    """The model of a file, or of a name in `list_pretrained()`, in eval mode, and its card.

    Raises:
        NoCardError: other weights. ValueError: no model file of darswin, or weights that are not
            those of its model.
    """
    path = _model_file(path)
    with _opened(path) as file:
        card = _card(file, path)
        weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    try:
        model = card.create()
        model.load_state_dict(weights)
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise _unknown(path, error) from error
    model.pretrained_cfg |= dict(label_names=tuple(card.classes), file=str(path))
    if model.image_size is None:
        model.pretrained_cfg["input_size"] = (model.in_chans, card.size, card.size)
    if card.quantized:
        model.requires_grad_(False)
    return model.eval(), card


def _model_file(path: str | os.PathLike) -> str | os.PathLike:
    return pretrained_file(str(path)) if path in list_pretrained() else path


@contextmanager
def _opened(path: str | os.PathLike) -> Iterator[Any]:
    try:
        with safe_open(path, "pt") as file:
            yield file
    except SafetensorError as error:
        raise ValueError(f"{path} is no safetensors file: {error}") from error


def _card(file: Any, path: str | os.PathLike) -> ModelCard:
    entry = (file.metadata() or {}).get(_ENTRY)
    if entry is None:
        raise NoCardError(f"{path} holds weights, but not the name of their model")
    try:
        values = json.loads(entry)
        # Older files do not say all of it.
        known = {field.name for field in fields(ModelCard)}
        return ModelCard(**{name: values[name] for name in known if name in values})
    except (ValueError, TypeError) as error:
        raise _unknown(path, error) from error


def _unknown(path: str | os.PathLike, error: Exception) -> ValueError:
    return ValueError(f"{path} is no model that this darswin can build: {error}")
