"""The options of a model as its card keeps them: a view as the arguments of `make_view`."""

from collections.abc import Mapping
from typing import Any

from darswin.views import View

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
