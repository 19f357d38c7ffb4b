"""Creating models by name, with the type of each name."""

from collections.abc import Sequence
from typing import Any, Literal, overload

from darswin.models.conv_unet import ConvUnet
from darswin.models.darswin import DarSwin
from darswin.models.dat import DAT
from darswin.models.encoder import Encoder, FeatureMaps, Format
from darswin.models.pixel import PixelModel
from darswin.models.registry import make, model_class, no_weights
from darswin.models.swin import Swin
from darswin.models.unet import Unet
from darswin.utils.tasks import PixelTask

# The names of each class, for type checkers.
DarSwinName = Literal[
    "darswin_a_small", "darswin_a_tiny", "darswin_a_micro", "darswin_a_nano",
    "darswin_ra_small", "darswin_ra_tiny", "darswin_ra_micro", "darswin_ra_nano",
]  # fmt: skip
DATName = Literal["dat_small", "dat_tiny", "dat_micro", "dat_nano"]
SwinName = Literal["swin_small", "swin_tiny", "swin_micro", "swin_nano"]
UnetName = Literal[
    "darswin_unet_a_small", "darswin_unet_a_tiny", "darswin_unet_a_micro", "darswin_unet_a_nano",
    "darswin_unet_ra_small", "darswin_unet_ra_tiny", "darswin_unet_ra_micro",
    "darswin_unet_ra_nano", "swin_unet_small", "swin_unet_tiny", "swin_unet_micro",
    "swin_unet_nano",
]  # fmt: skip
ConvUnetName = Literal["conv_unet_small", "conv_unet_tiny", "conv_unet_micro", "conv_unet_nano"]


@overload
def create_model(
    name: DarSwinName, *, features_only: Literal[False] = ..., **options: Any
) -> DarSwin: ...
@overload
def create_model(name: DATName, *, features_only: Literal[False] = ..., **options: Any) -> DAT: ...
@overload
def create_model(
    name: SwinName, *, features_only: Literal[False] = ..., **options: Any
) -> Swin: ...
@overload
def create_model(
    name: UnetName, *, features_only: Literal[False] = ..., **options: Any
) -> Unet: ...
@overload
def create_model(
    name: ConvUnetName, *, features_only: Literal[False] = ..., **options: Any
) -> ConvUnet: ...
@overload
def create_model(
    name: str,
    *,
    features_only: Literal[True],
    out_indices: int | Sequence[int] | None = ...,
    output_fmt: Format | None = ...,
    **options: Any,
) -> FeatureMaps: ...
@overload
def create_model(
    name: str, *, task: PixelTask, features_only: Literal[False] = ..., **options: Any
) -> PixelModel: ...
@overload
def create_model(
    name: str, *, features_only: Literal[False] = ..., **options: Any
) -> Encoder | PixelModel: ...
@overload
def create_model(
    name: str,
    *,
    features_only: bool,
    out_indices: int | Sequence[int] | None = ...,
    output_fmt: Format | None = ...,
    **options: Any,
) -> Encoder | PixelModel | FeatureMaps: ...


def create_model(
    name: str,
    *,
    features_only: bool = False,
    out_indices: int | Sequence[int] | None = None,
    output_fmt: Format | None = None,
    pretrained: bool = False,
    **options: Any,
) -> Encoder | PixelModel | FeatureMaps:
    """A new model: an `Encoder`, which classifies images, or a `Unet`, which predicts per pixel.

    Args:
        name: one of `list_models()`.
        features_only: makes a `FeatureMaps`, which returns the maps of an encoder's stages.
        out_indices, output_fmt: the options of `FeatureMaps`.
        pretrained: True is an error, because `load_model` loads trained models.
        options: arguments of the model's class, in place of the defaults for this name. `view` may
            also be the arguments of `make_view`, as in the card of a model:
            `dict(name="mercator", size=64, fov=2.0)`.

    Raises:
        ValueError: the name is unknown, or the options do not fit together.
    """
    if not features_only and (out_indices is not None or output_fmt is not None):
        raise ValueError("out_indices and output_fmt need features_only=True")
    model_class(name)  # which knows the name, or raises an error
    if pretrained:
        raise no_weights(name)
    model: Any = make(name, **options)
    model.pretrained_cfg["architecture"] = name
    if not features_only:
        return model
    if not isinstance(model, Encoder):
        raise ValueError(f"features_only is for encoders, but {name} is a Unet")
    return FeatureMaps(model, out_indices, output_fmt or "NHWC")
