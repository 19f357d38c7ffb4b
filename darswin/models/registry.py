"""Named models: each model's file registers its class under a name, in four sizes."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypeVar

from darswin.models.base import Model
from darswin.models.encoder import Encoder
from darswin.models.feature_maps import FeatureMaps

_SMALL = dict(embed_dim=96, depths=(2, 2, 18, 2), num_heads=(3, 6, 12, 24), drop_path_rate=0.2)
_SIZES: dict[str, dict[str, Any]] = dict(
    small=_SMALL,
    tiny=dict(_SMALL, depths=(2, 2, 6, 2), drop_path_rate=0.1),
    micro=dict(embed_dim=32, depths=(2, 2, 4, 2), num_heads=(1, 2, 4, 8), drop_path_rate=0.05),
    # For tests and demos: 32×32 images, three stages, a minute of training on two cores.
    nano=dict(embed_dim=24, depths=(1, 2, 1), num_heads=(1, 2, 4), drop_path_rate=0.0),
)
_MODELS: dict[str, tuple[type[Model], dict[str, Any]]] = {}

Presets = Mapping[str, Mapping[str, Any]]
_Class = TypeVar("_Class", bound=type[Model])


def register_model(family: str, *, presets: Presets, **options: Any) -> Callable[[_Class], _Class]:
    """Decorates a model's class: `create_model` knows it as `FAMILY_small`, `FAMILY_tiny` …

    Args:
        presets: for a size, the constructor's arguments beyond those that all models of it have.
        options: the arguments of every size.
    """

    def register(model: _Class) -> _Class:
        for size, common in _SIZES.items():
            _MODELS[f"{family}_{size}"] = model, {**common, **presets.get(size, {}), **options}
        return model

    return register


def list_models() -> list[str]:
    """The names that `create_model` knows."""
    return sorted(_MODELS)


def create_model(
    name: str,
    *,
    features_only: bool = False,
    out_indices: int | Sequence[int] | None = None,
    output_fmt: Literal["NHWC", "NCHW"] | None = None,
    **options: Any,
) -> Any:
    """The model of that name: an `Encoder`, which classifies, or a `DenseModel`.

    Args:
        features_only: makes an encoder a `FeatureMaps`, which gives the maps of its stages.
        out_indices, output_fmt: of `FeatureMaps`.
        options: override the arguments of the model's constructor.

    Raises:
        ValueError: an unknown name, or options that do not fit together.
    """
    if not features_only and (out_indices is not None or output_fmt is not None):
        raise ValueError("out_indices and output_fmt need features_only=True")
    model = model_class(name)(**(_MODELS[name][1] | options))
    model.pretrained_cfg["architecture"] = name
    if not features_only:
        return model
    if not isinstance(model, Encoder):
        raise ValueError(f"features_only is for encoders, and {name} is a dense model")
    return FeatureMaps(model, out_indices, output_fmt or "NHWC")


def model_class(name: str) -> type[Model]:
    """The class of the models of that name; ValueError for a name that there is not."""
    if name not in _MODELS:
        raise ValueError(f"unknown model {name!r}; there are {', '.join(list_models())}")
    return _MODELS[name][0]
