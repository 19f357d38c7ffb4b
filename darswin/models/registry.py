"""Models by name. Each model's file registers its class in four sizes. The folder `weights` has the
trained models that come with darswin."""

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from darswin.models.base import Model
from darswin.utils.nearest import add_meant, did_you_mean
from darswin.views import View, make_view

_SMALL = dict(embed_dim=96, depths=(2, 2, 18, 2), num_heads=(3, 6, 12, 24), drop_path_rate=0.2)
_SIZES: dict[str, dict[str, Any]] = dict(
    small=_SMALL,
    tiny=dict(_SMALL, depths=(2, 2, 6, 2), drop_path_rate=0.1),
    micro=dict(embed_dim=32, depths=(2, 2, 4, 2), num_heads=(1, 2, 4, 8), drop_path_rate=0.05),
    # For tests and demos: three stages on 32×32 images train in a minute on two cores.
    nano=dict(embed_dim=24, depths=(1, 2, 1), num_heads=(1, 2, 4), drop_path_rate=0.0),
)
# Name → the class, the function or class that makes it, and its options.
_MODELS: dict[str, tuple[type[Model], Callable[..., Model], dict[str, Any]]] = {}
_WEIGHTS = Path(__file__).with_name("weights")

Presets = Mapping[str, Mapping[str, Any]]
_Make = TypeVar("_Make", bound=Callable[..., Model])


def register_model(
    family: str,
    *,
    presets: Presets,
    sizes: Presets = _SIZES,
    kind: type[Model] | None = None,
    **options: Any,
) -> Callable[[_Make], _Make]:
    """Registers the decorated class in four sizes: `FAMILY_small`, `FAMILY_tiny` and so on.

    Args:
        presets: options for single sizes.
        sizes: the four sizes, if they are not those of the transformers.
        kind: the class of the models, if a function is decorated that makes them.
        options: options for all sizes. They include `image_size` if the model takes images of a
            single size.
    """

    def register(make: _Make) -> _Make:
        model = make if kind is None else kind
        assert isinstance(model, type)
        for size, common in sizes.items():
            settings = {**common, **options, **presets.get(size, {})}
            _MODELS[f"{family}_{size}"] = model, make, settings
        return make

    return register


def list_models() -> list[str]:
    """The names of all models that `create_model` can make."""
    return sorted(_MODELS)


def model_class(name: str) -> type[Model]:
    """The class of the model with this name; ValueError for an unknown name."""
    if name in list_pretrained():
        raise ValueError(f"{name!r} is a trained model: load_model({name!r}) loads it")
    if name not in _MODELS:
        raise ValueError(f"unknown model {name!r}{nearest_models(name, list_models())}")
    return _MODELS[name][0]


def nearest_models(name: str, names: Sequence[str]) -> str:
    """The end of a sentence, which suggests the two names that are most like the given one."""
    return f"{did_you_mean(name, names, 2, 0)} `darswin models` lists all names"


def preset(name: str) -> dict[str, Any]:
    """The options that the name of a model stands for; ValueError for an unknown name."""
    model_class(name)
    return dict(_MODELS[name][2])


def make(name: str, **options: Any) -> Model:
    """A new model with this name, with these options in place of those of `preset`."""
    options = preset(name) | options
    if isinstance(options.get("view"), Mapping):
        options["view"] = _view(options)
    kind, constructor, presets = _MODELS[name]
    try:
        return constructor(**options)
    except TypeError as error:
        add_meant(error, {*presets, *inspect.signature(kind).parameters})
        raise


def _view(options: dict[str, Any]) -> View:
    """The view that `options` describe; takes what it needs out of them."""
    given = {"size": options.pop("size", None) or options.get("image_size"), **options["view"]}
    if "name" not in given:
        raise ValueError(f"view must have a name, got {options['view']}")
    for key, usual in (("mean", 0.0), ("std", 1.0)):
        value = options.pop(key, None)
        given.setdefault(key, usual if value is None else value)
    return make_view(**given)


def has_image_size(name: str) -> bool:
    """True if the model with this name takes images of a single size, its option `image_size`."""
    return "image_size" in preset(name)


def list_pretrained() -> list[str]:
    """The names of the trained models for `load_model` and `darswin predict --model`."""
    return sorted(file.stem for file in _WEIGHTS.glob("*.safetensors"))


def no_weights(name: str) -> ValueError:
    """The error for a name that is none of `list_pretrained()`."""
    known = ", ".join(list_pretrained())
    if name in _MODELS:
        return ValueError(
            f"no trained {name} comes with darswin; load_model and `darswin predict --model` know "
            f"{known}, and `darswin fit` trains other models"
        )
    return ValueError(f"no model {name!r} comes with darswin; the models are {known}")


def pretrained_file(
    name: str, kind: Literal["safetensors", "md", "png", "json"] = "safetensors"
) -> Path:
    """The path of a file that comes with a trained model.

    Args:
        name: one of `list_pretrained()`.
        kind: "safetensors" for the weights, "md" for the description, "png" for the sample picture,
            "json" for the lens of that picture.

    Raises:
        ValueError: the name is unknown.
    """
    if name not in list_pretrained():
        raise no_weights(name)
    return _WEIGHTS / f"{name}.{kind}"
