"""Named model sizes. Every model is called `model(images, lens)`."""

from torch import nn

from darswin.models.darswin import DarSwin

_SMALL = dict(embed_dim=96, depths=(2, 2, 18, 2), num_heads=(3, 6, 12, 24), drop_path_rate=0.2)
_TINY = dict(_SMALL, depths=(2, 2, 6, 2), drop_path_rate=0.1)
_MICRO = dict(embed_dim=32, depths=(2, 2, 4, 2), num_heads=(1, 2, 4, 8), samples=(6, 6))
_MICRO |= dict(drop_path_rate=0.05)
# For tests and demos: 32×32 images, three stages, a minute of training on two cores.
_NANO = dict(embed_dim=24, depths=(1, 2, 1), num_heads=(1, 2, 4), rings=8, sectors=32)
_NANO |= dict(samples=(4, 4), drop_path_rate=0.0)

_MODELS: dict[str, tuple[type[nn.Module], dict]] = {
    f"darswin_{variant.lower()}_{size}": (DarSwin, dict(options, variant=variant))
    for variant in ("A", "RA")
    for size, options in dict(small=_SMALL, tiny=_TINY, micro=_MICRO, nano=_NANO).items()
}


def list_models() -> list[str]:
    """The names that `create_model` knows."""
    return sorted(_MODELS)


def create_model(name: str, **options) -> nn.Module:
    """The model of that name; `options` override its constructor's arguments.

    Raises:
        ValueError: an unknown name, or options that do not fit together.
    """
    check_model(name)
    model, defaults = _MODELS[name]
    return model(**(defaults | options))


def check_model(name: str) -> None:
    """ValueError unless `create_model` knows the name."""
    if name not in _MODELS:
        raise ValueError(f"unknown model {name!r}; there are {', '.join(list_models())}")
