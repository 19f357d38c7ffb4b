"""Runs that start from a trained model: what its card decides, its weights, its frozen stages."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import nn

from darswin.models.encoder import Encoder
from darswin.models.saving import ModelCard, load_model, model_of_run

# What the data decide of a model's options.
OF_DATA = ("num_classes", "in_chans", "mean", "std", "image_size")
# Options that change nothing but how a model trains.
OF_TRAINING = ("drop_path_rate", "jitter")


def weights_file(weights: str | Path) -> str | Path:
    """The model of a run's folder; anything else as it is."""
    return model_of_run(weights) if Path(weights).is_dir() else weights


def own_options(card: ModelCard) -> dict[str, Any]:
    """The options of a model but for those that the data decide."""
    return {name: value for name, value in card.options.items() if name not in OF_DATA}


def settle(
    card: ModelCard, weights: str, model: Mapping[str, Any], data: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options of a run that starts from a model: those not given, None, are the model's.

    Args:
        model: `name` and `options`. data: `size`, `channels`, `mean` and `std`.

    Returns:
        The same, all of them said.

    Raises:
        ValueError: an option that disagrees with the model; it names both.
    """

    def refuse(option: str, value: Any, theirs: Any) -> ValueError:
        return ValueError(
            f"--{option} {value} disagrees with --model.weights {weights}, whose model has "
            f"{theirs}; leave it out"
        )

    if model["name"] not in (None, card.model):
        raise refuse("model.name", model["name"], card.model)
    own = own_options(card)
    options = dict(model["options"] or {})
    for name, value in options.items():
        if name not in OF_TRAINING and _plain(own.get(name)) != _plain(value):
            raise refuse("model.options", {name: value}, {name: own.get(name)})
    found = {}
    theirs = {
        "size": card.size,
        "channels": card.options.get("in_chans", 3),
        "mean": card.options.get("mean"),
        "std": card.options.get("std"),
    }
    for name, value in theirs.items():
        found[name] = value if data[name] is None else data[name]
        # A model that takes images of any size may go on with another one.
        free = name == "size" and "image_size" not in card.options
        if not free and value is not None and _plain(found[name]) != _plain(value):
            raise refuse(f"data.{name}", found[name], value)
    return {"name": card.model, "options": own | options}, found


def _plain(value: Any) -> Any:
    """Tuples as lists, as JSON has them."""
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def start_from(net: Encoder, classes: list[str], weights: str | Path) -> None:
    """Copies a model's weights into a network; its head too, if it is of the same classes.

    Raises:
        ValueError: the weights of another model.
    """
    trained, card = load_model(weights_file(weights))
    there = trained.state_dict()
    if list(card.classes) != list(classes):
        there = {name: t for name, t in there.items() if not name.startswith("head.")}
    own = net.state_dict()
    other = sorted(
        name for name in own.keys() | there.keys()
        if not (name.startswith("head.") and name not in there)
        and (name not in own or name not in there or own[name].shape != there[name].shape)
    )  # fmt: skip
    if other:
        raise ValueError(f"{weights} holds the weights of another model: {', '.join(other[:3])}")
    net.load_state_dict(there, strict=False)


def frozen_parts(net: Encoder, stages: int) -> list[nn.Module]:
    """The modules that are not trained: the embedding and the first stages; all but the head, where
    these are all stages.

    Raises:
        ValueError: more stages than there are.
    """
    if not 0 <= stages <= len(net.stages):
        raise ValueError(
            f"--model.freeze_stages must be from 0 to the model's {len(net.stages)} stages, got "
            f"{stages}"
        )
    if not stages:
        return []
    trained = {"head", "stages"} | ({"norm"} if stages < len(net.stages) else set())
    rest = [module for name, module in net.named_children() if name not in trained]
    return [*rest, *net.stages[:stages]]
