"""Views by name. Each view's file registers its class."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

from darswin.ops.checks import side_or_pair
from darswin.utils.nearest import did_you_mean
from darswin.views.base import Pair, PerChannel, View

_VIEWS: dict[str, Callable[..., View]] = {}
_Make = TypeVar("_Make", bound=Callable[..., View])


def register_view(name: str) -> Callable[[_Make], _Make]:
    """Registers the decorated class or function, which makes the view.

    It is called `make((H', W'), mean=…, std=…, **options)`.
    """

    def register(make: _Make) -> _Make:
        _VIEWS[name] = make
        return make

    return register


def list_views() -> list[str]:
    """The names of all views that `make_view` can make."""
    return sorted(_VIEWS)


def flat_views() -> list[str]:
    """The names of the views of one picture that people look at: they have a `usual_shape`."""
    return [name for name in list_views() if hasattr(_VIEWS[name], "usual_shape")]


def view_class(name: str) -> Any:
    """The class with this name, or the function that makes the view; ValueError for others."""
    if name not in _VIEWS:
        meant = did_you_mean(name, _VIEWS).rstrip(".")
        raise ValueError(f"view must be one of {tuple(list_views())}, got {name!r}{meant}")
    return _VIEWS[name]


def make_view(
    name: str,
    size: int | Pair | None,
    *,
    mean: PerChannel | None = 0.0,
    std: PerChannel | None = 1.0,
    **options: Any,
) -> View:
    """The view with this name.

    Args:
        name: one of `list_views()`.
        size: (H', W') in pixels, or the side of a square; "none" also takes None, for images of any
            size.
        mean, std: the arguments of `View`.
        options: the other arguments of the view. None stands for the default of an argument.

    Raises:
        ValueError: the name is unknown, or an argument is out of range.
        TypeError: the view has no such option, or the size is no int and no pair of ints.
    """
    make = view_class(name)
    options = {k: value for k, value in options.items() if value is not None}
    arguments = options | dict(mean=mean, std=std)
    pair = None if size is None else side_or_pair("size", size)
    parameters = list(inspect.signature(make).parameters.values())
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        known = [parameter.name for parameter in parameters[1:]]
        if unknown := [option for option in arguments if option not in known]:
            named = ", ".join(known) or "none"
            raise TypeError(f"the view {name!r} has no option {unknown[0]!r}; it has {named}")
    view = make(pair, **arguments)
    plain = {k: v.tolist() if hasattr(v, "tolist") else v for k, v in options.items()}
    view.made = dict(name=name, size=pair, **plain)
    return view
