"""Models by name: each model's file registers its class under a name, in four sizes; and the
trained models that come with darswin, in `weights/`."""

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar

from darswin.models.base import Model
from darswin.models.encoder import Encoder, FeatureMaps

_SMALL = dict(embed_dim=96, depths=(2, 2, 18, 2), num_heads=(3, 6, 12, 24), drop_path_rate=0.2)
_SIZES: dict[str, dict[str, Any]] = dict(
    small=_SMALL,
    tiny=dict(_SMALL, depths=(2, 2, 6, 2), drop_path_rate=0.1),
    micro=dict(embed_dim=32, depths=(2, 2, 4, 2), num_heads=(1, 2, 4, 8), drop_path_rate=0.05),
    # For tests and demos: 32×32 images, three stages, a minute of training on two cores.
    nano=dict(embed_dim=24, depths=(1, 2, 1), num_heads=(1, 2, 4), drop_path_rate=0.0),
)
_MODELS: dict[str, tuple[type[Model], dict[str, Any]]] = {}
_WEIGHTS = Path(__file__).with_name("weights")

Presets = Mapping[str, Mapping[str, Any]]
_Class = TypeVar("_Class", bound=type[Model])


def register_model(family: str, *, presets: Presets, **options: Any) -> Callable[[_Class], _Class]:
    """Decorates a model's class: `create_model` makes it as `FAMILY_small`, `FAMILY_tiny` … with
    the options of every size and the presets of its own. "image_size" is an option of those whose
    images must all have one."""

    def register(model: _Class) -> _Class:
        for size, common in _SIZES.items():
            _MODELS[f"{family}_{size}"] = model, {**common, **options, **presets.get(size, {})}
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
    compat: Literal["official"] | None = None,
    **options: Any,
) -> Any:
    """The model of that name: an `Encoder`, which classifies, or a `Unet`, for each pixel.

    Args:
        features_only: makes an encoder a `FeatureMaps`, which gives the maps of its stages.
        out_indices, output_fmt: of `FeatureMaps`.
        compat: "official" makes a "darswin_a" the authors' released one, `OfficialDarSwin`.
        options: override the arguments of the model's constructor.

    Raises:
        ValueError: an unknown name, or options that do not fit together.
    """
    if not features_only and (out_indices is not None or output_fmt is not None):
        raise ValueError("out_indices and output_fmt need features_only=True")
    kind = model_class(name)
    if compat is not None:
        forms = import_module("darswin.compat").FORMS  # when asked for: the room lies above
        if compat not in forms or not issubclass(forms[compat], kind):
            raise ValueError(
                f"compat must be None, or one of {tuple(forms)} for DarSwin; got {compat!r} for "
                f"{kind.__name__}"
            )
        kind = forms[compat]
    model = kind(**(_MODELS[name][1] | options))
    model.pretrained_cfg["architecture"] = name
    if not features_only:
        return model
    if not isinstance(model, Encoder):
        raise ValueError(f"features_only is for encoders, and {name} is none")
    return FeatureMaps(model, out_indices, output_fmt or "NHWC")


def model_class(name: str) -> type[Model]:
    """The class of the models of that name; ValueError for a name that there is not."""
    if name not in _MODELS:
        raise ValueError(f"unknown model {name!r}; there are {', '.join(list_models())}")
    return _MODELS[name][0]


def has_image_size(name: str) -> bool:
    """True if models of this name take images of one size only, the option `image_size`."""
    model_class(name)
    return "image_size" in _MODELS[name][1]


def list_pretrained() -> list[str]:
    """The names of trained models that `load_model` and `darswin predict --model` know."""
    return sorted(file.stem for file in _WEIGHTS.glob("*.safetensors"))


def pretrained_file(
    name: str, kind: Literal["safetensors", "md", "png", "json"] = "safetensors"
) -> Path:
    """A file of a model that comes with darswin: its weights, its model card, its sample picture,
    or that picture's lens.

    Raises:
        ValueError: an unknown name.
    """
    if name not in list_pretrained():
        raise ValueError(
            f"no model {name!r} comes with darswin; there are {', '.join(list_pretrained())}"
        )
    return _WEIGHTS / f"{name}.{kind}"
