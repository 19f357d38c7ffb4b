"""Named model sizes. Every model is called `model(images, lens)`."""

from torch import nn

from darswin.models.darswin import DarSwin
from darswin.models.dat import DAT
from darswin.models.swin import Swin, SwinUndis

_SMALL = dict(embed_dim=96, depths=(2, 2, 18, 2), num_heads=(3, 6, 12, 24), drop_path_rate=0.2)
_TINY = dict(_SMALL, depths=(2, 2, 6, 2), drop_path_rate=0.1)
_MICRO = dict(embed_dim=32, depths=(2, 2, 4, 2), num_heads=(1, 2, 4, 8), drop_path_rate=0.05)
# For tests and demos: 32×32 images, three stages, a minute of training on two cores.
_NANO = dict(embed_dim=24, depths=(1, 2, 1), num_heads=(1, 2, 4), drop_path_rate=0.0)
_SIZES = dict(small=_SMALL, tiny=_TINY, micro=_MICRO, nano=_NANO)

# What each family adds to a size. All models of a size have as many tokens.
_POLAR = dict(micro=dict(samples=(6, 6)), nano=dict(rings=8, sectors=32, samples=(4, 4)))
_SQUARE = dict(nano=dict(image_size=32))
_DEFORMABLE = dict(
    micro=dict(groups=(1, 1, 1, 2)),
    nano=dict(image_size=32, blocks=("L", "LD", "D"), groups=(1, 1, 2)),
)

_FAMILIES: dict[str, tuple[type[nn.Module], dict, dict[str, dict]]] = {
    "darswin_a": (DarSwin, dict(variant="A"), _POLAR),
    "darswin_ra": (DarSwin, dict(variant="RA"), _POLAR),
    "dat": (DAT, {}, _DEFORMABLE),
    "swin": (Swin, {}, _SQUARE),
    "swin_undis": (SwinUndis, {}, _SQUARE),
}
_MODELS: dict[str, tuple[type[nn.Module], dict]] = {
    f"{family}_{size}": (model, options | additions.get(size, {}) | fixed)
    for family, (model, fixed, additions) in _FAMILIES.items()
    for size, options in _SIZES.items()
}


def list_models() -> list[str]:
    """The names that `create_model` knows."""
    return sorted(_MODELS)


def create_model(name: str, **options) -> nn.Module:
    """The model of that name; `options` override its constructor's arguments.

    Raises:
        ValueError: an unknown name, or options that do not fit together.
    """
    return model_class(name)(**(_MODELS[name][1] | options))


def model_class(name: str) -> type[nn.Module]:
    """The class of the models of that name; ValueError for a name that there is not."""
    if name not in _MODELS:
        raise ValueError(f"unknown model {name!r}; there are {', '.join(list_models())}")
    return _MODELS[name][0]
