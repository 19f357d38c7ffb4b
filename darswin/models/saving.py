"""Model files: safetensors with a description of the model, its card, in their metadata."""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args, overload

from torch import Tensor

from darswin.layers.quantized import Quantization, with_quantized_layers
from darswin.lens.files.fields import short
from darswin.models.create import create_model
from darswin.models.darswin import DarSwin
from darswin.models.described import described
from darswin.models.encoder import Encoder
from darswin.models.pixel import PixelModel
from darswin.models.registry import list_models, list_pretrained, no_weights, pretrained_file
from darswin.utils.tasks import Fit, Task
from darswin.utils.tensor_files import read_metadata, read_tensors, write_tensors

_ENTRY = "darswin"  # the key of the card in the metadata


class NoCardError(ValueError):
    """The error for a safetensors file without a model card."""


@dataclass(frozen=True)
class ModelCard:
    """The description of a model in its file, beside the weights.

    Args:
        model: the name of the model, for `create_model`.
        options: the options of the model, for `create_model`. The card keeps a view, also a `View`
            or the name of one, as the arguments of `make_view`.
        classes: the names of the classes, in the order of the logits.
        size: the side of the training images, in pixels.
        fov: the field of view of the training lenses, in rad; 0 if they came from calibrations.
        fit: the way in which a camera's pictures get this size, as in `darswin.data.fitted`.
            "whole" is for models trained through the lenses of `darswin.data.WideAngle`.
        task: "classification" of images, or "segmentation" or "distance" for every pixel.
        colors: the color (r, g, b) of each class, in 0 … 255, if the data have colors.
        quantized: for each layer with int8 weights, the quantization (scale, zero point) of its
            input; see `darswin.deploy.quantize.quantize_model`.
    """

    model: str
    options: Mapping[str, Any] = field(default_factory=dict)
    classes: Sequence[str] = ()
    size: int = 64
    fov: float = 0.0
    fit: Fit = "whole"
    task: Task = "classification"
    colors: Sequence[Sequence[int]] = field(default_factory=list)
    quantized: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", described(self.model, self.options))

    @property
    def channels(self) -> int:
        """The number of channels of the images, 1 for grey and 3 for colours."""
        return self.options.get("in_chans", 3)

    @property
    def mean(self) -> float | Sequence[float]:
        """The mean of the normalization, for pixels in [0, 1]; see `Model.normalize`."""
        return self.options.get("mean", 0.0)

    @property
    def std(self) -> float | Sequence[float]:
        """The standard deviation of the normalization, for pixels in [0, 1]."""
        return self.options.get("std", 1.0)

    def __repr__(self) -> str:
        shown = {field.name: getattr(self, field.name) for field in fields(self)}
        shown |= dict(channels=self.channels, mean=self.mean, std=self.std)
        return f"ModelCard({', '.join(f'{name}={value!r}' for name, value in shown.items())})"

    def create(self) -> Encoder | PixelModel:
        """The model, with new weights."""
        model = create_model(self.model, **self.options)
        activations = {
            name: Quantization(float(scale), int(zero_point))
            for name, (scale, zero_point) in self.quantized.items()
        }
        with_quantized_layers(model, activations)
        return model


def save_model(path: str | os.PathLike, weights: Mapping[str, Tensor], card: ModelCard) -> None:
    """Writes a model's state dict and its card to a file. An older file is replaced in one step."""
    contiguous = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    write_tensors(path, contiguous, {_ENTRY: json.dumps(asdict(card), allow_nan=False)})


def model_of_run(run: str | os.PathLike, suffix: str = ".safetensors") -> Path:
    """The path of the best model of a `darswin fit` run, or of the last one if no best exists."""
    folder = Path(run) / "checkpoints"
    for name in ("best", "last"):
        if (path := folder / f"{name}{suffix}").exists():
            return path
    raise FileNotFoundError(f"there is no model in {run} yet")


def read_card(path: str | os.PathLike) -> ModelCard:
    """The card of a model file, read without the weights.

    Args:
        path: the path of the file, or the name of a trained model, which `darswin models` lists.

    Raises:
        NoCardError: the file has no card.
        ValueError: the file is no safetensors file, or its card is wrong.
    """
    path = model_file(path)
    return _card(path, read_metadata(path))


@overload
def load_model(path: Literal["digits"]) -> tuple[DarSwin, ModelCard]: ...
@overload
def load_model(path: str | os.PathLike) -> tuple[Encoder | PixelModel, ModelCard]: ...


def load_model(path: str | os.PathLike) -> tuple[Any, ModelCard]:
    """The model from a file, in eval mode, and its card.

    Args:
        path: the path of the file, or the name of a trained model, which `darswin models` lists.

    Raises:
        ValueError: the file is no safetensors file or is damaged, it has no card or a wrong one, or
            the weights do not fit the model of the card.
    """
    path = model_file(path)
    weights, metadata = read_tensors(path)
    card = _card(path, metadata)
    with _about(path):
        model = _created(card, weights)
    model.pretrained_cfg |= dict(label_names=tuple(card.classes), file=str(path))
    if model.image_size is None:
        model.pretrained_cfg["input_size"] = (model.in_chans, card.size, card.size)
    if card.quantized:
        model.requires_grad_(False)
    return model.eval(), card


def model_file(path: str | os.PathLike) -> str | os.PathLike:
    """The path, or that of the trained model with this name.

    Raises:
        ValueError: the name is that of a model without trained weights.
        FileNotFoundError: there is neither a file nor a model of this name.
    """
    name = os.fspath(path)
    is_name = not (os.path.dirname(name) or os.path.splitext(name)[1] or os.path.exists(name))
    if is_name and name not in (*list_pretrained(), *list_models()):
        raise FileNotFoundError(f"there is no file {name}, and {no_weights(name)}")
    return pretrained_file(name) if is_name or name in list_pretrained() else path


def _card(path: str | os.PathLike, metadata: Mapping[str, str]) -> ModelCard:
    """The card in the metadata of a file."""
    if _ENTRY not in metadata:
        raise NoCardError(f"{path} has weights, but not the name of their model")
    with _about(path):
        return _parsed(metadata[_ENTRY])


def _parsed(entry: str) -> ModelCard:
    try:
        values = json.loads(entry)
    except ValueError as error:
        raise ValueError(f"its model card is no JSON: {error}") from error
    if type(values) is not dict:
        raise ValueError(f"its model card must be an object, got {short(values)}")
    if missing := [name for name in _FIELDS if name not in values]:
        raise ValueError(f"its model card lacks {', '.join(missing)}")
    known = {name: values[name] for name in _FIELDS}
    for name, value in known.items():
        fits, expected = _FIELDS[name]
        if not fits(value):
            raise ValueError(f"its {name} must be {expected}, got {short(value)}")
    return ModelCard(**known)


def _created(card: ModelCard, weights: Mapping[str, Tensor]) -> Encoder | PixelModel:
    """The card's model with these weights; ValueError if they do not fit."""
    try:
        model = card.create()
    except ValueError:
        raise
    except Exception as error:  # of a constructor that got a wrong type
        options = json.dumps(card.options)
        raise ValueError(f"a {card.model} cannot be made with the options {options}") from error
    try:
        model.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(" ".join(str(error).split())[:1000]) from error
    return model


def _is_number(value: Any, least: float = -math.inf, most: float = math.inf) -> bool:
    return type(value) in (int, float) and math.isfinite(value) and least <= value <= most


def _is_whole(value: Any, least: int, most: float = math.inf) -> bool:
    return type(value) is int and _is_number(value, least, most)


def _are(kind: Callable[[Any], bool], values: Any) -> bool:
    return type(values) is list and all(map(kind, values))


def _is_color(value: Any) -> bool:
    return _are(lambda part: _is_whole(part, 0, 255), value) and len(value) == 3


def _is_quantization(value: Any) -> bool:
    return _are(_is_number, value) and len(value) == 2 and value[0] > 0


# For each field of a card: a check of its value, and the expected value in words. Values from JSON
# have exactly Python's types, and True is no number.
_FIELDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "model": (lambda value: type(value) is str, "the name of a model"),
    "options": (lambda value: type(value) is dict, "an object"),
    "classes": (
        lambda value: _are(lambda name: type(name) is str, value), "a list of names"),
    "size": (lambda value: _is_whole(value, 1), "a whole number above 0"),
    "fov": (lambda value: _is_number(value, 0, 2 * math.pi), "an angle in rad, 0 to 2π"),
    "fit": (lambda value: value in get_args(Fit), f"one of {get_args(Fit)}"),
    "task": (lambda value: value in get_args(Task), f"one of {get_args(Task)}"),
    "colors": (lambda value: _are(_is_color, value), "a list of three numbers, 0 to 255, each"),
    "quantized": (
        lambda value: type(value) is dict and all(map(_is_quantization, value.values())),
        "an object with a scale above 0 and a zero point for each layer"),
}  # fmt: skip


@contextmanager
def _about(path: str | os.PathLike) -> Iterator[None]:
    """Adds the path of the file to the message of a ValueError."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path} is no model that this darswin can build: {error}") from error
