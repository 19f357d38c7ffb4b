"""A lens as a JSON object, and back: its model's name and the arguments of its constructor."""

from collections.abc import Mapping
from typing import Any

from darswin.lens.base import MODELS, Lens
from darswin.lens.focal import FocalLens


def from_dict(description: Mapping[str, Any], image_size: tuple[int, int] | None = None) -> Lens:
    """The lens that a JSON object describes.

    Args:
        description: {"model": "Spherical", "xi": 0.5, "focal": 300, "theta_max": 1.5}: a name of
            `MODELS` and the arguments of its constructor, angles in rad and lengths in px. For
            models with a focal length, "fov" may stand in place of it and of "theta_max": the
            full field of view, which fills the circle inside the image.
        image_size: (H, W) px of the lens's images, which "fov" needs.

    Raises:
        ValueError: an unknown model, or arguments that are not its own or out of range, by name.
    """
    if not isinstance(description, Mapping):
        raise ValueError(f"a lens must be a JSON object, got {description!r}")
    arguments = dict(description)
    name = arguments.pop("model", None)
    if not isinstance(name, str) or name not in MODELS:
        raise ValueError(f'a lens\'s "model" must be one of {sorted(MODELS)}, got {name!r}')
    model = MODELS[name]
    try:
        if "fov" in arguments and issubclass(model, FocalLens):
            size = image_size or arguments.get("image_size")
            if size is None:
                raise ValueError('a lens of a "fov" needs the image_size, (H, W)')
            return model.from_fov(**arguments, radius=min(size) / 2)
        return model(**arguments)
    except TypeError as error:
        raise ValueError(f"a {name} lens cannot be made of {arguments}: {error}") from error


def to_dict(lens: Lens) -> dict[str, Any]:
    """One lens as a JSON object, the inverse of `from_dict`.

    Raises:
        ValueError: several lenses, or a lens of a model that is not in `MODELS`.
    """
    if len(lens) != 1:
        raise ValueError(f"to_dict takes one lens, got {len(lens)}")
    name = type(lens).__name__
    if MODELS.get(name) is not type(lens):
        raise ValueError(f"to_dict takes a lens of {sorted(MODELS)}, got {name}")
    values = {key: getattr(lens, key) for key in lens._names()}
    described = {k: v.detach()[0].tolist() for k, v in values.items() if v is not None}
    if "image_size" in described:
        described["image_size"] = [round(side) for side in described["image_size"]]
    return {"model": name} | described
