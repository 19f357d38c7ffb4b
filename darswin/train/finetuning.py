"""Runs that start from a trained model: its options, weights and frozen stages."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from torch import nn

from darswin.layers.quantized import without_quantized_layers
from darswin.models.base import Model
from darswin.models.described import described
from darswin.models.encoder import Encoder
from darswin.models.pixel import PixelModel
from darswin.models.registry import list_models, model_class, nearest_models, preset
from darswin.models.saving import ModelCard, load_model, model_of_run
from darswin.models.unet import Unet
from darswin.utils.parameters import check, naming
from darswin.utils.tasks import PixelTask, Task

# Options of a model that follow from the data.
OF_DATA = ("task", "num_classes", "in_chans", "mean", "std", "image_size")
# Options that only affect training.
OF_TRAINING = ("drop_path_rate", "jitter")


def weights_file(weights: str | Path) -> str | Path:
    """The model in a run's folder; other paths and names unchanged."""
    return model_of_run(weights) if Path(weights).is_dir() else weights


def own_options(card: ModelCard, name: str) -> dict[str, Any]:
    """The options that the model `name` takes from a trained one; others follow from the data."""
    own = {option: value for option, value in card.options.items() if option not in OF_DATA}
    if name != card.model:  # a Unet of size "nano" has other depths than the classifier
        own = {"depths": preset(card.model)["depths"]} | own
    return own


def models_for(task: Task) -> list[str]:
    """The names of the models that a task trains."""
    base = Encoder if task == "classification" else PixelModel
    return [name for name in list_models() if issubclass(model_class(name), base)]


def name_from(card: ModelCard, task: Task) -> str:
    """The name of the model for the task: the trained one, or the dense model with its encoder."""
    for name in models_for(task):
        if card.model in (name, name.replace("_unet_", "_")):
            return name
    raise ValueError(f"no model for {task} can start from a {card.model}, a model for {card.task}")


def check_name(name: str, task: Task) -> None:
    """ValueError for an unknown model, or a model for another task."""
    model_class(name)
    if name not in models_for(task):
        text = (
            f"`name` {name} is no model for `task` {task}{nearest_models(name, models_for(task))}"
        )
        raise naming(ValueError(text), "name", "task")


def settle(
    card: ModelCard, weights: str, task: Task, model: Mapping[str, Any], data: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The `name` and `options` of a run's model, and four options of its data. The trained model
    gives options that are None; ValueError if others disagree with it."""

    def refuse(option: str, value: Any, theirs: Any) -> ValueError:
        text = (
            f"`{option}` {value} disagrees with `weights` {weights}, whose model has {theirs}: "
            "leave the option out, or set it to null if a preset sets it"
        )
        return naming(ValueError(text), option, "weights")

    name = name_from(card, task)
    if model["name"] not in (None, name):
        raise refuse("name", model["name"], card.model)
    own = own_options(card, name)
    options = described(name, model["options"] or {})
    for option, value in options.items():
        # A new decoder has its own options.
        if option not in own and name != card.model:
            continue
        if option not in OF_TRAINING and _plain(own.get(option)) != _plain(value):
            raise refuse("options", {option: value}, {option: own.get(option)})
    found = {}
    theirs = {
        "size": card.size,
        "channels": card.channels,
        "mean": card.options.get("mean"),
        "std": card.options.get("std"),
    }
    for option, value in theirs.items():
        found[option] = value if data[option] is None else data[option]
        # Only a model without an image size may change the size.
        free = option == "size" and "image_size" not in card.options
        if not free and value is not None and _plain(found[option]) != _plain(value):
            raise refuse(option, found[option], value)
    return {"name": name, "options": own | options}, found


def _plain(value: Any) -> Any:
    """The value with lists in place of tuples, as in JSON."""
    if isinstance(value, Mapping):
        return {name: _plain(v) for name, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def start_from(net: Model, classes: list[str], weights: str | Path) -> None:
    """Copies the weights of a trained model into a network. The head is copied only for the same
    classes. A classifier fills the encoder of a dense model."""
    trained, card = load_model(weights_file(weights))
    without_quantized_layers(trained)
    own, given = net.state_dict(), trained.state_dict()
    if isinstance(net, Unet) and card.task == "classification":
        given = {f"encoder.{name}": t for name, t in given.items() if not _of_head(name)}
        new = {name for name in own if not name.startswith("encoder.")}
    else:
        # Models for different tasks have different heads.
        same = list(card.classes) == list(classes)
        given = {n: t for n, t in given.items() if not _of_head(n) or (same and n in own)}
        new = {name for name in own if _of_head(name)}
    other = [name for name in given if name not in own or own[name].shape != given[name].shape]
    other += own.keys() - given.keys() - new
    if other:
        named = ", ".join(sorted(other)[:3])
        raise ValueError(f"{weights} holds the weights of another model: {named}")
    net.load_state_dict(given, strict=False)


def _of_head(name: str) -> bool:
    return name.startswith(("head.", *(f"{task}_head." for task in get_args(PixelTask))))


def frozen_parts(net: Encoder | PixelModel, stages: int) -> list[nn.Module]:
    """The frozen modules of the encoder: the embedding and the first `stages` stages, or all except
    the head if these are all stages."""
    net = net.encoder if isinstance(net, Unet) else net
    of_encoder = getattr(net, "stages", ())
    allowed = f"from 0 to the model's {len(of_encoder)} stages"
    check("freeze_stages", stages, 0 <= stages <= len(of_encoder), allowed)
    if not stages:
        return []
    trained = {"head", "stages"} | ({"norm"} if stages < len(of_encoder) else set())
    rest = [module for name, module in net.named_children() if name not in trained]
    return [*rest, *of_encoder[:stages]]
