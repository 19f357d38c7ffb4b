"""The options of a model as its card keeps them: a view as the arguments of `make_view`."""

import math
from collections.abc import Mapping
from typing import Any

from darswin.views import View

# The options of Swin, DAT, the Swin-Unet and the convolutional Unet that were their view's, in
# older files. DarSwin still has such options of its own.
_OF_VIEW = ("size", "max_fov", "spacing", "theta_max", "fov", "up", "direction")
_OLD_VIEWS = {"swin_undis": "perspective", "swin_unet_undis": "perspective",
              "swin_unet_adapted": "square"}  # fmt: skip
_WITH_VIEWS = ("swin_", "dat_", "conv_unet_")


def described(model: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options with the arguments of `make_view` in place of a `View` or the name of one.

    Raises:
        ValueError: `make_view` did not make the view, or mean or std are given beside it.
    """
    options, view = dict(options), options.get("view")
    if isinstance(view, str) and view != "none" and model.startswith(_WITH_VIEWS):
        size = options.pop("size", None)
        options["view"] = dict(name=view) | ({} if size is None else dict(size=size))
    if isinstance(view, View):
        if view.made is None:
            raise ValueError(f"a card keeps views of make_view, but only its class made {view}")
        options["view"] = dict(view.made)
        for name, value, usual in (("mean", view.mean, 0.0), ("std", view.std, 1.0)):
            if value == usual:
                continue
            if name in options:
                raise ValueError(f"{name} is an option of the model and of its view: give it once")
            options[name] = value
    return options


def renewed(model: str, options: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """The name and the options of a model from a file, also of one of before `make_view` took the
    options of views: there, they were options of the model, and the view was a name."""
    options = dict(options)
    family, _, size = model.rpartition("_")
    view = options.get("view", _OLD_VIEWS.get(family))
    if family in _OLD_VIEWS:
        model = f"{family.removesuffix('_undis').removesuffix('_adapted')}_{size}"
    if not (isinstance(view, str) and model.startswith(_WITH_VIEWS)):
        return model, options
    options["view"] = view
    own = {name: options.pop(name) for name in _OF_VIEW if name in options}
    own = {name: value for name, value in own.items() if value is not None}
    if view == "none":
        return model, options
    if view == "perspective":  # it showed a circle, up to θ_max of the lens
        end = own.pop("max_fov", math.radians(175)) / 2
        own |= dict(reach=end, theta_max=end, supersampling=1)
    if view == "square" and "theta_max" in own:
        own["fov"] = 2 * own.pop("theta_max")
    options["view"] = dict(name="perspective" if view == "tangent" else view) | own
    return model, options
