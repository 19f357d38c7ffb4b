"""Views by name. Each view's file registers its class."""

import inspect
from collections.abc import Callable
from typing import Any, TypeVar

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


def make_view(
    name: str,
    size: Pair | None,
    *,
    mean: PerChannel | None = 0.0,
    std: PerChannel | None = 1.0,
    **options: Any,
) -> View:
    """The view with this name, of (H', W'); "none" also takes None, for images of any size.

    Args:
        mean, std: the arguments of `View`.
        options: the other arguments of the view. None stands for the default of an argument.

    Raises:
        ValueError: the name is unknown.
        TypeError: the view has no such option.
    """
    if name not in _VIEWS:
        raise ValueError(f"view must be one of {tuple(list_views())}, got {name!r}")
    make, given = _VIEWS[name], {k: value for k, value in options.items() if value is not None}
    given |= dict(mean=mean, std=std)
    try:
        inspect.signature(make).bind(size, **given)
    except TypeError as error:
        raise TypeError(f"the view {name!r} has no such option: {error}") from error
    return make(size, **given)
